"""A capture becomes an asset: read, fit surfels and light, extract the mesh, fit materials, bake, write.

Reads like the method: each step is a function of its own file, each stage with what it keeps in `stages.py`; here they meet. Checkpoints live in OUT.build/ beside the asset; a build that was stopped or killed goes on from the last one.
"""

import time
from collections.abc import Callable, Generator, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import UInt8
from torch import Tensor

from drgs.brief_waits import brief_waits_where_crowded
from drgs.exchange.photographs import encode_photographs
from drgs.reconstruct.build_settings import BuildSettings, check_settings
from drgs.reconstruct.capture.build_box import whole_or_within
from drgs.reconstruct.capture.cut_to_box import views_of
from drgs.reconstruct.capture.exposures import with_gains_of_fit
from drgs.reconstruct.capture.find_masks import masked_by_surfels
from drgs.reconstruct.capture.initial_points import InitialPoints
from drgs.reconstruct.capture.load_views.capture import Capture
from drgs.reconstruct.capture.look_nearer import look_nearer, object_windows
from drgs.reconstruct.capture.sharpen_masks import sharpen_masks
from drgs.reconstruct.capture.turn_up import UP
from drgs.reconstruct.facts_of_views import facts_of_views
from drgs.reconstruct.fit.evidence.photographs_as_taken import PhotographsAsTaken
from drgs.reconstruct.fit.evidence.register_cameras import moved_pixels, seen_from
from drgs.reconstruct.fit.evidence.solve_albedo import RINGS, parts_for, solve_albedo
from drgs.reconstruct.fit.evidence.vertex_certainty import vertex_certainty
from drgs.reconstruct.fit.fit_loop import FitState
from drgs.reconstruct.fit.light.environment_pyramid import environment_table
from drgs.reconstruct.fit.light.ground_light import fitted_ground, ground_light
from drgs.reconstruct.fit.light.split_sum import filter_environment
from drgs.reconstruct.fit.light.turned_light import light_of_views, seen_sky
from drgs.reconstruct.fit.surface.fit_mesh_materials import light_without_ground
from drgs.reconstruct.fit.surface.surface_passes import SurfaceFit
from drgs.reconstruct.fit.surfels.fit_gaussians import drawn_object, gaussians_from_state
from drgs.reconstruct.fit.surfels.fit_materials import gaussians_from_materials
from drgs.reconstruct.fit.surfels.fit_mesh_surfels import gaussians_from_mesh_fit
from drgs.reconstruct.fit.view_targets import whole_targets
from drgs.reconstruct.geometry.bake_materials import bake_materials
from drgs.reconstruct.geometry.bind_gaussians import bind_gaussians, points_from_binding
from drgs.reconstruct.geometry.divide_faces import divided_binding
from drgs.reconstruct.geometry.extract_mesh import mesh_report
from drgs.reconstruct.geometry.face_surfels import radiating_surfels, surfels_on_faces_of
from drgs.reconstruct.geometry.mesh_edges import mesh_edges
from drgs.reconstruct.geometry.mesh_from_gaussians import chosen_surfels, reduced_mesh, seen_surfels
from drgs.reconstruct.geometry.mesh_surfels import mesh_surfels
from drgs.reconstruct.geometry.order_in_space import order_in_space
from drgs.reconstruct.outline_agreement import complaint, outline_agreement
from drgs.reconstruct.presets import PRESETS, Preset
from drgs.reconstruct.progress import STAGE_SHARES, BuildStopped, Progress
from drgs.reconstruct.read_photographs import read_photographs
from drgs.reconstruct.report_progress import BuildReporter
from drgs.reconstruct.stages import (
    Workplace,
    bind_stage,
    fit_stage,
    mesh_materials_stage,
    mesh_stage,
    stage_two_preview,
    surface_preview,
    surface_stage,
    surfel_materials_stage,
)
from drgs.render.intersect.horizon import find_horizons, stored_horizons
from drgs.render.intersect.trace_rays import build_tracer
from drgs.render.intersect.tracer import mesh_extent
from drgs.scene.asset import Asset, save_asset
from drgs.scene.certainty import Certainty
from drgs.scene.environment import Environment
from drgs.scene.gaussians import Gaussians
from drgs.scene.mesh import TriangleMesh
from drgs.scene.strokes import plain_strokes
from drgs.scene.views import Views
from drgs.warp_torch import device_from_name


def build_asset(
    dataset: Path,
    out: Path,
    settings: BuildSettings,
    progress: Callable[[Progress], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
    previews: bool = True,
) -> Asset:
    """Build an asset folder from a capture.

    Args:
        dataset: a capture folder (see load_views), a folder of pictures without cameras, or a film: those are posed first (drgs/reconstruct/pose).
        out: the asset folder to write; OUT.build/ beside it holds checkpoints.
        should_stop: asked between steps; when true the checkpoint is written and BuildStopped raised.
        previews: False: `progress` is told without pictures, for whom shows none.

    Raises:
        ValueError: the capture, a setting or a checkpoint is wrong, in one sentence.
        BuildStopped: as asked.
    """
    with brief_waits_where_crowded():
        *_, (_, asset) = build_stages(dataset, out, settings, progress, should_stop, previews)
    assert asset is not None
    return asset


def build_stages(
    dataset: Path,
    out: Path,
    settings: BuildSettings,
    progress: Callable[[Progress], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
    previews: bool = True,
) -> Iterator[tuple[str, Asset | None]]:
    """build_asset in stages: gives the name of each as it is finished, its result on disk, and with the last one the asset.

    On `resume`, finished stages are skipped; only the capture is read again.
    """
    check_settings(settings, out)
    seconds: dict[str, float] = {}
    reporter = BuildReporter(progress, STAGE_SHARES[settings.binding], previews)
    device = device_from_name(settings.device)

    @contextmanager
    def timed(stage: str) -> Iterator[None]:
        started = time.monotonic()
        yield
        seconds[stage] = round(time.monotonic() - started, 2)

    with timed("read"):
        read = read_photographs(dataset, out, settings, PRESETS[settings.preset], device, reporter, should_stop)
    place, views, photographs, points, preset = read.place, read.views, read.photographs, read.points, read.preset
    yield "read", None

    with timed("fit"):
        fit = fit_stage(place, views, points, replace(preset.fit, seed=settings.seed), device)
        if not views.has_masks:
            views = _masked_by_fit(fit, read.capture, views, points, preset, settings)
            photographs = replace(views_of(photographs, views), cameras=views.cameras, images_srgb=views.images_srgb)
        views = with_gains_of_fit(views, drawn_object(fit, points.bounds_radius, preset.fit.sh_degree))
    yield "fit", None

    with timed("mesh"):
        reporter.report("mesh", 0.0, "extracting the mesh")
        gaussians, mesh = mesh_stage(place, views, points, fit, preset.mesh, settings.box)
    yield "mesh", None
    if place.should_stop():
        raise BuildStopped

    built = _Built(place, read.capture, views, points, preset, settings, fit, gaussians, mesh, timed)
    asset, thumbnail, views = yield from _on_mesh(built) if preset.materials_on == "mesh" else _on_surfels(built)
    agreement = outline_agreement(asset.mesh, views)
    provenance = {"source": views.source, "dataset": dataset.name} | _provenance(settings, device, asset.mesh, seconds)
    provenance |= read.facts | {"outline_agreement": round(agreement, 4)} | facts_of_views(views)
    provenance["light"] = {key: value for key, value in asdict(read.light).items() if value is not None}
    asset = replace(asset, provenance=provenance, cameras=views.cameras, light_frame=read.light.frame)
    save_asset(asset, out, thumbnail, kept_photographs(photographs))
    reporter.report("pack", 1.0, "; ".join(filter(None, ("done", complaint(agreement)))))
    yield "pack", asset


def _masked_by_fit(fit: FitState, capture: Capture, views: Views, points: InitialPoints, preset: Preset, settings: BuildSettings) -> Views:
    """Views without masks, masked by what stage 1 has fitted, and nearer (look_nearer); with the ground, where there is one, as it was fitted: the surface and its
    materials see it as light."""
    ground, sharpen = views.ground, settings.masks == "auto"
    views = masked_by_surfels(views, gaussians_from_state(fit), points.bounds_radius, settings.box)
    views = sharpen_masks(views) if sharpen else views
    windows = object_windows(capture, views, preset.image_side)
    views = views if windows is None else look_nearer(capture, views, windows, False, sharpen)
    return views if ground is None else replace(views, ground=fitted_ground(fit.parameters["ground"], ground))


@dataclass(frozen=True, eq=False)
class _Built:
    """What the stages up to `mesh` gave, and what those after it need."""

    place: Workplace
    capture: Capture
    views: Views
    """Of it, as the fits see them."""
    points: InitialPoints
    preset: Preset
    settings: BuildSettings
    fit: FitState
    gaussians: Gaussians
    mesh: TriangleMesh
    """As it was extracted."""
    timed: Callable[[str], AbstractContextManager[None]]

    @property
    def radius(self) -> float:
        """Of the object's bounding sphere [world units]."""
        return self.points.bounds_radius

    @property
    def materials_preset(self) -> Preset:
        """By which material and light are separated."""
        return self.preset if self.settings.materials is None else PRESETS[self.settings.materials]

    def materials_place(self, place: Workplace) -> Workplace:
        """`place` for the stage `materials`."""
        return place if self.settings.materials is None else place.of(materials=self.settings.materials)


def _on_mesh(built: _Built) -> Generator[tuple[str, None], None, tuple[Asset, bytes, Views]]:
    """The mesh becomes the surface that the photographs show, its materials are fitted on it, and surfels are laid on its faces. The views have their cameras
    where these were moved to."""
    place, views, seed, timed = built.place, built.views, built.settings.seed, built.timed
    with timed("surface"):
        passes = built.preset.surface
        moves = replace(passes.surface.moves, texture_radius=built.radius, box=built.settings.box)
        passes = replace(passes, surface=replace(passes.surface, seed=seed, moves=moves))
        passes = passes if built.settings.cameras == "auto" else replace(passes, cameras_after=())
        surface = surface_stage(place, views, built.gaussians, built.mesh, built.fit.parameters, built.radius, passes)
        built = _seen_from(built, surface)
        views = built.views
        order = order_in_space(surface.mesh)  # before materials move it a little: whoever fits them anew gets the same faces
    yield "surface", None

    bound = None
    if built.settings.binding == "mesh":
        with timed("bind"):
            bind_settings = replace(built.preset.mesh_surfels, seed=seed)
            under = surface.undivided_mesh
            on_faces = surfels_on_faces_of(under)
            light = surface.state.parameters
            bound = bind_stage(place.of(binding="mesh"), views, on_faces, under, light, built.radius, bind_settings)
        yield "bind", None

    with timed("materials"):
        materials_settings = built.materials_preset.materials
        moves = replace(materials_settings.moves, box=built.settings.box)
        materials_settings = replace(materials_settings, seed=seed, moves=moves)
        decoupled = mesh_materials_stage(built.materials_place(place), views, surface, built.radius, materials_settings)
    yield "materials", None

    with timed("pack"):
        place.reporter.report("pack", 0.0, "writing the asset")
        # Meshing anew rounds the box's edges, a little to either side.
        vertices = decoupled.state.parameters["vertices"]
        vertices.data = whole_or_within(built.settings.box, vertices.data)
        mesh, certainty = _detailed(built, decoupled)
        under, environment = decoupled.undivided_mesh, _environment(built, decoupled)
        # Faces moved once more with the materials; surfels stay where they are on them: one on each face of before the division.
        surfels, binding = surfels_on_faces_of(under) if bound is None else gaussians_from_mesh_fit(replace(bound, mesh=under))
        for times in range(decoupled.divided):
            binding = divided_binding(binding, len(under.faces) * 4**times)
        surfels = replace(surfels, centers=points_from_binding(binding, mesh.vertices, mesh.faces))
        mesh, certainty, binding = order.of_mesh(mesh), order.of_certainty(certainty), order.of_binding(binding)
        along = torch.argsort(binding.face)
        surfels, binding = chosen_surfels(surfels, along), chosen_surfels(binding, along)
        surfels = radiating_surfels(surfels, binding, mesh, environment)
        asset = Asset(surfels, mesh, binding, environment, horizons=_horizons(mesh), primary="mesh", certainty=certainty)
    return asset, surface_preview(decoupled, views.cameras), views


def _environment(built: _Built, fit: SurfaceFit) -> Environment:
    """The light that was fitted; where there is a ground, one for pictures without it."""
    if built.views.ground is None:
        return Environment(environment_table(fit.state.parameters).detach())
    settings = replace(built.materials_preset.materials, seed=built.settings.seed)
    return Environment(light_without_ground(built.views, fit.faces, fit.state, built.points.bounds_center, settings, built.radius))


def _seen_from(built: _Built, surface: SurfaceFit) -> _Built:
    """With views and capture from where the surface's fit has their cameras."""
    if surface.camera_from_world is None:
        return built
    views = seen_from(built.views, surface.camera_from_world)
    views = replace(views, cameras_moved=moved_pixels(built.views, views, surface.mesh.vertices[::100].cpu()))
    moved = {camera.name: transform for camera, transform in zip(views.cameras, surface.camera_from_world.numpy(), strict=True)}
    photographs = tuple(
        replace(photograph, camera_from_world=moved.get(photograph.name, photograph.camera_from_world))
        for photograph in built.capture.photographs
    )
    return replace(built, views=views, capture=replace(built.capture, photographs=photographs))


def _on_surfels(built: _Built) -> Generator[tuple[str, None], None, tuple[Asset, bytes, Views]]:
    """The paper's way: materials of the surfels, by rays from where they lie; the mesh takes them over."""
    place, views, seed, timed = built.place, built.views, built.settings.seed, built.timed
    gaussians, mesh, light, binding = built.gaussians, built.mesh, built.fit.parameters, None
    yield "surface", None
    if built.settings.binding == "mesh":
        with timed("bind"):
            place = place.of(binding="mesh")
            mesh = reduced_mesh(mesh, built.preset.fit.densify.budget, built.radius)
            bind_settings = replace(built.preset.mesh_surfels, seed=seed)
            bound = bind_stage(place, views, mesh_surfels(gaussians, mesh), mesh, light, built.radius, bind_settings)
            gaussians, binding = gaussians_from_mesh_fit(bound)
            seen = seen_surfels(gaussians, views.cameras, built.radius)
            gaussians, binding, light = chosen_surfels(gaussians, seen), chosen_surfels(binding, seen), bound.fit.parameters
        yield "bind", None

    with timed("materials"):
        material_settings = replace(built.materials_preset.surfel_materials, seed=seed)
        materials = surfel_materials_stage(built.materials_place(place), views, gaussians, light, mesh, built.radius, material_settings)
    yield "materials", None

    with timed("pack"):
        place.reporter.report("pack", 0.0, "baking materials and writing the asset")
        gaussians = gaussians_from_materials(materials)
        baked = bake_materials(mesh, gaussians)
        bound_to = bind_gaussians(gaussians.centers, baked) if binding is None else binding  # where they were fitted, or on their faces
        environment = Environment(environment_table(materials.parameters).detach())
        asset = Asset(gaussians, baked, bound_to, environment, horizons=_horizons(baked))
    return asset, stage_two_preview(materials.parameters, views.cameras, built.radius), views


def _horizons(mesh: TriangleMesh) -> UInt8[Tensor, "face 8"]:
    return stored_horizons(find_horizons(mesh, mesh_extent(mesh)[1]))


@torch.no_grad()
def _detailed(built: _Built, fit: SurfaceFit) -> tuple[TriangleMesh, Certainty]:
    """The fitted mesh with the albedo that photographs show at each of its vertices, and between them; how certain it is."""
    views, mesh, parameters = built.views, fit.mesh, fit.state.parameters
    tracer, targets = build_tracer(mesh), whole_targets(views, mesh.vertices.device)
    sky = None if views.light_from_world is None else seen_sky(tracer)
    ground = None if views.ground is None else ground_light(views.ground, mesh.vertices.device)
    light_of = light_of_views(filter_environment(environment_table(parameters)), parameters["open_share"], mesh.albedo, sky, ground=ground)
    certainty = vertex_certainty(tracer, targets, light_of, parameters["metal"])
    edges, rings = mesh_edges(mesh.faces), RINGS * 4**fit.divided
    settings = built.preset.detail
    photographs = PhotographsAsTaken(built.capture, views, targets, settings.side)
    parts = parts_for(mesh, photographs.cameras, settings)
    solved = solve_albedo(tracer, targets, photographs.target, light_of, edges, rings, parts)
    return replace(mesh, albedo=solved.albedo, detail=solved.detail), certainty


def _provenance(settings: BuildSettings, device: torch.device, mesh: TriangleMesh, seconds: dict[str, float]) -> dict[str, Any]:
    """How the asset came about; `seconds` goes in as it is, for packing takes its own."""
    return {
        "preset": settings.preset,
        "binding": settings.binding,
        "materials": settings.materials or settings.preset,
        "materials_on": PRESETS[settings.preset].materials_on,
        "seed": settings.seed,
        **({"up": list(settings.up)} if settings.up != UP else {}),
        **({"box": [list(settings.box.low), list(settings.box.high)]} if settings.box is not None else {}),
        **({"strokes": plain_strokes(settings.strokes)} if settings.strokes else {}),
        "device": str(device),
        "torch": torch.__version__,
        "mesh": asdict(mesh_report(mesh.vertices, mesh.faces)),
        "seconds": seconds,
    }


def kept_photographs(views: Views) -> bytes:
    """Small copies for comparing by eye, cut out where the capture has masks of its own: ones that the build found are a guess."""
    pictures = views.images_srgb
    if views.has_masks:
        pictures = tuple(torch.cat([image, mask[..., None]], -1) for image, mask in zip(pictures, views.coverage, strict=True))
    return encode_photographs([picture.numpy() for picture in pictures])
