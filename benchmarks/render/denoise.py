"""What denoising does to the error: as samples grow, and one frame after an edit.

    python -m benchmarks denoise --reference DIR [--spp 8 32 128 512 1024] [--json] [--plot FILE.svg]

DIR is a folder of reference pictures (benchmarks/render/integrator.py); its mesh comes in as `drgs import` reads it. For each number of samples the
same sums are shown as they are, through SVGF, and through OIDN where pyoidn is installed: relmse and bias against the reference (definition: integrator.py), and
`from_mean`, the relmse of what is shown against the undenoised mean of the same sums, which must go to 0.
Edits: a frame of --before samples, then one edit and one pass more. relmse is that of the next frame against our own picture of the edited
scene at --truth samples, shown with SVGF: `after` with the frame before to go on from, `fresh` with nothing before it, `kept` had the old
picture simply stayed. Smear is where `after` exceeds `fresh`.
"""

import argparse
import json
import math
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks._plot import Curve, log_log_svg
from benchmarks.render.integrator import compare, mitsuba_rows, read_cameras, read_exr
from drgs.convert.import_mesh import import_mesh
from drgs.render.film.denoise.oidn import oidn_filter
from drgs.render.film.resolve_frame import resolve_frame
from drgs.render.integrate.plan import samples_per_pass
from drgs.render.intersect.trace_rays import build_tracer
from drgs.render.progressive.frame_state import FrameState, with_settings
from drgs.render.progressive.refine import refine_frame
from drgs.render.progressive.start_frame import start_frame
from drgs.render.records import Frame, RenderSettings
from drgs.scene.camera import Camera
from drgs.scene.environment import Environment
from drgs.scene.posed_scene import PosedScene


def shown(state: FrameState, method: str) -> Frame:
    """The picture so far through another denoiser."""
    return resolve_frame(with_settings(state, denoise=method))


def premultiplied(frame: Frame) -> Tensor:
    return frame.radiance_linear * frame.gbuffer.coverage[..., None]


def relmse(found: Tensor, truth: Tensor, covered: Tensor) -> float:
    x, y = found[covered].double(), truth[covered].double()
    return float(((x - y) ** 2 / (y * y + 0.01)).mean())


def with_passes(state: FrameState, spp: int) -> FrameState:
    """Refined to at least `spp` samples a pixel."""
    return refine_frame(state, max(0, -(-spp // samples_per_pass(state.inputs).total) - state.passes))


def convergence(
    scene: PosedScene, camera: Camera, bounces: int, samples: list[int], methods: list[str], reference: np.ndarray, se: np.ndarray
) -> list[dict]:
    """One row a number of samples and a method."""
    tracer = build_tracer(scene.mesh)
    settings = RenderSettings(bounces=bounces, primary="mesh")
    for method in methods:
        shown(refine_frame(start_frame(scene, camera, settings, tracer)), method)  # compile and warm up
    state = start_frame(scene, camera, settings, tracer)
    rows, seconds = [], 0.0
    for spp in sorted(samples):
        clock = time.process_time()
        state = with_passes(state, spp)
        seconds += time.process_time() - clock
        mean = premultiplied(shown(state, "none"))
        covered = torch.from_numpy(reference[..., 3] > 0)
        for method in methods:
            clock = time.process_time()
            picture = premultiplied(shown(state, method))
            showing = time.process_time() - clock
            figures = compare(picture.numpy(), np.zeros(picture.shape[:2], np.float32), reference, se)
            rows.append(
                {
                    "spp": spp,
                    "method": method,
                    "cpu_seconds": round(seconds + showing, 4),
                    "relmse": figures["relmse"],
                    "bias": figures["bias"],
                    "from_mean": relmse(picture, mean, covered),
                }
            )
    return rows


def edits(scene: PosedScene) -> dict[str, PosedScene]:
    """Changes that leave the camera alone."""
    mesh = scene.mesh
    return {
        "albedo halved": replace(scene, mesh=replace(mesh, albedo=0.5 * mesh.albedo)),
        "roughness 0.1": replace(scene, mesh=replace(mesh, roughness=torch.full_like(mesh.roughness, 0.1))),
        "light turned by 40°": replace(scene, environment_rotation_degrees=40.0),
        "light dimmed to a half": replace(scene, environment_intensity=0.5),
    }


def orbited(camera: Camera, degrees: float) -> Camera:
    """The camera, gone round the z axis."""
    angle = math.radians(degrees)
    turn = torch.eye(4)
    turn[:2, :2] = torch.tensor([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
    return replace(camera, camera_from_world=camera.camera_from_world @ turn)


def one_frame_after(scene: PosedScene, camera: Camera, bounces: int, before: int, truth_samples: int) -> list[dict]:
    """One row an edit; a moved camera, which may and should use what was seen before, among them."""
    settings = RenderSettings(bounces=bounces, primary="mesh", denoise="svgf")
    tracer = build_tracer(scene.mesh)
    old = with_passes(start_frame(scene, camera, settings, tracer), before)
    cases = {name: (changed, camera) for name, changed in edits(scene).items()}
    cases |= {f"camera moved by {degrees:g}°": (scene, orbited(camera, degrees)) for degrees in (0.25, 2.0)}
    rows = []
    for name, (changed, seen_by) in cases.items():
        calm = replace(settings, seed=1, denoise="none")
        truth = resolve_frame(with_passes(start_frame(changed, seen_by, calm), truth_samples))
        covered = truth.gbuffer.coverage > 0
        after = resolve_frame(refine_frame(start_frame(changed, seen_by, settings, previous=old)))
        fresh = resolve_frame(refine_frame(start_frame(changed, seen_by, settings)))
        pictures = {"after": after, "fresh": fresh, "kept": resolve_frame(old)}
        of_edit = {kind: relmse(premultiplied(frame), premultiplied(truth), covered) for kind, frame in pictures.items()}
        rows.append({"edit": name, "samples": after.radiance.samples} | of_edit)
    return rows


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks denoise", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--reference", type=Path, required=True)
    parser.add_argument("--env", nargs="+", default=["interior", "dawn", "city"])
    parser.add_argument("--light", choices=["direct", "bounce1"], default="bounce1")
    parser.add_argument("--camera", type=int, default=0)
    parser.add_argument("--spp", type=int, nargs="+", default=[8, 32, 128, 512, 1024])
    parser.add_argument("--before", type=int, default=256, help="samples behind the frame that is edited")
    parser.add_argument("--truth", type=int, default=512, help="samples behind the edited scene's truth; 0: no edits")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--plot", type=Path, help="error against time, log-log (SVG), of the first environment")
    given = parser.parse_args(arguments)
    folder: Path = given.reference
    mesh, bounces = import_mesh(folder / "mesh.ply").mesh, int(given.light == "bounce1")
    methods = ["none", "svgf", *(["oidn"] if _has_oidn() else [])]
    rows: list[dict] = []
    changes: list[dict] = []
    for env in given.env:
        reference, se = (
            read_exr(folder / f"{env}_{given.light}_{given.camera}.exr"),
            np.load(folder / f"{env}_{given.light}_{given.camera}_se.npy"),
        )
        table = mitsuba_rows(read_exr(folder / f"env_{env}.exr")[..., :3])
        scene = PosedScene(None, mesh, Environment(torch.from_numpy(np.ascontiguousarray(table))))
        camera = read_cameras(folder / "cameras.json", len(reference))[given.camera]
        what = {"env": env, "light": given.light, "camera": given.camera}
        rows += _printed([what | row for row in convergence(scene, camera, bounces, given.spp, methods, reference, se)], given.json)
        if given.truth:
            changes += _printed([what | row for row in one_frame_after(scene, camera, bounces, given.before, given.truth)], given.json)
    if given.plot:
        curves = [
            Curve(method, [(row["cpu_seconds"], row["relmse"]) for row in rows if row["env"] == given.env[0] and row["method"] == method])
            for method in methods
        ]
        given.plot.write_text(log_log_svg(curves, f"{given.env[0]}, {given.light}", "processor seconds", "relmse"))
    if given.json:
        print(json.dumps({"rows": rows, "edits": changes}))


def _has_oidn() -> bool:
    try:
        oidn_filter()
    except ValueError:
        return False
    return True


def _printed(rows: list[dict], as_json: bool) -> list[dict]:
    if not as_json:
        for row in rows:
            print("  ".join(f"{k} {v:.5g}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items()), flush=True)
    return rows
