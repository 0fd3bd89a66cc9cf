"""The stages of a build, each with what it leaves in the build's folder: done again from there, it does not start anew.

Every stage takes the `Workplace` and what the stages before gave. A checkpoint says of which build it is; one of another build is refused.
A stage that is told to stop writes its checkpoint and raises BuildStopped. What the stages compute is in the steps' own files.
"""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from drgs.build.checkpoint import fit_tensors, read_tensors, restore_fit, write_tensors
from drgs.build.densify import Pull
from drgs.build.extract_mesh import MeshSettings
from drgs.build.find_masks import find_masks
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
from drgs.build.fit_materials import MaterialSettings, MaterialState, fit_materials, start_materials
from drgs.build.fit_mesh_surfels import MeshFitSettings, MeshFitState, fit_mesh_surfels, start_mesh_fit, surfels_on_faces
from drgs.build.initial_points import InitialPoints, initial_points
from drgs.build.mesh_from_gaussians import drop_unseen, mesh_from_gaussians
from drgs.build.mesh_surfels import mesh_surfels
from drgs.build.report_progress import BuildReporter, encode_preview
from drgs.build.split_sum import filter_environment
from drgs.scene.camera import Camera
from drgs.scene.gaussians import Gaussians
from drgs.scene.mesh import TriangleMesh
from drgs.scene.views import Views

MASKS = "masks.safetensors"
"""Of a capture that has none of its own."""
FIT, MESH, MATERIALS = "stage1.safetensors", "mesh.safetensors", "stage2.safetensors"
SURFELS_ON_MESH, MATERIALS_ON_MESH = "mesh_surfels.safetensors", "stage2_mesh.safetensors"
CHECKPOINTS = (FIT, MESH, MATERIALS, SURFELS_ON_MESH, MATERIALS_ON_MESH)
"""In the order of the stages, first those of either binding and of particles."""
PREVIEW_SIDE = 256
"""[pixels]"""


class BuildStopped(Exception):
    """should_stop() was true; the checkpoint is on disk."""


@dataclass(frozen=True, eq=False)
class Workplace:
    """Where a build keeps what its stages leave, whom it tells, and who may stop it."""

    folder: Path
    identity: dict
    """What tells this build from others, as far as the stages so far depend on it; checkpoints carry it."""
    resume: bool
    reporter: BuildReporter
    should_stop: Callable[[], bool]

    def of(self, **more: str) -> "Workplace":
        """The same for the stages that depend on more."""
        return replace(self, identity=self.identity | more)


def capture_digest(views: Views) -> str:
    """Hex digest of the photos, masks and poses: a checkpoint belongs to these and no others."""
    digest = hashlib.sha256()
    for part in (views.images_srgb, views.coverage, *(camera.camera_from_world for camera in views.cameras)):
        digest.update(part.contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]


def forget_checkpoints(place: Workplace) -> None:
    """Else a later build that resumes would take them for this one's."""
    for stale in (MASKS, *CHECKPOINTS):
        (place.folder / stale).unlink(missing_ok=True)


def masks_stage(place: Workplace, views: Views, points: InitialPoints, settings: FitSettings, device: torch.device) -> Views:
    """find_masks."""
    path = place.folder / MASKS
    kept = _kept(place, path, torch.device("cpu"))
    if kept is not None:
        return replace(views, coverage=kept[0]["coverage"], has_masks=True)

    def report(r: FitReport, _state: FitState) -> None:
        place.reporter.report("read", r.iteration / r.iterations, "no masks: looking for the object", r)

    masked = find_masks(views, points, settings, device, report, place.should_stop)
    if masked is None:
        raise BuildStopped
    write_tensors(path, {"coverage": masked.coverage}, place.identity)
    return masked


def points_of_found_masks(masked: Views, points: InitialPoints, count: int, seed: int) -> InitialPoints:
    """Points on the found masks' hull; the given ones where the masks have none."""
    try:
        return initial_points(masked, count, seed)
    except ValueError:  # a first guess may be wrong where the user's own masks may not: the fit then starts from random points
        return points


def fit_stage(place: Workplace, views: Views, points: InitialPoints, settings: FitSettings, device: torch.device) -> FitState:
    """fit_gaussians."""
    path = place.folder / FIT
    state = start_fit(points, settings, device, views.has_masks)
    kept = _kept(place, path, device)
    if kept is not None:
        tensors, facts = kept
        restore_fit(tensors, state.parameters, state.optimizer, state.generator)
        state.iteration = facts["iteration"]
        state.pull = Pull(tensors["pull.total"].clone(), tensors["pull.seen"].clone())

    def save() -> None:
        tensors = fit_tensors(state.parameters, state.optimizer, state.generator)
        pull = {"pull.total": state.pull.total, "pull.seen": state.pull.seen}
        write_tensors(path, tensors | pull, place.identity | {"iteration": state.iteration})

    def preview() -> bytes:
        with torch.no_grad():
            camera = preview_camera(views.cameras).to(device)
            tables = filter_environment(environment_table(state.parameters))
            maps = render_stage_one(state.parameters, tables, camera, 0.01 * points.bounds_radius, settings.sh_degree)
            return encode_preview(maps.radiance_linear, maps.coverage)

    def report(r: FitReport, _state: FitState) -> None:
        place.reporter.report("fit", r.iteration / r.iterations, f"{r.surfels} surfels", r, preview, save)

    if state.iteration < settings.iterations:
        fit_gaussians(views, state, settings, points.bounds_radius, report, place.should_stop)
        save()
    if state.iteration < settings.iterations:
        raise BuildStopped
    return state


def mesh_stage(
    place: Workplace, views: Views, points: InitialPoints, fit: FitState, settings: MeshSettings
) -> tuple[Gaussians, TriangleMesh]:
    """The surfels that cameras see and the mesh around them."""
    path = place.folder / MESH
    device = fit.parameters["centers"].device
    if place.resume and path.exists():
        gaussians, mesh, facts = read_geometry(path, device)
        _check_build(facts, place, path)
        return gaussians, mesh
    gaussians = drop_unseen(gaussians_from_state(fit), views.cameras, points.bounds_radius)
    mesh = mesh_from_gaussians(gaussians, views.cameras, points, settings)
    tensors = {f"{type(record).__name__}.{name}": value for record in (gaussians, mesh) for name, value in vars(record).items()}
    write_tensors(path, tensors, place.identity)
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


def bind_stage(
    place: Workplace, views: Views, gaussians: Gaussians, mesh: TriangleMesh, fit: FitState, radius: float, settings: MeshFitSettings
) -> MeshFitState:
    """mesh_surfels and fit_mesh_surfels; `fit` gives the light."""
    path = place.folder / SURFELS_ON_MESH
    device = mesh.vertices.device
    state = start_mesh_fit(*mesh_surfels(gaussians, mesh), mesh, fit.parameters, settings)
    kept = _kept(place, path, device)
    if kept is not None:
        tensors, facts = kept
        restore_fit(tensors, state.parameters, state.optimizer, state.generator)
        state.iteration = facts["iteration"]

    def save() -> None:
        tensors = fit_tensors(state.parameters, state.optimizer, state.generator)
        write_tensors(path, tensors, place.identity | {"iteration": state.iteration})

    def preview() -> bytes:
        with torch.no_grad():
            camera = preview_camera(views.cameras).to(device)
            tables = filter_environment(environment_table(state.parameters))
            maps = render_stage_one(surfels_on_faces(state), tables, camera, 0.01 * radius, settings.losses.sh_degree)
            return encode_preview(maps.radiance_linear, maps.coverage)

    def report(r: FitReport, _state: MeshFitState) -> None:
        place.reporter.report("bind", r.iteration / r.iterations, f"{r.surfels} surfels on faces", r, preview, save)

    if state.iteration < settings.iterations:
        fit_mesh_surfels(views, state, settings, radius, report, place.should_stop)
        save()
    if state.iteration < settings.iterations:
        raise BuildStopped
    return state


def materials_stage(
    place: Workplace,
    views: Views,
    gaussians: Gaussians,
    light: dict[str, Tensor],
    mesh: TriangleMesh,
    radius: float,
    settings: MaterialSettings,
) -> MaterialState:
    """fit_materials; `light` are the parameters of the fit before."""
    on_mesh = "binding" in place.identity
    path = place.folder / (MATERIALS_ON_MESH if on_mesh else MATERIALS)
    if on_mesh:  # a surfel never leaves its face
        settings = replace(settings, rates=replace(settings.rates, centers=0.0))
    state = start_materials(gaussians, light, mesh, settings, radius)
    kept = _kept(place, path, mesh.vertices.device)
    if kept is not None:
        tensors, facts = kept
        restore_fit(tensors, state.parameters, state.optimizer, state.generator)
        state.iteration = facts["iteration"]

    def save() -> None:
        tensors = fit_tensors(state.parameters, state.optimizer, state.generator)
        write_tensors(path, tensors, place.identity | {"iteration": state.iteration})

    def report(r: FitReport, _state: MaterialState) -> None:
        place.reporter.report("materials", r.iteration / r.iterations, "materials and light", r, None, save)

    if state.iteration < settings.iterations:
        fit_materials(views, mesh, state, settings, radius, report, place.should_stop)
        save()
    if state.iteration < settings.iterations:
        raise BuildStopped
    return state


def preview_camera(cameras: tuple[Camera, ...]) -> Camera:
    camera = cameras[0]
    return scaled_camera(camera, min(1.0, PREVIEW_SIDE / max(camera.width, camera.height)))


def _kept(place: Workplace, path: Path, device: torch.device) -> tuple[dict[str, Tensor], dict] | None:
    """Tensors and facts of a checkpoint of this build, if it should go on and there is one."""
    if not (place.resume and path.exists()):
        return None
    tensors, facts = read_tensors(path, device)
    _check_build(facts, place, path)
    return tensors, facts


def _check_build(facts: dict, place: Workplace, path: Path) -> None:
    found = {key: facts.get(key) for key in place.identity}
    if found != place.identity:
        raise ValueError(
            f"the checkpoint {path} is of another build (found {found}, expected {place.identity}); delete its folder or choose another OUT"
        )
