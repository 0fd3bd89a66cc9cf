"""The command line: `drgs pose · build · render · import · export · simulate · eval · doctor · serve · worker · bench`.

Each command reads its arguments, calls one function of the library and prints. Heavy modules are imported inside the commands, so
that `drgs --help` answers at once. Wrong input and full disks end with one sentence on stderr and exit code 1, a command that is called wrongly
with 2, Ctrl-C with 130; DRGS_TRACEBACK=1 shows where a sentence came from. With --json stdout holds one JSON document and nothing else.
"""

import json
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer

from drgs.cli_answers import print_document, print_report, print_skipped
from drgs.cli_endings import INPUT_EXIT_CODE, Commands, UsageError, stopped, with_extra
from drgs.cli_options import (
    EXPORT_HELP,
    AssetPath,
    BindingKind,
    BoxCorners,
    CameraKind,
    Cameras,
    DataFolder,
    DatasetPath,
    Denoiser,
    DeviceName,
    FaceLimit,
    Json,
    LightFrame,
    LightKind,
    MaskKind,
    Masks,
    Matching,
    Preset,
    Primary,
    SheetPath,
    StrokesPath,
    UpDirection,
    VariantsPath,
    open_asset,
    picture_size,
)
from drgs.exchange.export_formats import VARIANT_FORMATS, CommandFormat, command_format_of, refuse_faces
from drgs.installation import unsupported_system
from drgs.maths.constants import STILL_BOUNCES
from drgs.openmp import spin_briefly
from drgs.scene.tone_curve import ToneCurve

app = typer.Typer(cls=Commands, add_completion=False, no_args_is_help=True, rich_markup_mode=None, pretty_exceptions_enable=False)


def _print_version(wanted: bool) -> None:
    if wanted:
        from drgs import __version__

        print(f"drgs {__version__}")
        raise typer.Exit


@app.callback()
def about(
    version: Annotated[bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and end.")] = False,
) -> None:
    """Relightable, deformable, editable 2D Gaussians: photos in, an asset out."""


@app.command()
def pose(
    photos: Annotated[Path, typer.Argument(metavar="PHOTOS", help="Folder of pictures, with or without masks/, or a film.")],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Capture folder to write, for doctor and build.")],
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the last finished step of a stopped search.")] = False,
    matching: Annotated[
        Matching, typer.Option(help="Which pairs: all, or near each other as in a video; auto: all of up to 200 pictures.")
    ] = Matching.auto,
    frames: Annotated[
        int | None, typer.Option(min=8, max=1000, help="Of a film: slots of time, of each the sharpest frame.", show_default="120")
    ] = None,
    seed: Annotated[int, typer.Option()] = 0,
    json_progress: Annotated[bool, typer.Option("--json-progress", help="Print one JSON line for each progress report on stdout.")] = False,
    as_json: Json = False,
) -> None:
    """Find the cameras of plain photographs or of a film, and write them as a capture."""
    from drgs.cli_progress import StopOnInterrupt, build_progress
    from drgs.reconstruct.pose.pose_photographs import PoseSettings
    from drgs.reconstruct.pose.posed_capture import summary_lines
    from drgs.reconstruct.pose.posed_dataset import pose_source
    from drgs.reconstruct.progress import BuildStopped

    settings = PoseSettings(matching=matching.value, seed=seed, resume=resume)
    with StopOnInterrupt() as interrupt, build_progress(json_progress) as report:
        try:
            found = pose_source(photos, out, settings, frames, progress=report, should_stop=interrupt.is_set).capture
        except BuildStopped:
            raise stopped(f"drgs pose {photos} {out} --resume") from None
    if json_progress or as_json:
        print(json.dumps(vars(found)), flush=True)
    else:
        print("\n".join(summary_lines(found)))


# Many arguments because each is an option of the command.
@app.command()
def build(
    dataset: DatasetPath,
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Asset folder to write.")],
    preset: Annotated[Preset, typer.Option(help="How much time to spend.")] = Preset.fast,
    binding: Annotated[
        BindingKind, typer.Option(help="Where Gaussians lie: as fitted, or rebuilt on the faces of the mesh.")
    ] = BindingKind.particles,
    light: LightFrame = LightKind.auto,
    masks: Masks = MaskKind.auto,
    cameras: Cameras = CameraKind.auto,
    up: UpDirection = (0.0, 0.0, 1.0),
    box: BoxCorners = None,
    strokes: StrokesPath = None,
    device: Annotated[DeviceName, typer.Option()] = DeviceName.auto,
    seed: Annotated[int, typer.Option()] = 0,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the checkpoint that a stopped build left.")] = False,
    json_progress: Annotated[bool, typer.Option("--json-progress", help="Print one JSON line for each progress report on stdout.")] = False,
) -> None:
    """Build an asset from photographs; those without cameras, or a film, are posed first."""
    from drgs.cli_progress import StopOnInterrupt, build_progress
    from drgs.reconstruct.build_asset import BuildSettings, BuildStopped, build_asset
    from drgs.reconstruct.capture.build_box import BuildBox
    from drgs.reconstruct.outline_agreement import complaint
    from drgs.scene.strokes import read_strokes

    settings = BuildSettings(
        preset=preset.value,
        binding=binding.value,
        device=device.value,
        seed=seed,
        resume=resume,
        light=light.value,
        masks=masks.value,
        cameras=cameras.value,
        up=up,
        box=None if box is None else BuildBox(box[:3], box[3:]),
        strokes=() if strokes is None else read_strokes(strokes),
    )
    with StopOnInterrupt() as interrupt, build_progress(json_progress) as report:
        try:
            asset = build_asset(dataset, out, settings, progress=report, should_stop=interrupt.is_set, previews=False)
        except BuildStopped:
            chosen = "" if binding == BindingKind.particles else f" --binding {binding.value}"
            chosen += "" if light == LightKind.auto else f" --light {light.value}"
            chosen += "" if masks == MaskKind.auto else f" --masks {masks.value}"
            chosen += "" if cameras == CameraKind.auto else f" --cameras {cameras.value}"
            chosen += "" if up == (0.0, 0.0, 1.0) else f" --up {up[0]:g} {up[1]:g} {up[2]:g}"
            chosen += "" if box is None else f" --box {' '.join(f'{value:g}' for value in box)}"
            chosen += "" if strokes is None else f" --strokes {strokes}"
            raise stopped(f"drgs build {dataset} {out} --preset {preset.value}{chosen} --resume") from None
    if json_progress:
        print(json.dumps({"stage": "done", "fraction": 1.0, "asset": str(out), "provenance": asset.provenance}), flush=True)
    else:
        print(
            f"Asset written to {out}: {len(asset.mesh.faces)} faces. To look at it: drgs serve, and drop the folder on its page",
            file=sys.stderr,
        )
    wrong = complaint(asset.provenance["outline_agreement"])
    if wrong is not None:
        print(f"drgs: {wrong}", file=sys.stderr)


# Many arguments because each is an option of the command.
@app.command()
def render(
    asset: AssetPath,
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Folder for the pictures, one for each camera.")],
    cameras: Annotated[Path, typer.Option(help="transforms.json with the cameras.")],
    env: Annotated[Path | None, typer.Option(help="Environment (EXR or HDR) instead of the recovered one.")] = None,
    env_rotation: Annotated[float, typer.Option(help="Degrees, counter-clockwise seen from above.")] = 0.0,
    edits: Annotated[Path | None, typer.Option(help="Edits (JSON), applied in order.")] = None,
    spp: Annotated[int, typer.Option(min=1, help="Rays a pixel.")] = 256,
    bounces: Annotated[int, typer.Option(min=0, help="Indirect bounces.")] = STILL_BOUNCES,
    primary: Annotated[
        Primary | None, typer.Option(help="What the camera sees; by default what the asset prefers: a built one its mesh.")
    ] = None,
    denoise: Annotated[Denoiser, typer.Option()] = Denoiser.none,
    tone_curve: Annotated[ToneCurve, typer.Option(help="How bright light is brought to the screen; EXR files stay linear.")] = "standard",
    aov: Annotated[bool, typer.Option("--aov", help="Write <name>.exr with the maps behind the picture, too.")] = False,
    seed: Annotated[int, typer.Option()] = 0,
    size: Annotated[str | None, typer.Option(metavar="WxH", help="Picture size instead of the file's.")] = None,
    device: Annotated[DeviceName, typer.Option()] = DeviceName.auto,
    error: Annotated[float | None, typer.Option(min=1e-5, help="Relative error at which parts of a picture get no more rays.")] = None,
    explain: Annotated[bool, typer.Option("--explain", help="Say what was left out of the work, and why.")] = False,
    skip: Annotated[bool, typer.Option("--skip/--no-skip", help="Leave out work that the scene does not need.")] = True,
    as_json: Json = False,
) -> None:
    """Render an asset from the cameras of a file: <name>.png (RGBA, straight alpha, sRGB), and maps with --aov."""
    from drgs.cli_progress import frame_progress
    from drgs.deform.pose_scene import pose_scene
    from drgs.reconstruct.capture.load_views import load_cameras
    from drgs.render.records import RenderSettings
    from drgs.render.render_cameras import render_cameras
    from drgs.scene.asset import light_from_world
    from drgs.scene.edits import EnvironmentEdit, load_edits

    changes = load_edits(edits) if edits else []
    if env or env_rotation:
        changes.append(EnvironmentEdit(op="environment", file=str(env.resolve()) if env else None, rotation=env_rotation))
    views = load_cameras(cameras, picture_size(size))
    opened = open_asset(asset, device)
    scene = pose_scene(opened, changes, edits.parent if edits else Path())
    settings = RenderSettings(
        samples_per_pixel=spp,
        bounces=bounces,
        primary=primary.value if primary else scene.primary,
        denoise=denoise.value,
        tone_curve=tone_curve,
        target_error=error,
        skip=skip,
        seed=seed,
    )
    with frame_progress("Rendering", len(views)) as advance:
        frames = render_cameras(scene, views, out, settings, aov, advance, light_from_world(opened, changes))
    if as_json:
        print(json.dumps({"out": str(out), "frames": frames}))
    else:
        print(f"{len(frames)} {'picture' if len(frames) == 1 else 'pictures'} written to {out}", file=sys.stderr)
    if explain and not as_json:
        print_skipped(frames)


@app.command("import")
def import_(
    mesh: Annotated[Path, typer.Argument(metavar="MESH", help="glb, obj, or ply with vertex materials.")],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Asset folder to write.")],
) -> None:
    """Make an asset of a mesh, without training."""
    from drgs.convert.import_mesh import import_mesh
    from drgs.scene.asset import save_asset

    save_asset(import_mesh(mesh), out)
    print(f"Asset written to {out}", file=sys.stderr)


@app.command()
def export(
    asset: AssetPath,
    out: Annotated[Path, typer.Argument(metavar="OUT", help="File to write.")],
    format: Annotated[CommandFormat | None, typer.Option(help=EXPORT_HELP, show_default="by OUT's suffix")] = None,
    faces: FaceLimit = None,
    variants: VariantsPath = None,
) -> None:
    """Write an asset as a file that other programs read."""
    try:
        chosen = format or command_format_of(out)
    except ValueError as error:
        raise UsageError(str(error)) from error

    from drgs.convert.export_asset import export_asset
    from drgs.convert.material_variants import load_variants
    from drgs.convert.transform_splats import transform_splats
    from drgs.scene.asset import load_asset

    if chosen == "sog" or chosen == "compressed":
        refuse_faces(faces, (chosen,))
        if variants is not None:
            raise UsageError(f"format {chosen!r} holds no material variants; expected {', '.join(VARIANT_FORMATS)}")
        left_out = transform_splats(load_asset(asset), out, chosen)
    else:
        left_out = export_asset(load_asset(asset), out, chosen, faces, None if variants is None else load_variants(variants))
    print(f"Wrote {out}: {out.stat().st_size / 1e6:.1f} MB{', ' if left_out else ''}{left_out}", file=sys.stderr)


@app.command()
def simulate(
    asset: AssetPath,
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Clip to write: a folder of frames.")],
    scene: Annotated[Path | None, typer.Option(help="Simulation scene (JSON); without it a jelly under its own weight.")] = None,
    device: Annotated[DeviceName, typer.Option()] = DeviceName.auto,
    as_json: Json = False,
) -> None:
    """Drop, squash and shake an asset; play the clip with a 'pose' edit."""
    from drgs.cli_progress import frame_progress
    from drgs.deform.matter.simulate import simulate as run_simulation
    from drgs.deform.matter.simulation_scene import SimulationScene, parse_simulation_scene

    setting = SimulationScene() if scene is None else parse_simulation_scene(scene.read_bytes())
    with frame_progress("Simulating", None) as advance:
        folder = Path() if scene is None else scene.parent
        _, report = run_simulation(
            open_asset(asset, device),
            setting,
            out,
            lambda done, total: advance(f"{done} of {total}"),
            lambda name: folder / name,
            warn=lambda sentence: print(f"drgs: {sentence}", file=sys.stderr),
        )
    print_document({"out": str(out)} | vars(report), as_json)


@app.command("eval")
def eval_(
    asset: AssetPath,
    dataset: Annotated[
        Path,
        typer.Argument(metavar="DATASET", help="Folder with transforms_test.json; truth for maps, light, shape is used where it is there."),
    ],
    out: Annotated[Path | None, typer.Option(help="Keep the rendered pictures in this folder.")] = None,
    spp: Annotated[int, typer.Option(min=1, help="Rays a pixel.")] = 256,
    seed: Annotated[int, typer.Option()] = 0,
    device: Annotated[DeviceName, typer.Option()] = DeviceName.auto,
    as_json: Json = False,
) -> None:
    """Render an asset's test views and score them against the truth."""
    from drgs.cli_progress import frame_progress
    from drgs.evaluate.evaluate_asset import EvaluationSettings, evaluate_asset

    settings = EvaluationSettings(samples_per_pixel=spp, seed=seed)
    with frame_progress("Evaluating", None) as advance:
        figures = evaluate_asset(open_asset(asset, device), dataset, out, settings, done=advance)
    print_document(figures, as_json)


@app.command()
def doctor(
    dataset: DatasetPath,
    sheet: SheetPath = None,
    strokes: StrokesPath = None,
    as_json: Json = False,
) -> None:
    """Check a capture before time is spent on it; with strokes, see what masks they give."""
    from drgs.evaluate.contact_sheet import SHEET_FORMATS, contact_sheet
    from drgs.evaluate.doctor.doctor import EXAMINED_SIDE, examine
    from drgs.reconstruct.capture.load_views import load_unmasked_views
    from drgs.reconstruct.capture.load_views.checks import is_folder
    from drgs.reconstruct.capture.masks_by_strokes import masks_by_strokes
    from drgs.scene.strokes import read_strokes

    if sheet is not None and sheet.suffix.lower() not in SHEET_FORMATS:
        raise UsageError(f"--sheet is {str(sheet)!r}; expected a file that ends with {' or '.join(SHEET_FORMATS)}")
    if strokes is not None and sheet is None:
        raise UsageError("--strokes shows its masks on a sheet; expected --sheet FILE, too")
    drawn = None if strokes is None else read_strokes(strokes)
    examined = examine(dataset)
    report, masked = examined.report, None
    if drawn is not None and report["ok"]:
        if examined.views is None:
            raise ValueError(f"{dataset}: has no cameras, which strokes need; expected a posed capture: drgs pose {dataset} OUT")
        masked = masks_by_strokes(load_unmasked_views(dataset, EXAMINED_SIDE), drawn)
    if sheet is not None and (report["ok"] or is_folder(dataset)):
        contact_sheet(dataset, report, sheet, masked)
    if as_json:
        print(json.dumps(report))
    elif report["ok"]:
        print_report(report)
        if sheet is not None:
            print(f"All pictures: {sheet}")
    else:
        raise ValueError(" ".join([report["findings"][0]["sentence"], report["findings"][0]["advice"]]))
    raise typer.Exit(0 if report["ok"] else INPUT_EXIT_CODE)


@app.command()
def serve(
    data: DataFolder = None,
    host: Annotated[str | None, typer.Option(help="An address of this machine alone.", show_default="127.0.0.1")] = None,
    port: Annotated[int | None, typer.Option(min=0, max=65535, help="0 picks a free one.", show_default="8000")] = None,
    captures: Annotated[list[Path] | None, typer.Option(help="Folder below which builds may find captures; may be given again.")] = None,
    worker: Annotated[
        bool | None, typer.Option("--worker/--no-worker", help="Also run a worker for the jobs.", show_default="worker")
    ] = None,
    open_browser: Annotated[bool, typer.Option("--open", help="Open the viewer in a browser.")] = False,
    device: Annotated[DeviceName | None, typer.Option(show_default="auto")] = None,
    restore_backup: Annotated[bool, typer.Option("--restore-backup", help="Begin with the last good copy of a damaged database.")] = False,
) -> None:
    """Start the server and a worker for its jobs; prints the address to open. More settings: docs/operations.md."""
    with with_extra("drgs serve", "serve"):
        from drgs_server.run import serve as run_server

    roots = tuple(path.resolve() for path in captures or ())
    on = device.value if device else None
    raise typer.Exit(run_server(data, host, port, worker, open_browser, capture_roots=roots, device=on, restore_backup=restore_backup))


@app.command()
def worker(
    data: DataFolder = None,
    device: Annotated[DeviceName | None, typer.Option(show_default="auto")] = None,
    requeue: Annotated[str | None, typer.Option(metavar="WORKER", help="Give this dead worker's jobs to the others, and end.")] = None,
) -> None:
    """Run queued jobs without serving pages, for example on another machine."""
    with with_extra("drgs worker", "serve"):
        from drgs_worker.run import requeue_worker, run_worker

    if requeue is not None:
        print(json.dumps(requeue_worker(data, requeue)))
        return
    raise typer.Exit(run_worker(data, device.value if device else None))


@app.command(context_settings={"allow_extra_args": True, "ignore_unknown_options": True})
def bench(context: typer.Context, name: Annotated[str, typer.Argument(metavar="NAME", help="rasterize, build, ...")]) -> None:
    """Run a benchmark; the arguments are those of `python -m benchmarks NAME`."""
    try:
        from benchmarks.__main__ import main as run_benchmark
    except ModuleNotFoundError as error:
        raise ValueError("bench: the benchmarks are in the repository, not in the installed package; run this from a checkout") from error

    run_benchmark([name, *context.args])


def main() -> None:
    """Entry point of the `drgs` command."""
    if (sentence := unsupported_system()) and any(find_spec(name) is None for name in ("torch", "warp", "embreex")):
        sys.exit(f"drgs cannot run here: {sentence}")
    if sys.argv[1:2] != ["serve"]:  # whose processes choose for themselves
        spin_briefly()
    app()
