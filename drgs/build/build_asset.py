"""A capture becomes an asset: read, fit surfels and light, extract the mesh, fit materials, bake, write.

Reads like the method: each step is a function of its own file, each stage with what it keeps in `durable_stages.py`; here they meet, with
presets. Checkpoints live in OUT.build/ beside the asset; a build that was stopped or killed goes on from the last one.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import torch

from drgs.build.bake_materials import bake_materials
from drgs.build.bind_gaussians import bind_gaussians
from drgs.build.densify import DensifySettings
from drgs.build.durable_stages import (
    BuildStopped,
    Workplace,
    bind_stage,
    capture_digest,
    fit_stage,
    forget_checkpoints,
    masks_stage,
    materials_stage,
    mesh_stage,
    points_of_found_masks,
    preview_camera,
)
from drgs.build.extract_mesh import FAST_MESH, FULL_MESH, MeshSettings, mesh_report
from drgs.build.find_masks import with_drawn_masks
from drgs.build.fit_gaussians import FitSettings, environment_table, gaussians_from_state
from drgs.build.fit_materials import MaterialSettings, MaterialState, gaussians_from_materials, render_stage_two
from drgs.build.fit_mesh_surfels import MeshFitSettings, gaussians_from_mesh_fit
from drgs.build.initial_points import initial_points
from drgs.build.load_views import load_views
from drgs.build.mesh_from_gaussians import chosen_surfels, reduced_mesh, seen_surfels
from drgs.build.report_progress import BuildReporter, Progress, encode_preview
from drgs.exchange.photographs import encode_photographs
from drgs.render.horizon import find_horizons, stored_horizons
from drgs.render.sample_rays import SampleCounts
from drgs.render.tracer import mesh_extent
from drgs.scene.asset import Asset, save_asset
from drgs.scene.camera import Camera
from drgs.scene.environment import Environment
from drgs.scene.views import Views
from drgs.warp_torch import device_from_name


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
    seconds: dict[str, float] = {}
    on_mesh = settings.binding == "mesh"
    reporter = BuildReporter(progress, MESH_STAGE_SHARES if on_mesh else STAGE_SHARES)

    @contextmanager
    def timed(stage: str) -> Iterator[None]:
        started = time.monotonic()
        yield
        seconds[stage] = round(time.monotonic() - started, 2)

    with timed("read"):
        reporter.report("read", 0.0, "reading the capture")
        views = load_views(dataset, max_side=preset.image_side)
        photographs = views
        points = initial_points(views, preset.points, settings.seed)
        identity = {"preset": settings.preset, "seed": settings.seed, "capture": capture_digest(views)}
        place = Workplace(Path(f"{out}.build"), identity, settings.resume, reporter, should_stop or (lambda: False))
        if not settings.resume:
            forget_checkpoints(place)
        fit_settings = replace(preset.fit, seed=settings.seed)
        if not views.has_masks:
            masked = masks_stage(place, views, points, fit_settings, device)
            points = points_of_found_masks(masked, points, preset.points, settings.seed)
    yield "read", None

    with timed("fit"):
        fit = fit_stage(place, views, points, fit_settings, device)
        if not views.has_masks:
            views = with_drawn_masks(views, gaussians_from_state(fit), 0.01 * points.bounds_radius)
    yield "fit", None

    with timed("mesh"):
        reporter.report("mesh", 0.0, "extracting the mesh")
        gaussians, mesh = mesh_stage(place, views, points, fit, preset.mesh)
    yield "mesh", None
    if place.should_stop():
        raise BuildStopped

    light, binding = fit.parameters, None
    if on_mesh:
        with timed("bind"):
            place = place.of(binding="mesh")
            mesh = reduced_mesh(mesh, preset.fit.densify.budget, points.bounds_radius)
            bind_settings = replace(preset.mesh_surfels, seed=settings.seed)
            bound = bind_stage(place, views, gaussians, mesh, fit, points.bounds_radius, bind_settings)
            gaussians, binding = gaussians_from_mesh_fit(bound)
            seen = seen_surfels(gaussians, views.cameras, points.bounds_radius)
            gaussians, binding, light = chosen_surfels(gaussians, seen), chosen_surfels(binding, seen), bound.parameters
        yield "bind", None

    with timed("materials"):
        material_settings = replace(PRESETS[settings.materials or settings.preset].materials, seed=settings.seed)
        if settings.materials is not None:
            place = place.of(materials=settings.materials)
        materials = materials_stage(place, views, gaussians, light, mesh, points.bounds_radius, material_settings)
    yield "materials", None

    with timed("pack"):
        reporter.report("pack", 0.0, "baking materials and writing the asset")
        gaussians = gaussians_from_materials(materials)
        baked = bake_materials(mesh, gaussians)
        asset = Asset(
            gaussians=gaussians,
            mesh=baked,
            binding=bind_gaussians(gaussians.centers, baked) if binding is None else binding,
            environment=Environment(environment_table(materials.parameters).detach()),
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
            horizons=stored_horizons(find_horizons(baked, mesh_extent(baked)[1])),
        )
    save_asset(asset, out, _thumbnail(materials, views.cameras), kept_photographs(photographs))
    reporter.report("pack", 1.0, "done")
    yield "pack", asset


def kept_photographs(views: Views) -> bytes:
    """Small copies for comparing by eye, cut out where the capture has masks of its own: ones that the build found are a guess."""
    pictures = torch.cat([views.images_srgb, views.coverage[..., None]], -1) if views.has_masks else views.images_srgb
    return encode_photographs([picture.numpy() for picture in pictures])


def _thumbnail(materials: MaterialState, cameras: tuple[Camera, ...]) -> bytes:
    with torch.no_grad():
        camera = preview_camera(cameras).to(materials.parameters["centers"].device)
        maps = render_stage_two(materials.parameters, camera, 0.01)
        return encode_preview(maps.splat_radiance, maps.coverage)
