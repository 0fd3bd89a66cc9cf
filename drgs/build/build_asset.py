"""A capture becomes an asset: read, fit surfels and light, extract the mesh, fit materials, bake, write.

Reads like the method: each step is a function of its own file; here they meet, with presets, progress, checkpoints and resuming.
Checkpoints live in OUT.build/ beside the asset; a build that was stopped or killed goes on from the last one.
"""

import hashlib
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import TypeVar

import simplejpeg
import torch
from torch import Tensor

from drgs.build.bake_materials import bake_materials
from drgs.build.bind_gaussians import bind_gaussians
from drgs.build.checkpoint import fit_tensors, read_tensors, restore_fit, write_tensors
from drgs.build.densify import DensifySettings, Pull
from drgs.build.extract_mesh import FAST_MESH, FULL_MESH, DepthMap, MeshSettings, clean_mesh, extract_mesh, mesh_report
from drgs.build.find_masks import find_masks, with_drawn_masks
from drgs.build.fit_gaussians import (
    FitReport,
    FitSettings,
    FitState,
    environment_table,
    fit_gaussians,
    gaussians_from_state,
    render_stage_one,
    scaled_camera,
    start_fit,
)
from drgs.build.fit_materials import MaterialSettings, MaterialState, fit_materials, gaussians_from_materials, start_materials
from drgs.build.fit_mesh_surfels import (
    MeshFitSettings,
    MeshFitState,
    fit_mesh_surfels,
    gaussians_from_mesh_fit,
    start_mesh_fit,
    surfels_on_faces,
)
from drgs.build.initial_points import InitialPoints, initial_points
from drgs.build.load_views import load_views
from drgs.build.mesh_surfels import mesh_surfels
from drgs.build.split_sum import filter_environment
from drgs.maths.color import srgb_from_linear
from drgs.render.rasterize_gbuffer import RasterSettings, rasterize
from drgs.render.sample_rays import SampleCounts
from drgs.scene.asset import Asset, save_asset
from drgs.scene.binding import Binding
from drgs.scene.camera import Camera
from drgs.scene.environment import Environment
from drgs.scene.gaussians import Gaussians, surfel_tangents
from drgs.scene.mesh import TriangleMesh, vertex_normals
from drgs.scene.views import Views
from drgs.warp_torch import device_from_name

PREVIEW_SECONDS = 3.0
"""Between preview pictures."""
CHECKPOINT_SECONDS = 30.0
PREVIEW_SIDE = 256
"""[pixels]"""


@dataclass(frozen=True)
class BuildSettings:
    """What a user chooses."""

    preset: str = "fast"
    """draft, fast or full."""
    binding: str = "particles"
    """particles: surfels lie where they were fitted. mesh: they are rebuilt on the faces of the mesh, one a face."""
    device: str = "auto"
    """auto, cpu or cuda."""
    seed: int = 0
    resume: bool = False
    materials: str | None = None
    """Preset of the stage `materials` alone: None is `preset`. It is how material and light are separated anew on kept geometry."""


@dataclass(frozen=True)
class Progress:
    """How far a build is."""

    stage: str
    iteration: int
    iterations: int
    fraction: float
    """Of the whole build, 0..1."""
    psnr: float | None = None
    message: str = ""
    eta_seconds: float | None = None
    preview_jpeg: bytes | None = None


@dataclass(frozen=True)
class Preset:
    """All numbers that differ between draft, fast and full."""

    points: int
    image_side: int
    """Photos are reduced to at most this [pixels]."""
    fit: FitSettings
    mesh: MeshSettings
    materials: MaterialSettings
    mesh_surfels: MeshFitSettings = field(default_factory=MeshFitSettings)
    """For binding mesh: its fine-tuning. There the mesh has as many faces at most as surfels are allowed (fit.densify.budget)."""


BINDINGS = ("particles", "mesh")
MASKS = "masks.safetensors"
"""Of a capture that has none of its own."""
CHECKPOINTS = ("stage1.safetensors", "mesh.safetensors", "stage2.safetensors", "mesh_surfels.safetensors", "stage2_mesh.safetensors")
"""In the order of the stages, first those of either binding and of particles."""
PRESETS = {
    "draft": Preset(
        8_000,
        256,
        FitSettings(iterations=400, half_size_share=0.6, densify=DensifySettings(budget=12_000)),
        replace(FAST_MESH, resolution=160, face_limit=30_000),
        MaterialSettings(iterations=80, points_a_step=512),
        MeshFitSettings(iterations=150),
    ),
    "fast": Preset(
        15_000,
        512,
        FitSettings(iterations=1400, densify=DensifySettings(budget=30_000)),
        FAST_MESH,
        MaterialSettings(iterations=300),
        MeshFitSettings(iterations=300),
    ),
    "full": Preset(
        25_000,
        1024,
        FitSettings(iterations=2500, half_size_share=0.25, densify=DensifySettings(budget=40_000)),
        FULL_MESH,
        MaterialSettings(iterations=500, samples=SampleCounts(96, 48, 48)),
        MeshFitSettings(iterations=500),
    ),
}
STAGE_SHARES = {"read": 0.02, "fit": 0.62, "mesh": 0.04, "materials": 0.3, "pack": 0.02}
"""Of the time, for the progress bar."""
MESH_STAGE_SHARES = {"read": 0.02, "fit": 0.53, "mesh": 0.04, "bind": 0.12, "materials": 0.27, "pack": 0.02}
"""The same with binding mesh."""


Surfels = TypeVar("Surfels", Gaussians, Binding)


class BuildStopped(Exception):
    """should_stop() was true; the checkpoint is on disk."""


class _Reporter:
    """Turns step reports into Progress, with a preview every few seconds and a checkpoint every half minute."""

    def __init__(self, progress: Callable[[Progress], None] | None, shares: dict[str, float]) -> None:
        self.progress = progress
        self.shares = shares
        self.started = time.monotonic()
        self.last_preview = self.last_checkpoint = self.last_report = self.started

    def report(
        self,
        stage: str,
        share: float,
        message: str,
        report: FitReport | None = None,
        preview: Callable[[], bytes] | None = None,
        checkpoint: Callable[[], None] | None = None,
    ) -> None:
        now = time.monotonic()
        if checkpoint is not None and now - self.last_checkpoint > CHECKPOINT_SECONDS:
            checkpoint()
            self.last_checkpoint = now
        if self.progress is None or (report is not None and report.iteration < report.iterations and now - self.last_report < 0.2):
            return
        self.last_report = now
        jpeg = None
        if preview is not None and now - self.last_preview > PREVIEW_SECONDS:
            jpeg = preview()
            self.last_preview = time.monotonic()
        names = list(self.shares)
        fraction = sum(self.shares[n] for n in names[: names.index(stage)]) + share * self.shares[stage]
        spent = now - self.started
        eta = None
        if report is not None and report.iteration > 10:  # this stage's rate, scaled to what is left of the whole
            eta = report.seconds / report.iteration * (report.iterations - report.iteration)
            eta += max(0.0, 1 - fraction - (1 - share) * self.shares[stage]) * spent / max(fraction, 0.05)
        counts = (report.iteration, report.iterations) if report else (0, 0)
        self.progress(Progress(stage, *counts, fraction, report.psnr if report else None, message, eta, jpeg))


def encode_preview(radiance_linear: Tensor, coverage: Tensor) -> bytes:
    """JPEG of a picture on mid grey."""
    alpha = coverage.clamp(0, 1)[..., None]
    image = srgb_from_linear(radiance_linear).clamp(0, 1) * alpha + 0.2 * (1 - alpha)
    return simplejpeg.encode_jpeg((image.detach().cpu() * 255).round().to(torch.uint8).contiguous().numpy(), quality=85)


def build_asset(
    dataset: Path,
    out: Path,
    settings: BuildSettings,
    progress: Callable[[Progress], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> Asset:
    """Build an asset folder from a capture.

    Args:
        dataset: a capture folder (see load_views). out: the asset folder to write; OUT.build/ beside it holds checkpoints.
        should_stop: asked between steps; when true the checkpoint is written and BuildStopped raised.

    Raises:
        ValueError: the capture, a setting or a checkpoint is wrong, in one sentence.
        BuildStopped: as asked.
    """
    *_, (_, asset) = build_stages(dataset, out, settings, progress, should_stop)
    assert asset is not None
    return asset


def build_stages(
    dataset: Path,
    out: Path,
    settings: BuildSettings,
    progress: Callable[[Progress], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> Iterator[tuple[str, Asset | None]]:
    """build_asset in stages: gives the name of each as it is finished, its result on disk, and with the last one the asset.

    Who stops between two stages and calls again with `resume` repeats none but the reading of the capture.
    """
    for name in (settings.preset, settings.materials or settings.preset):
        if name not in PRESETS:
            raise ValueError(f"preset {name!r} is unknown; expected one of {', '.join(PRESETS)}")
    if settings.binding not in BINDINGS:
        raise ValueError(f"binding {settings.binding!r} is unknown; expected one of {', '.join(BINDINGS)}")
    preset = PRESETS[settings.preset]
    device = device_from_name(settings.device)
    work = Path(f"{out}.build")
    seconds: dict[str, float] = {}
    on_mesh = settings.binding == "mesh"
    reporter = _Reporter(progress, MESH_STAGE_SHARES if on_mesh else STAGE_SHARES)

    def stop_now() -> bool:
        return should_stop is not None and should_stop()

    def timed(stage: str, started: float) -> None:
        seconds[stage] = round(seconds.get(stage, 0.0) + time.monotonic() - started, 2)

    started = time.monotonic()
    reporter.report("read", 0.0, "reading the capture")
    views = load_views(dataset, max_side=preset.image_side)
    points = initial_points(views, preset.points, settings.seed)
    identity = {"preset": settings.preset, "seed": settings.seed, "capture": capture_digest(views)}
    if not settings.resume:
        for stale in (MASKS, *CHECKPOINTS):  # else a later --resume would take them for this build's
            (work / stale).unlink(missing_ok=True)
    fit_settings = replace(preset.fit, seed=settings.seed)
    if not views.has_masks:
        masked = _found_masks(views, points, fit_settings, device, work, identity, settings.resume, reporter, stop_now)
        points = _points_of_found_masks(masked, points, preset.points, settings.seed)
    timed("read", started)
    yield "read", None

    started = time.monotonic()
    fit = _stage_one(views, points, fit_settings, device, work, identity, settings.resume, reporter, stop_now)
    if not views.has_masks:
        views = with_drawn_masks(views, gaussians_from_state(fit), 0.01 * points.bounds_radius)
    timed("fit", started)
    yield "fit", None

    started = time.monotonic()
    reporter.report("mesh", 0.0, "extracting the mesh")
    gaussians, mesh = _mesh_stage(views, points, fit, preset.mesh, work, identity, settings.resume)
    timed("mesh", started)
    yield "mesh", None
    if stop_now():
        raise BuildStopped

    light, binding = fit.parameters, None
    if on_mesh:
        started = time.monotonic()
        identity |= {"binding": "mesh"}
        mesh = reduced_mesh(mesh, preset.fit.densify.budget, points.bounds_radius)
        bind_settings = replace(preset.mesh_surfels, seed=settings.seed)
        bound = _bind_stage(
            views, gaussians, fit, mesh, points.bounds_radius, bind_settings, work, identity, settings.resume, reporter, stop_now
        )
        gaussians, binding = gaussians_from_mesh_fit(bound)
        seen = seen_surfels(gaussians, views.cameras, points.bounds_radius)
        gaussians, binding, light = chosen_surfels(gaussians, seen), chosen_surfels(binding, seen), bound.parameters
        timed("bind", started)
        yield "bind", None

    started = time.monotonic()
    material_settings = replace(PRESETS[settings.materials or settings.preset].materials, seed=settings.seed)
    if settings.materials is not None:
        identity |= {"materials": settings.materials}
    materials = _stage_two(
        views,
        gaussians,
        light,
        mesh,
        points.bounds_radius,
        material_settings,
        work / CHECKPOINTS[4 if on_mesh else 2],
        identity,
        settings.resume,
        reporter,
        stop_now,
    )
    timed("materials", started)
    yield "materials", None

    started = time.monotonic()
    reporter.report("pack", 0.0, "baking materials and writing the asset")
    gaussians = gaussians_from_materials(materials)
    environment = Environment(environment_table(materials.parameters).detach())
    baked = bake_materials(mesh, gaussians)
    asset = Asset(
        gaussians=gaussians,
        mesh=baked,
        binding=bind_gaussians(gaussians.centers, baked) if binding is None else binding,
        environment=environment,
        cameras=views.cameras,
        provenance={
            "source": views.source,
            "dataset": dataset.name,
            "preset": settings.preset,
            "binding": settings.binding,
            "materials": settings.materials or settings.preset,
            "seed": settings.seed,
            "device": str(device),
            "torch": torch.__version__,
            "mesh": asdict(mesh_report(mesh.vertices, mesh.faces)),
            "seconds": seconds,
        },
    )
    timed("pack", started)
    save_asset(asset, out, _thumbnail(materials, views.cameras))
    reporter.report("pack", 1.0, "done")
    yield "pack", asset


def capture_digest(views: Views) -> str:
    """Hex digest of the photos, masks and poses: a checkpoint belongs to these and no others."""
    digest = hashlib.sha256()
    for part in (views.images_srgb, views.coverage, *(camera.camera_from_world for camera in views.cameras)):
        digest.update(part.contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]


def _found_masks(views, points, fit_settings, device, work, identity, resume, reporter, stop_now) -> Views:
    """find_masks, kept in `work`."""
    path = work / MASKS
    if resume and path.exists():
        tensors, facts = read_tensors(path, torch.device("cpu"))
        _same_build(facts, identity, path)
        return replace(views, coverage=tensors["coverage"], has_masks=True)

    def report(r: FitReport, _state: FitState) -> None:
        reporter.report("read", r.iteration / r.iterations, "no masks: looking for the object", r)

    masked = find_masks(views, points, fit_settings, device, report, stop_now)
    if masked is None:
        raise BuildStopped
    write_tensors(path, {"coverage": masked.coverage}, identity)
    return masked


def _points_of_found_masks(masked: Views, points: InitialPoints, count: int, seed: int) -> InitialPoints:
    """Points on the found masks' hull; the given ones where the masks have none."""
    try:
        return initial_points(masked, count, seed)
    except ValueError:  # a first guess may be wrong where the user's own masks may not: the fit then starts from random points
        return points


def _stage_one(views, points, fit_settings, device, work, identity, resume, reporter, stop_now) -> FitState:
    """fit_gaussians with checkpoints in `work`."""
    path = work / "stage1.safetensors"
    state = start_fit(points, fit_settings, device, views.has_masks)
    if resume and path.exists():
        tensors, facts = read_tensors(path, device)
        _same_build(facts, identity, path)
        restore_fit(tensors, state.parameters, state.optimizer, state.generator)
        state.iteration = facts["iteration"]
        state.pull = Pull(tensors["pull.total"].clone(), tensors["pull.seen"].clone())

    def save() -> None:
        tensors = fit_tensors(state.parameters, state.optimizer, state.generator)
        pull = {"pull.total": state.pull.total, "pull.seen": state.pull.seen}
        write_tensors(path, tensors | pull, identity | {"iteration": state.iteration})

    def preview() -> bytes:
        with torch.no_grad():
            camera = _preview_camera(views.cameras).to(device)
            tables = filter_environment(environment_table(state.parameters))
            maps = render_stage_one(state.parameters, tables, camera, 0.01 * points.bounds_radius, fit_settings.sh_degree)
            return encode_preview(maps.radiance_linear, maps.coverage)

    def report(r: FitReport, _state: FitState) -> None:
        reporter.report("fit", r.iteration / r.iterations, f"{r.surfels} surfels", r, preview, save)

    if state.iteration < fit_settings.iterations:
        fit_gaussians(views, state, fit_settings, points.bounds_radius, report, stop_now)
        save()
    if state.iteration < fit_settings.iterations:
        raise BuildStopped
    return state


def _mesh_stage(views, points, fit, mesh_settings, work, identity, resume) -> tuple[Gaussians, TriangleMesh]:
    """The surfels that cameras see and the mesh around them, kept in `work`."""
    path = work / "mesh.safetensors"
    device = fit.parameters["centers"].device
    if resume and path.exists():
        gaussians, mesh, facts = read_geometry(path, device)
        _same_build(facts, identity, path)
        return gaussians, mesh
    gaussians = drop_unseen(gaussians_from_state(fit), views.cameras, points.bounds_radius)
    mesh = mesh_from_gaussians(gaussians, views.cameras, points, mesh_settings)
    tensors = {f"{type(record).__name__}.{name}": value for record in (gaussians, mesh) for name, value in vars(record).items()}
    write_tensors(path, tensors, identity)
    return gaussians, mesh


def read_geometry(path: Path, device: torch.device) -> tuple[Gaussians, TriangleMesh, dict]:
    """What the stage `mesh` left: the surfels that cameras see, the mesh, and of which build they are.

    Raises:
        ValueError: the file is damaged.
    """
    tensors, facts = read_tensors(path, device)
    gaussians, mesh = (
        record(*(tensors[f"{record.__name__}.{name}"] for name in record.__dataclass_fields__)) for record in (Gaussians, TriangleMesh)
    )
    return gaussians, mesh, facts


def _bind_stage(views, gaussians, fit, mesh, radius, bind_settings, work, identity, resume, reporter, stop_now) -> MeshFitState:
    """mesh_surfels and fit_mesh_surfels with a checkpoint in `work`."""
    path = work / "mesh_surfels.safetensors"
    state = start_mesh_fit(*mesh_surfels(gaussians, mesh), mesh, fit.parameters, bind_settings)
    if resume and path.exists():
        tensors, facts = read_tensors(path, mesh.vertices.device)
        _same_build(facts, identity, path)
        restore_fit(tensors, state.parameters, state.optimizer, state.generator)
        state.iteration = facts["iteration"]

    def save() -> None:
        write_tensors(path, fit_tensors(state.parameters, state.optimizer, state.generator), identity | {"iteration": state.iteration})

    def preview() -> bytes:
        with torch.no_grad():
            camera = _preview_camera(views.cameras).to(mesh.vertices.device)
            tables = filter_environment(environment_table(state.parameters))
            maps = render_stage_one(surfels_on_faces(state), tables, camera, 0.01 * radius, bind_settings.losses.sh_degree)
            return encode_preview(maps.radiance_linear, maps.coverage)

    def report(r: FitReport, _state: MeshFitState) -> None:
        reporter.report("bind", r.iteration / r.iterations, f"{r.surfels} surfels on faces", r, preview, save)

    if state.iteration < bind_settings.iterations:
        fit_mesh_surfels(views, state, bind_settings, radius, report, stop_now)
        save()
    if state.iteration < bind_settings.iterations:
        raise BuildStopped
    return state


def _stage_two(views, gaussians, light, mesh, radius, material_settings, path, identity, resume, reporter, stop_now) -> MaterialState:
    """fit_materials with its checkpoint at `path`; `light` are the parameters of the fit before."""
    if "binding" in identity:  # a surfel never leaves its face
        material_settings = replace(material_settings, rates=replace(material_settings.rates, centers=0.0))
    state = start_materials(gaussians, light, mesh, material_settings, radius)
    if resume and path.exists():
        tensors, facts = read_tensors(path, mesh.vertices.device)
        _same_build(facts, identity, path)
        restore_fit(tensors, state.parameters, state.optimizer, state.generator)
        state.iteration = facts["iteration"]

    def save() -> None:
        write_tensors(path, fit_tensors(state.parameters, state.optimizer, state.generator), identity | {"iteration": state.iteration})

    def report(r: FitReport, _state: MaterialState) -> None:
        reporter.report("materials", r.iteration / r.iterations, "materials and light", r, None, save)

    if state.iteration < material_settings.iterations:
        fit_materials(views, mesh, state, material_settings, radius, report, stop_now)
        save()
    if state.iteration < material_settings.iterations:
        raise BuildStopped
    return state


def _same_build(facts: dict, identity: dict, path: Path) -> None:
    found = {key: facts.get(key) for key in identity}
    if found != identity:
        raise ValueError(
            f"the checkpoint {path} is of another build (found {found}, expected {identity}); delete its folder or choose another OUT"
        )


def _preview_camera(cameras: tuple[Camera, ...]) -> Camera:
    camera = cameras[0]
    return scaled_camera(camera, min(1.0, PREVIEW_SIDE / max(camera.width, camera.height)))


def drop_unseen(gaussians: Gaussians, cameras: tuple[Camera, ...], radius: float, least_weight: float = 0.02) -> Gaussians:
    """Without the surfels that no camera sees with a blending weight above `least_weight`: what hides inside would only cast shadows."""
    return chosen_surfels(gaussians, seen_surfels(gaussians, cameras, radius, least_weight))


def seen_surfels(gaussians: Gaussians, cameras: tuple[Camera, ...], radius: float, least_weight: float = 0.02) -> Tensor:
    """(surfel,) whether some camera sees the surfel with a blending weight above `least_weight`."""
    weight = torch.zeros(len(gaussians.centers), 1, device=gaussians.centers.device)
    tangents, opacities = surfel_tangents(gaussians), torch.sigmoid(gaussians.opacity_logits)
    for camera in cameras:
        # The gradient of sum_p w(p) f with respect to f is the surfel's total weight in the picture.
        feature = torch.zeros_like(weight, requires_grad=True)
        maps = rasterize(
            gaussians.centers, tangents, opacities, feature, camera.to(weight.device), RasterSettings(0.01 * radius, depth=False)
        )
        weight = torch.maximum(weight, torch.autograd.grad(maps.features.sum(), feature)[0])
    return weight[:, 0] > least_weight


def chosen_surfels(record: Surfels, kept: Tensor) -> Surfels:
    """The entries of a record whose every field is by surfel, where `kept` (surfel,) is True."""
    return type(record)(*(getattr(record, entry.name)[kept] for entry in fields(record)))


def reduced_mesh(mesh: TriangleMesh, face_limit: int, radius: float) -> TriangleMesh:
    """The mesh with at most `face_limit` faces, grey again where its vertices are new."""
    if len(mesh.faces) <= face_limit:
        return mesh
    settings = MeshSettings(smoothing_passes=0, face_limit=face_limit)
    return _grey_mesh(*clean_mesh(mesh.vertices, mesh.faces, settings, shortest_edge=1e-5 * radius))


def mesh_from_gaussians(gaussians: Gaussians, cameras: tuple[Camera, ...], points: InitialPoints, settings: MeshSettings) -> TriangleMesh:
    """Fuse the median depth of every training view (mean depth draws a second sheet between two surfaces)."""
    tangents, opacities = surfel_tangents(gaussians), torch.sigmoid(gaussians.opacity_logits)
    empty = torch.zeros(len(gaussians.centers), 1, device=gaussians.centers.device)
    maps = []
    for camera in cameras:
        drawn = rasterize(
            gaussians.centers, tangents, opacities, empty, camera.to(empty.device), RasterSettings(0.01 * points.bounds_radius)
        )
        maps.append(DepthMap(camera.to(empty.device), drawn.median_depth, drawn.coverage))
    return _grey_mesh(*extract_mesh(maps, points.bounds_center, points.bounds_radius, settings))


def _grey_mesh(vertices: Tensor, faces: Tensor) -> TriangleMesh:
    """Shape alone; bake_materials gives it its materials."""
    grey = torch.full((len(vertices),), 0.5, device=vertices.device)
    return TriangleMesh(vertices, faces, vertex_normals(vertices, faces), grey[:, None].repeat(1, 3), grey, torch.zeros_like(grey))


def _thumbnail(materials: MaterialState, cameras: tuple[Camera, ...]) -> bytes:
    from drgs.build.fit_materials import render_stage_two

    with torch.no_grad():
        camera = _preview_camera(cameras).to(materials.parameters["centers"].device)
        maps = render_stage_two(materials.parameters, camera, 0.01)
        return encode_preview(maps.splat_radiance, maps.coverage)
