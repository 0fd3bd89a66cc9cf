"""A capture becomes an asset: read, fit surfels and light, extract the mesh, fit materials, bake, write.

Reads like the method: each step is a function of its own file, each stage with what it keeps in `stages.py`; here they meet, with presets. Checkpoints live in OUT.build/ beside the asset; a build that was stopped or killed goes on from the last one.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import torch

from drgs.exchange.photographs import encode_photographs
from drgs.reconstruct.capture.find_masks import with_drawn_masks
from drgs.reconstruct.capture.initial_points import initial_points
from drgs.reconstruct.capture.load_views import load_views
from drgs.reconstruct.fit.densify import DensifySettings
from drgs.reconstruct.fit.environment_pyramid import environment_table
from drgs.reconstruct.fit.fit_gaussians import FitSettings, gaussians_from_state
from drgs.reconstruct.fit.fit_loop import FitState
from drgs.reconstruct.fit.fit_materials import MaterialSettings, gaussians_from_materials
from drgs.reconstruct.fit.fit_mesh_surfels import MeshFitSettings, gaussians_from_mesh_fit
from drgs.reconstruct.geometry.bake_materials import bake_materials
from drgs.reconstruct.geometry.bind_gaussians import bind_gaussians
from drgs.reconstruct.geometry.extract_mesh import FAST_MESH, FULL_MESH, MeshSettings, mesh_report
from drgs.reconstruct.geometry.mesh_from_gaussians import chosen_surfels, reduced_mesh, seen_surfels
from drgs.reconstruct.progress import STAGE_SHARES, Progress
from drgs.reconstruct.report_progress import BuildReporter
from drgs.reconstruct.stages import (
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
    stage_two_preview,
)
from drgs.render.intersect.horizon import find_horizons, stored_horizons
from drgs.render.intersect.tracer import mesh_extent
from drgs.render.records import SampleCounts
from drgs.scene.asset import Asset, save_asset
from drgs.scene.binding import Binding
from drgs.scene.camera import Camera
from drgs.scene.environment import Environment
from drgs.scene.mesh import TriangleMesh
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


BINDINGS = tuple(STAGE_SHARES)
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

    On `resume`, finished stages are skipped; only the capture is read again.
    """
    _check(settings)
    preset = PRESETS[settings.preset]
    device = device_from_name(settings.device)
    seconds: dict[str, float] = {}
    on_mesh = settings.binding == "mesh"
    reporter = BuildReporter(progress, STAGE_SHARES[settings.binding])

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
            views = with_drawn_masks(views, gaussians_from_state(fit), points.bounds_radius)
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
            gaussians, binding, light = chosen_surfels(gaussians, seen), chosen_surfels(binding, seen), bound.fit.parameters
        yield "bind", None

    with timed("materials"):
        material_settings = replace(PRESETS[settings.materials or settings.preset].materials, seed=settings.seed)
        if settings.materials is not None:
            place = place.of(materials=settings.materials)
        materials = materials_stage(place, views, gaussians, light, mesh, points.bounds_radius, material_settings)
    yield "materials", None

    with timed("pack"):
        reporter.report("pack", 0.0, "baking materials and writing the asset")
        origin = {"source": views.source, "dataset": dataset.name}
        asset = _packed(materials, mesh, binding, views.cameras, origin | _provenance(settings, device, mesh, seconds))
    thumbnail = stage_two_preview(materials.parameters, views.cameras, points.bounds_radius)
    save_asset(asset, out, thumbnail, kept_photographs(photographs))
    reporter.report("pack", 1.0, "done")
    yield "pack", asset


def _check(settings: BuildSettings) -> None:
    for name in (settings.preset, settings.materials or settings.preset):
        if name not in PRESETS:
            raise ValueError(f"preset {name!r} is unknown; expected one of {', '.join(PRESETS)}")
    if settings.binding not in BINDINGS:
        raise ValueError(f"binding {settings.binding!r} is unknown; expected one of {', '.join(BINDINGS)}")


def _packed(
    materials: FitState, mesh: TriangleMesh, binding: Binding | None, cameras: tuple[Camera, ...], provenance: dict[str, Any]
) -> Asset:
    """The asset of what the stages left. Without a binding, surfels are bound where they were fitted."""
    gaussians = gaussians_from_materials(materials)
    baked = bake_materials(mesh, gaussians)
    return Asset(
        gaussians=gaussians,
        mesh=baked,
        binding=bind_gaussians(gaussians.centers, baked) if binding is None else binding,
        environment=Environment(environment_table(materials.parameters).detach()),
        cameras=cameras,
        provenance=provenance,
        horizons=stored_horizons(find_horizons(baked, mesh_extent(baked)[1])),
    )


def _provenance(settings: BuildSettings, device: torch.device, mesh: TriangleMesh, seconds: dict[str, float]) -> dict[str, Any]:
    """How the asset came about; `seconds` goes in as it is, for packing takes its own."""
    return {
        "preset": settings.preset,
        "binding": settings.binding,
        "materials": settings.materials or settings.preset,
        "seed": settings.seed,
        "device": str(device),
        "torch": torch.__version__,
        "mesh": asdict(mesh_report(mesh.vertices, mesh.faces)),
        "seconds": seconds,
    }


def kept_photographs(views: Views) -> bytes:
    """Small copies for comparing by eye, cut out where the capture has masks of its own: ones that the build found are a guess."""
    pictures = torch.cat([views.images_srgb, views.coverage[..., None]], -1) if views.has_masks else views.images_srgb
    return encode_photographs([picture.numpy() for picture in pictures])
