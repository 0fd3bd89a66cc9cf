"""The stages of a build, each with what it leaves in the build's folder: done again from there, it does not start anew.

Every stage takes the `Workplace` and what the stages before gave. What it leaves says of which build it is; what another build left is
refused. A stage that computes at once goes through `_kept_or_made`, a fit through `_checkpointed_fit`: told to stop, it writes its
checkpoint and raises BuildStopped. What the stages compute is in the steps' own files.
"""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from drgs.reconstruct.capture.build_box import BuildBox
from drgs.reconstruct.capture.cut_to_box import chosen_views
from drgs.reconstruct.capture.find_hollows import find_hollows
from drgs.reconstruct.capture.find_masks import find_masks
from drgs.reconstruct.capture.initial_points import InitialPoints, initial_points
from drgs.reconstruct.capture.on_ground.stands_on_ground import look_again, stands_on_ground
from drgs.reconstruct.capture.open_vessels import open_vessels
from drgs.reconstruct.capture.outside_masks import OutsideMasks
from drgs.reconstruct.capture.visual_hull import VisualHull, VisualHullSettings
from drgs.reconstruct.checkpoints import fit_tensors, read_tensors, restore_fit, write_tensors
from drgs.reconstruct.fit.fit_loop import FitReport, FitState
from drgs.reconstruct.fit.light.environment_pyramid import environment_table
from drgs.reconstruct.fit.light.mesh_light import MeshLight, corner_weights, hit_radiance
from drgs.reconstruct.fit.light.split_sum import filter_environment
from drgs.reconstruct.fit.surface.fit_mesh_materials import MeshMaterialSettings, fit_mesh_materials, start_mesh_materials
from drgs.reconstruct.fit.surface.fit_surface import start_surface
from drgs.reconstruct.fit.surface.surface_passes import PassSettings, SurfaceFit, fit_surface_in_passes
from drgs.reconstruct.fit.surfels.fit_gaussians import FitSettings, fit_gaussians, gaussians_from_state, start_fit
from drgs.reconstruct.fit.surfels.fit_materials import MaterialSettings, fit_materials, start_materials
from drgs.reconstruct.fit.surfels.fit_mesh_surfels import MeshFitSettings, MeshFitState, fit_mesh_surfels, start_mesh_fit, surfels_on_faces
from drgs.reconstruct.fit.surfels.render_stage_one import render_stage_one
from drgs.reconstruct.fit.surfels.render_stage_two import render_stage_two
from drgs.reconstruct.fit.surfels.try_light_frames import try_light_frames
from drgs.reconstruct.geometry.extract_mesh import MeshSettings
from drgs.reconstruct.geometry.mesh_from_gaussians import chosen_surfels, drop_unseen, mesh_from_gaussians
from drgs.reconstruct.presets import Preset
from drgs.reconstruct.progress import BuildStopped
from drgs.reconstruct.report_progress import BuildReporter, encode_preview
from drgs.render.intersect.trace_rays import build_tracer, trace_rays
from drgs.render.visible.rasterize.near_plane import near_plane
from drgs.scene.binding import Binding
from drgs.scene.camera import Camera, pixel_rays_world, scaled_camera
from drgs.scene.gaussians import Gaussians
from drgs.scene.ground import Ground
from drgs.scene.mesh import TriangleMesh
from drgs.scene.views import Views

MASKS = "masks.safetensors"
"""Of a capture that has none of its own."""
GROUND, GROUND_AGAIN = "ground.safetensors", "ground_again.safetensors"
"""What the object stands on, where it has no masks; and as the masks that were found show it."""
LIGHT = "light.safetensors"
"""Errors by light of the object and of the camera, where both had to be tried."""
HOLLOWS = "hollows.safetensors"
"""Points without the hull's hollows; those of the hull where it has none."""
FIT, MESH, SURFACE, MATERIALS = "stage1.safetensors", "mesh.safetensors", "surface.safetensors", "stage2.safetensors"
SURFELS_ON_MESH = "mesh_surfels.safetensors"
"""With binding mesh."""
SURFEL_MATERIALS, MATERIALS_OF_BOUND = "stage2_surfels.safetensors", "stage2_mesh.safetensors"
"""Where materials are fitted on surfels (Preset.materials_on): of particles, and of surfels bound to faces."""
CHECKPOINTS = (HOLLOWS, FIT, MESH, SURFACE, MATERIALS, SURFELS_ON_MESH, SURFEL_MATERIALS, MATERIALS_OF_BOUND)
PREVIEW_SIDE = 256
"""[pixels]"""


@dataclass(frozen=True, eq=False)
class Workplace:
    """Where a build keeps what its stages leave, whom it tells, and who may stop it."""

    folder: Path
    identity: dict[str, Any]
    """What tells this build from others, as far as the stages so far depend on it; checkpoints carry it."""
    resume: bool
    reporter: BuildReporter
    should_stop: Callable[[], bool]

    def of(self, **more: str) -> "Workplace":
        """The same for the stages that depend on more."""
        return replace(self, identity=self.identity | more)


def capture_digest(views: Views, box: BuildBox | None = None) -> str:
    """Hex digest of the photos, masks, poses and the box: a checkpoint belongs to these and no others."""
    digest = hashlib.sha256(b"" if box is None else repr(box).encode())
    for part in (*views.images_srgb, *views.coverage, *(camera.camera_from_world for camera in views.cameras)):
        digest.update(part.contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]


def forget_checkpoints(place: Workplace) -> None:
    """Else a later build that resumes would take them for this one's."""
    for stale in (GROUND, MASKS, GROUND_AGAIN, LIGHT, *CHECKPOINTS):
        (place.folder / stale).unlink(missing_ok=True)


def masks_stage(
    place: Workplace, views: Views, points: InitialPoints, settings: FitSettings, device: torch.device, box: BuildBox | None
) -> Views:
    """find_masks."""
    number_of = {camera.name: index for index, camera in enumerate(views.cameras)}

    def report(r: FitReport) -> None:
        place.reporter.report("read", r.iteration / r.iterations, "no masks: looking for the object", r)

    def found() -> dict[str, Tensor]:
        masked = find_masks(views, points, settings, device, report, place.should_stop, box)
        if masked is None:
            raise BuildStopped
        return {f"coverage.{number_of[camera.name]}": mask for camera, mask in zip(masked.cameras, masked.coverage, strict=True)}

    kept = _kept_or_made(place, MASKS, torch.device("cpu"), found)
    numbers = [number for number in range(len(views.cameras)) if f"coverage.{number}" in kept]
    return replace(chosen_views(views, numbers), coverage=tuple(kept[f"coverage.{number}"] for number in numbers), has_masks=True)


def ground_stage(place: Workplace, views: Views, seed: int) -> Views:
    """stands_on_ground; the very views where there is no ground."""

    def made() -> dict[str, Tensor]:
        place.reporter.report("read", 0.0, "no masks: looking for what the object stands on")
        found = stands_on_ground(views, seed, place.should_stop)
        if place.should_stop():
            raise BuildStopped
        return {"found": torch.zeros(1)} if found is None else {"found": torch.ones(1)} | _ground_tensors(found)

    kept = _kept_or_made(place, GROUND, torch.device("cpu"), made)
    return _with_ground(views, kept) if kept["found"] else views


def ground_again_stage(place: Workplace, views: Views, masked: Views, seed: int) -> tuple[Views, Views]:
    """look_again: both as they were where nothing is found any more.

    Args:
        views: of ground_stage, those with masks alone. masked: of masks_stage.
    """

    def made() -> dict[str, Tensor]:
        place.reporter.report("read", 1.0, "no masks: looking once more for what the object stands on")
        found = look_again(views, masked.coverage, seed, place.should_stop)
        if place.should_stop():
            raise BuildStopped
        if found is None:
            return {"found": torch.zeros(1)}
        return {"found": torch.ones(1)} | _ground_tensors(found[0]) | {f"mask.{number}": mask for number, mask in enumerate(found[1])}

    kept = _kept_or_made(place, GROUND_AGAIN, torch.device("cpu"), made)
    if not kept["found"]:
        return views, masked
    masks = tuple(kept[f"mask.{number}"] for number in range(len(masked.cameras)))
    return _with_ground(views, kept), replace(masked, coverage=masks)


def _ground_tensors(views: Views) -> dict[str, Tensor]:
    """What _with_ground reads."""
    assert views.ground is not None
    ground = {name: value for name, value in vars(views.ground).items() if isinstance(value, Tensor)}
    coverage = {f"coverage.{number}": mask for number, mask in enumerate(views.coverage)}
    return ground | {"half": torch.tensor([views.ground.half])} | coverage


def _with_ground(views: Views, kept: dict[str, Tensor]) -> Views:
    ground = Ground(kept["middle"], kept["axes"], float(kept["half"]), kept["color_srgb"], kept["known"])
    return replace(views, ground=ground, coverage=tuple(kept[f"coverage.{number}"] for number in range(len(views.cameras))))


def points_on_ground(
    views: Views, points: InitialPoints, count: int, seed: int, box: BuildBox | None, hull_settings: VisualHullSettings
) -> InitialPoints:
    """Points where the object may be; the given ones where no ground tells."""
    if views.ground is None:
        return points
    return points_of_found_masks(replace(views, has_masks=True), points, count, seed, box, hull_settings)


def points_of_found_masks(
    masked: Views, points: InitialPoints, count: int, seed: int, box: BuildBox | None, hull_settings: VisualHullSettings
) -> InitialPoints:
    """Points on the found masks' hull; the given ones where the masks have none."""
    try:
        return initial_points(masked, count, seed, box=box, hull_settings=hull_settings)
    except ValueError:  # a first guess may be wrong where the user's own masks may not: the fit then starts from random points
        return points


def light_stage(place: Workplace, views: Views, points: InitialPoints, seed: int, device: torch.device) -> tuple[float, float]:
    """try_light_frames."""

    def report(share: float) -> None:
        place.reporter.report("read", share, "trying light that turns with the camera")

    def made() -> dict[str, Tensor]:
        report(0.0)
        errors = try_light_frames(views, points, seed, device, report, place.should_stop)
        if errors is None:
            raise BuildStopped
        return {"errors": torch.tensor(errors, dtype=torch.float64)}

    of_object, of_camera = _kept_or_made(place, LIGHT, torch.device("cpu"), made)["errors"].tolist()
    return of_object, of_camera


def hollows_stage(
    place: Workplace, views: Views, points: InitialPoints, preset: Preset, seed: int, device: torch.device, box: BuildBox | None
) -> InitialPoints:
    """open_vessels and find_hollows: the points on the hull, moved to what the photographs show behind it. The bounds stay the hull's.

    Where the light turns with the camera no vessel is opened: they are told by colours as they are.
    """
    looks_for_any = preset.vessels.walls or preset.hollows.grid.levels
    if points.hull_vertices is None or points.hull_faces is None or points.normals_world is None or not looks_for_any:
        return points
    cell = 2 * points.bounds_radius / preset.hollows.chosen_mesh.resolution
    hull = VisualHull(points.hull_vertices.numpy(), points.hull_faces.numpy(), cell)

    def report(share: float) -> None:
        place.reporter.report("read", share, "looking for hollows")

    def made() -> dict[str, Tensor]:
        report(0.0)
        opened = hull if views.light_from_world is not None else open_vessels(views, hull, preset.vessels, device)
        looks_behind = bool(preset.hollows.grid.levels)
        surface = find_hollows(views, opened, preset.hollows, seed, device, report, place.should_stop) if looks_behind else opened
        if surface is None:
            raise BuildStopped
        found = points if surface is hull else initial_points(views, preset.points, seed, surface, box, preset.hull)
        assert found.normals_world is not None  # those of a surface
        return {"points": found.points_world, "normals": found.normals_world, "colors": found.colors_srgb}

    kept = _kept_or_made(place, HOLLOWS, torch.device("cpu"), made)
    return replace(points, points_world=kept["points"], normals_world=kept["normals"], colors_srgb=kept["colors"])


def fit_stage(place: Workplace, views: Views, points: InitialPoints, settings: FitSettings, device: torch.device) -> FitState:
    """fit_gaussians."""
    state, radius = start_fit(points, settings, device, views.has_masks, views.ground), points.bounds_radius
    _checkpointed_fit(
        place,
        FitStage(
            "fit",
            FIT,
            state,
            settings.iterations,
            lambda report: fit_gaussians(views, state, settings, radius, report, place.should_stop, points.bounds_center),
            lambda r: f"{r.elements} surfels",
            lambda: stage_one_preview(state.parameters, views.cameras, radius, settings.sh_degree),
        ),
    )
    return state


def mesh_stage(
    place: Workplace, views: Views, points: InitialPoints, fit: FitState, settings: MeshSettings, box: BuildBox | None
) -> tuple[Gaussians, TriangleMesh]:
    """The surfels that cameras see and the mesh around them; of both what the box holds."""

    def made() -> dict[str, Tensor]:
        gaussians = drop_unseen(gaussians_from_state(fit), views.cameras, points.bounds_radius)
        # Those outside still hide what is behind them.
        outside = OutsideMasks(views) if views.has_masks else None
        mesh = mesh_from_gaussians(gaussians, views.cameras, points, settings, box, outside)
        gaussians = gaussians if box is None else chosen_surfels(gaussians, box.holds(gaussians.centers))
        records = {"Gaussians": vars(gaussians), "TriangleMesh": mesh.columns}
        return {f"{record}.{name}": value for record, columns in records.items() for name, value in columns.items()}

    return _geometry(_kept_or_made(place, MESH, fit.parameters["centers"].device, made))


def read_geometry(path: Path, device: torch.device) -> tuple[Gaussians, TriangleMesh]:
    """What the stage `mesh` left: the surfels that cameras see, and the mesh.

    Raises:
        ValueError: the file is damaged.
    """
    return _geometry(read_tensors(path, device)[0])


def _geometry(tensors: dict[str, Tensor]) -> tuple[Gaussians, TriangleMesh]:
    def columns_of(record: str) -> dict[str, Any]:
        return {name.removeprefix(f"{record}."): values for name, values in tensors.items() if name.startswith(f"{record}.")}

    return Gaussians(**columns_of("Gaussians")), TriangleMesh(**columns_of("TriangleMesh"))


def surface_stage(
    place: Workplace,
    views: Views,
    gaussians: Gaussians,
    mesh: TriangleMesh,
    light: dict[str, Tensor],
    radius: float,
    settings: PassSettings,
) -> SurfaceFit:
    """fit_surface_in_passes; `light` are the parameters of stage 1."""
    fit, path = SurfaceFit(start_surface(gaussians, mesh, light, settings.surface, radius), mesh.faces), place.folder / SURFACE
    kept = _kept(place, path, mesh.vertices.device)
    if kept is not None:
        restore_fit(kept, fit.state)
        fit.faces, fit.index, fit.divided, fit.cameras_asked = kept["faces"], *(int(kept[name]) for name in ("pass", "divided", "asked"))
        fit.camera_from_world = kept["cameras"].cpu() if len(kept["cameras"]) else None

    def save() -> None:
        numbers = {"pass": torch.tensor(fit.index), "divided": torch.tensor(fit.divided), "asked": torch.tensor(fit.cameras_asked)}
        cameras = torch.zeros(0, 4, 4, dtype=torch.float64) if fit.camera_from_world is None else fit.camera_from_world
        write_tensors(path, fit_tensors(fit.state) | {"faces": fit.faces, "cameras": cameras} | numbers, place.identity)

    def report(r: FitReport) -> None:
        message = "; ".join(filter(None, (f"{_pass_of(fit, settings)}, {len(fit.faces)} faces", fit.doing, fit.remark)))
        place.reporter.report("surface", r.iteration / r.iterations, message, r, lambda: surface_preview(fit, views.cameras), save)

    done = fit_surface_in_passes(views, fit, settings, radius, report, place.should_stop)
    save()
    if not done:
        raise BuildStopped
    return fit


def _pass_of(fit: SurfaceFit, settings: PassSettings) -> str:
    if fit.index < settings.passes:
        return f"pass {fit.index + 1} of {settings.passes}"
    return "displacement" if fit.index < settings.relief_index else "relief"


def mesh_materials_stage(place: Workplace, views: Views, surface: SurfaceFit, radius: float, settings: MeshMaterialSettings) -> SurfaceFit:
    """fit_mesh_materials on the surface as it was fitted."""
    state = start_mesh_materials(surface.state, settings, radius)
    fit = SurfaceFit(state, surface.faces, surface.index, surface.divided)
    _checkpointed_fit(
        place,
        FitStage(
            "materials",
            MATERIALS,
            state,
            settings.iterations,
            lambda report: fit_mesh_materials(views, surface.faces, state, settings, report, place.should_stop),
            lambda _: "materials and light",
            lambda: surface_preview(fit, views.cameras),
        ),
    )
    return fit


def bind_stage(
    place: Workplace,
    views: Views,
    surfels: tuple[Gaussians, Binding],
    mesh: TriangleMesh,
    light: dict[str, Tensor],
    radius: float,
    settings: MeshFitSettings,
) -> MeshFitState:
    """fit_mesh_surfels of surfels that sit on the mesh; `light` are the parameters of a fit before."""
    state = start_mesh_fit(*surfels, mesh, light, settings)
    _checkpointed_fit(
        place,
        FitStage(
            "bind",
            SURFELS_ON_MESH,
            state.fit,
            settings.iterations,
            lambda report: fit_mesh_surfels(views, state, settings, radius, report, place.should_stop),
            lambda r: f"{r.elements} surfels on faces",
            lambda: stage_one_preview(surfels_on_faces(state), views.cameras, radius, settings.losses.sh_degree),
        ),
    )
    return state


def surfel_materials_stage(
    place: Workplace,
    views: Views,
    gaussians: Gaussians,
    light: dict[str, Tensor],
    mesh: TriangleMesh,
    radius: float,
    settings: MaterialSettings,
) -> FitState:
    """fit_materials; `light` are the parameters of the fit before."""
    on_mesh = "binding" in place.identity
    if on_mesh:  # a surfel never leaves its face
        settings = replace(settings, rates=replace(settings.rates, centers=0.0))
    state = start_materials(gaussians, light, mesh, settings, radius)
    _checkpointed_fit(
        place,
        FitStage(
            "materials",
            MATERIALS_OF_BOUND if on_mesh else SURFEL_MATERIALS,
            state,
            settings.iterations,
            lambda report: fit_materials(views, mesh, state, settings, radius, report, place.should_stop),
            lambda _: "materials and light",
        ),
    )
    return state


@dataclass(frozen=True, eq=False)
class FitStage:
    """A fit as a stage: what it is called, where it is kept, and what goes on with it."""

    name: str
    """In reports of progress."""
    file: str
    """Of its checkpoint, in the build's folder."""
    state: FitState
    iterations: int
    run: Callable[[Callable[[FitReport], None]], object]
    """Goes on with the fit until it is done or told to stop; takes whom to report to."""
    message: Callable[[FitReport], str]
    preview: Callable[[], bytes] | None = None
    """JPEG of how far it is."""


def _checkpointed_fit(place: Workplace, stage: FitStage) -> None:
    """Restore, run, save, stop.

    Raises:
        BuildStopped: the fit was told to stop; its checkpoint is written.
        ValueError: there is a checkpoint, but it is damaged, or of another build or version.
    """
    state, path = stage.state, place.folder / stage.file
    kept = _kept(place, path, state.parameters["albedo_logits"].device)
    if kept is not None:
        restore_fit(kept, state)

    def save() -> None:
        write_tensors(path, fit_tensors(state), place.identity)

    def report(r: FitReport) -> None:
        place.reporter.report(stage.name, r.iteration / r.iterations, stage.message(r), r, stage.preview, save)

    if state.iteration < stage.iterations:
        stage.run(report)
        save()
    if state.iteration < stage.iterations:
        raise BuildStopped


def _kept_or_made(place: Workplace, file: str, device: torch.device, make: Callable[[], dict[str, Tensor]]) -> dict[str, Tensor]:
    """What a stage left that computes at once, else what it makes now, which is then left."""
    path = place.folder / file
    tensors = _kept(place, path, device)
    if tensors is None:
        tensors = make()
        write_tensors(path, tensors, place.identity)
    return tensors


def _kept(place: Workplace, path: Path, device: torch.device) -> dict[str, Tensor] | None:
    """Tensors of a file of this build, if it should go on and there is one."""
    if not (place.resume and path.exists()):
        return None
    tensors, facts = read_tensors(path, device)
    # Light that stands still with the object has no entry.
    found = {key: facts[key] for key in (*place.identity, "light") if key in facts}
    if found != place.identity:
        raise ValueError(
            f"the checkpoint {path} is of another build (found {found}, expected {place.identity}); delete its folder or choose another OUT"
        )
    return tensors


def stage_one_preview(parameters: dict[str, Tensor], cameras: tuple[Camera, ...], radius: float, sh_degree: int) -> bytes:
    """JPEG of the first view as stage 1 draws it."""
    with torch.no_grad():
        camera = preview_camera(cameras).to(parameters["centers"].device)
        tables = filter_environment(environment_table(parameters))
        maps = render_stage_one(parameters, tables, camera, near_plane(radius), sh_degree)
        return encode_preview(maps.radiance_linear, maps.coverage)


def stage_two_preview(parameters: dict[str, Tensor], cameras: tuple[Camera, ...], radius: float) -> bytes:
    """JPEG of the first view as stage 2 draws it, by the surfels' own radiance."""
    with torch.no_grad():
        camera = preview_camera(cameras).to(parameters["centers"].device)
        maps = render_stage_two(parameters, camera, near_plane(radius))
        return encode_preview(maps.splat_radiance, maps.coverage)


def surface_preview(fit: SurfaceFit, cameras: tuple[Camera, ...]) -> bytes:
    """JPEG of the first view of the surface under its light, by split sum."""
    with torch.no_grad():
        mesh, parameters = fit.mesh, fit.state.parameters
        camera = preview_camera(cameras).to(mesh.vertices.device)
        origin, directions = pixel_rays_world(camera)
        direction = directions.reshape(-1, 3)
        hits = trace_rays(origin.expand_as(direction), direction, build_tracer(mesh))
        met = hits.hit.nonzero().squeeze(1)
        face, weights = hits.face[met].long(), corner_weights(hits.barycentric[met])
        light = MeshLight(filter_environment(environment_table(parameters)), parameters["open_share"])
        radiance = torch.zeros_like(direction)
        radiance[met] = hit_radiance(mesh, face, weights, -direction[met], light)
        return encode_preview(radiance.reshape(directions.shape), hits.hit.float().reshape(directions.shape[:2]))


def preview_camera(cameras: tuple[Camera, ...]) -> Camera:
    """The first camera, its picture reduced to PREVIEW_SIDE."""
    camera = cameras[0]
    return scaled_camera(camera, min(1.0, PREVIEW_SIDE / max(camera.width, camera.height)))
