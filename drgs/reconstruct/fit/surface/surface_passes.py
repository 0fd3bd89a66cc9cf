"""fit_surface in passes, each on even triangles: hollows lie far below the hull that the first mesh has, and what moves far is stretched.

Between two passes the surface is sampled and meshed anew (remesh), and what its vertices carried is interpolated. Without it triangles fold
where a hollow deepens, and a fold is a dent that no later solve removes: still_life, fast, 7 passes instead of 6 rounds, 28.1 -> 29.2 dB,
mean distance of the mesh 1.53 -> 1.15 % of the radius (docs/decisions/0003-fitting.md). After the last one positions follow what pixels show
(displaced_surface); then faces are divided as finely as photographs show, and their normals and materials get some more steps.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import torch
from jaxtyping import Float64, Int
from torch import Tensor

from drgs.reconstruct.fit.evidence.register_cameras import register_cameras, seen_from
from drgs.reconstruct.fit.fit_loop import FitReport, FitState
from drgs.reconstruct.fit.light.environment_pyramid import environment_table
from drgs.reconstruct.fit.light.split_sum import filter_environment
from drgs.reconstruct.fit.surface.fit_surface import NOT_FITTED, SurfaceRates, SurfaceSettings, fit_surface
from drgs.reconstruct.fit.surface.moving_surface import MovingSurface, mesh_from_surface_fit
from drgs.reconstruct.fit.surface.shade_surface import packed_surface
from drgs.reconstruct.fit.surface.try_depths import TrialSettings, try_depths
from drgs.reconstruct.fit.surface.try_kinds import iterations as iterations_of_kinds
from drgs.reconstruct.fit.surface.try_kinds import try_kinds
from drgs.reconstruct.fit.surfel_parameters import leaves, make_optimizer
from drgs.reconstruct.fit.view_targets import whole_targets
from drgs.reconstruct.geometry.divide_faces import DivisionSettings, divided_faces, divisions, undivided_faces
from drgs.reconstruct.geometry.extract_mesh import MeshSettings
from drgs.reconstruct.geometry.mask_outlines import mask_outlines
from drgs.reconstruct.geometry.remesh import NothingEnclosed, remesh
from drgs.scene.mesh import TriangleMesh
from drgs.scene.views import Views

PASS_MESH = MeshSettings(resolution=200, face_limit=60_000, smoothing_passes=0, keep_component_fraction=0.01)
"""How fine the surface is meshed before a pass."""
KINDS_AFTER = 1
"""Pass, counted from 1, after which the fit begins once more as metal and as paint: normals are known a little, and no pass but the first was led by
what one light said."""
DISPLACEMENT_RATES = SurfaceRates(
    normals=0.0, albedo_logits=0.01, roughness_logits=0.01, metallic_logits=0.01, environment=0.005, offsets=0.03
)
"""Materials and light follow a surface that moves less than it did in the passes."""


@dataclass(frozen=True)
class PassSettings:
    """How often, and how fine."""

    passes: int = 7
    surface: SurfaceSettings = field(default_factory=lambda: SurfaceSettings(rounds=1, steps_a_round=80))
    """Of one pass; weights that change over a fit change over all passes."""
    mesh: MeshSettings = PASS_MESH
    trials: TrialSettings = field(default_factory=TrialSettings)
    try_after: tuple[int, ...] = ()
    """Passes, counted from 1, after which the surface is tried at other depths."""
    light_before: tuple[int, ...] = (2, 3, 4, 5)
    """Passes, counted from 1, before which light is looked for that makes paint alike on all sides (half-way through which, where it turns with the camera).
    Not before all of many: each time light gets rougher."""
    displacement_steps: int = 0
    """After the last pass, in which positions follow what pixels show, and normals them (displaced_surface)."""
    displacement_rates: SurfaceRates = field(default_factory=lambda: DISPLACEMENT_RATES)
    weight_bend_displaced: float = 0.04
    """SurfaceSettings.weight_bend in those steps: it holds positions, too."""
    division: DivisionSettings = field(default_factory=DivisionSettings)
    """How fine faces are divided after the last pass."""
    relief_steps: int = 70
    """On divided faces: of normals, materials and light, while the surface stays where it is."""
    cameras_after: tuple[int, ...] = ()
    """Passes, counted from 1, after which cameras are moved to where their photographs fit the surface, where they are off (register_cameras)."""

    def with_more_passes(self, more: int) -> "PassSettings":
        """Normals go less far in each pass, and as far in all of them."""
        passes, given = self.passes + more, self.surface
        share = self.passes / passes
        rates = replace(given.rates, normals=given.rates.normals * share)
        return replace(self, passes=passes, surface=replace(given, rates=rates, normals_end=given.normals_end * share))

    @property
    def relief_index(self) -> int:
        """Of the steps on divided faces, where passes and displacement count as 0, 1, ..."""
        return self.passes + (self.displacement_steps > 0)


@dataclass(eq=False)
class SurfaceFit:
    """The surface's fit between and within passes: everything to go on with."""

    state: FitState
    """Of the pass under way."""
    faces: Int[Tensor, "face 3"]
    """Of the state's vertices."""
    index: int = 0
    """Of the pass under way; the number of passes: the displacement after them, where there is one; PassSettings.relief_index: the relief."""
    divided: int = 0
    """How often each face was divided, after the passes."""
    camera_from_world: Float64[Tensor, "view 4 4"] | None = None
    """As cameras were moved; None: they are where the views have them."""
    cameras_asked: int = 0
    """Pass, counted from 1, after which it was last asked whether cameras are right."""
    doing: str = ""
    """What is under way besides the pass, in words."""
    remark: str = ""
    """What went otherwise than planned, in a sentence."""

    @property
    def mesh(self) -> TriangleMesh:
        """As it is now."""
        return mesh_from_surface_fit(self.state, self.faces)

    @property
    def undivided_mesh(self) -> TriangleMesh:
        """The same with faces as the passes had them: its vertices come first in `mesh`."""
        mesh, faces = self.mesh, self.faces
        for _ in range(self.divided):
            faces = undivided_faces(faces)
        count = int(faces.max()) + 1 if self.divided else len(mesh.vertices)
        return TriangleMesh(**{name: value[:count] for name, value in mesh.columns.items() if name != "faces"}, faces=faces)


def settings_of_pass(settings: PassSettings, index: int) -> SurfaceSettings:
    """Of pass `index`: weights and the normals' rate go on where the pass before ended; the other rates fall in the last one alone."""
    given, last = settings.surface, index == settings.passes - 1
    moves = replace(given.moves, resolution=settings.mesh.resolution)

    def between(start: float, end: float, place: float) -> float:
        share = place / settings.passes
        return start ** (1 - share) * end**share

    return replace(
        given,
        rates=replace(given.rates, normals=between(given.rates.normals, given.normals_end, index + 0.5)),
        weight_bend=between(given.weight_bend, given.weight_bend_end, index),
        weight_bend_end=between(given.weight_bend, given.weight_bend_end, index + 1),
        weight_smooth=between(given.weight_smooth, given.weight_smooth_end, index),
        weight_smooth_end=between(given.weight_smooth, given.weight_smooth_end, index + 1),
        fall_from=given.fall_from if last else 1.0,
        light_at_end=last,
        looks_for_light=index + 1 in settings.light_before,
        moves=replace(moves, to_surface=given.to_surface_end) if last else moves,
        seed=given.seed + index,
    )


def settings_of_displacement(settings: PassSettings) -> SurfaceSettings:
    """Of the steps in which positions follow what pixels show: rates fall from the first."""
    return replace(
        _settings_after_passes(settings, settings.passes, settings.displacement_steps),
        rates=settings.displacement_rates,
        fall_from=0.0,
        weight_bend=settings.weight_bend_displaced,
        weight_bend_end=settings.weight_bend_displaced,
        looks_for_light=False,
        displaces=True,
    )


def settings_of_relief(settings: PassSettings) -> SurfaceSettings:
    """Of the steps on divided faces."""
    return replace(_settings_after_passes(settings, settings.relief_index, settings.relief_steps), still=True)


def _settings_after_passes(settings: PassSettings, index: int, steps: int) -> SurfaceSettings:
    """They go on where the last pass ended."""
    last = settings_of_pass(settings, settings.passes - 1)
    return replace(
        last,
        rounds=1,
        steps_a_round=steps,
        weight_bend=last.weight_bend_end,
        weight_smooth=last.weight_smooth_end,
        seed=settings.surface.seed + index,
    )


def move_to_tried_depths(
    fit: SurfaceFit,
    views: Views,
    settings: PassSettings,
    radius: float,
    report: Callable[[FitReport], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> bool:
    """Move the surface to where trials explain the photographs better; False: should_stop() said so, and nothing moved."""
    parameters = fit.state.parameters
    before = {name: value.detach().clone() for name, value in parameters.items()}
    seed = settings.surface.seed + 7919 * (fit.index + 1)
    fit.doing = "trying depths"
    found = try_depths(views, before, fit.faces, settings.trials, radius, seed, report, should_stop)
    fit.doing = ""
    if found is None:
        return False
    step = found.parameters["vertices"] - before["vertices"]
    # What moved is at home where it is now.
    moved = (found.depth.abs() > settings.trials.still * radius)[:, None]
    homeward = torch.where(moved, torch.zeros_like(step), before["homeward"] - step)
    with torch.no_grad():
        for name, value in (found.parameters | {"homeward": homeward, "to_texture": before["to_texture"] - step}).items():
            parameters[name].copy_(value)
    return True


@torch.no_grad()
def move_cameras(fit: SurfaceFit, views: Views, settings: PassSettings) -> Views:
    """The views from where the photographs fit the surface as it is; the very views where their cameras are right."""
    surface, targets = MovingSurface(views, fit.faces, fit.state), whole_targets(views, fit.faces.device)
    surface.tracer = surface.tracer.with_materials(fit.mesh)
    parameters = fit.state.parameters
    light_of = surface.light_of(filter_environment(environment_table(parameters)))
    outlines = mask_outlines(views) if views.has_masks else [None] * len(targets)
    seed = settings.surface.seed + 7919 * (fit.index + 1)
    found = register_cameras(surface.tracer, targets, outlines, light_of, packed_surface(parameters), seed)
    if found.camera_from_world is None:
        return views
    fit.camera_from_world = found.camera_from_world
    return seen_from(views, found.camera_from_world)


def begin_as_either_kind(
    fit: SurfaceFit,
    views: Views,
    settings: PassSettings,
    report: Callable[[FitReport], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> bool:
    """Go on from what explains more, all metal or all paint at first; False: should_stop() said so, and nothing changed."""
    fit.doing = "trying metal and paint"
    found = try_kinds(views, fit.state.parameters, fit.faces, settings_of_pass(settings, fit.index + 1), report, should_stop)
    fit.doing = ""
    if found is None:
        return False
    with torch.no_grad():
        for name, value in found.parameters.items():
            fit.state.parameters[name].copy_(value)
    return True


def start_next_pass(fit: SurfaceFit, settings: PassSettings, radius: float) -> None:
    """Mesh the surface anew and start the next pass on it; on the surface as it is where solves have undone it.

    Args:
        radius: of the object's bounding sphere [world units].
    """
    own = settings_of_pass(settings, fit.index + 1)
    values = {name: value.detach() for name, value in fit.state.parameters.items()}
    try:
        new = remesh(values["vertices"], fit.faces, settings.mesh)
    except NothingEnclosed as error:
        fit.remark = f"after pass {fit.index + 1} the mesh before was kept, for {error}"
    else:
        values = {name: value if name.startswith("environment_") else new.carried(value) for name, value in values.items()}
        values["vertices"], fit.faces = new.vertices, new.faces
    _start_pass(fit, values, own, radius)


def start_displacement(fit: SurfaceFit, settings: PassSettings, radius: float) -> None:
    """Start the steps in which positions follow what pixels show, on the faces of the last pass."""
    values = {name: value.detach() for name, value in fit.state.parameters.items()}
    _start_pass(fit, values, settings_of_displacement(settings), radius)


def start_relief(fit: SurfaceFit, times: int, settings: PassSettings, radius: float) -> None:
    """Divide each face `times` times into four and start the steps on them: relief and paint that are finer than the faces of the passes are in the
    photographs, and the surface's shape need not be solved for them."""
    values = {name: value.detach() for name, value in fit.state.parameters.items()}
    for _ in range(times):
        divided = divided_faces(fit.faces, len(values["vertices"]))
        values = {name: value if name.startswith("environment_") else divided.carried(value) for name, value in values.items()}
        fit.faces = divided.faces
    fit.divided = times
    _start_pass(fit, {name: value.clone() for name, value in values.items()}, settings_of_relief(settings), radius)


def _start_pass(fit: SurfaceFit, values: dict[str, Tensor], own: SurfaceSettings, radius: float) -> None:
    """The pass after the one under way with its `own` settings, from `values` of the fit's vertices."""
    values = leaves(values, frozen=NOT_FITTED)
    fit.index += 1
    fit.state = FitState(values, make_optimizer(values, own.rates, radius), torch.Generator().manual_seed(own.seed + 2))


def fit_surface_in_passes(
    views: Views,
    fit: SurfaceFit,
    settings: PassSettings,
    radius: float,
    report: Callable[[FitReport], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> bool:
    """Run (or go on with) all passes, and the relief after them; False: should_stop(), asked before each step, said so.

    Args:
        fit: start_surface on the mesh as it was extracted, or what an earlier call left. report: is told of the steps of all passes.
    """
    steps = settings.surface.iterations
    between = [(after, settings.trials.iterations) for after in settings.try_after]
    kinds = iterations_of_kinds(settings_of_pass(settings, KINDS_AFTER)) if settings.passes > KINDS_AFTER else 0
    between += [(KINDS_AFTER, kinds)]
    total = settings.passes * steps + sum(more for _, more in between) + settings.displacement_steps
    total += settings.relief_steps * (settings.division.most_faces > 0)

    def tell(done: int, r: FitReport) -> None:
        if report is not None:
            report(replace(r, iteration=done + r.iteration, iterations=total))

    if fit.camera_from_world is not None:
        views = seen_from(views, fit.camera_from_world)
    while fit.index < settings.passes:
        number = fit.index + 1
        done = fit.index * steps + sum(more for after, more in between if after < number)
        fit_surface(views, fit.mesh, fit.state, settings_of_pass(settings, fit.index), partial(tell, done), should_stop)
        if fit.state.iteration < steps:
            return False
        if number == settings.passes:
            break
        if number in settings.cameras_after and fit.cameras_asked < number:
            fit.doing = "looking whether cameras are right"
            views, fit.cameras_asked = move_cameras(fit, views, settings), number
            fit.doing = ""
        done += steps
        if number == KINDS_AFTER:
            if not begin_as_either_kind(fit, views, settings, partial(tell, done), should_stop):
                return False
            done += kinds
        if number in settings.try_after and not move_to_tried_depths(fit, views, settings, radius, partial(tell, done), should_stop):
            return False
        start_next_pass(fit, settings, radius)
    relief, displacement = settings_of_relief(settings), settings_of_displacement(settings)
    if fit.index < settings.relief_index and settings.displacement_steps:
        if fit.index < settings.passes:
            start_displacement(fit, settings, radius)
        done = total - displacement.iterations - relief.iterations * (settings.division.most_faces > 0)
        fit_surface(views, fit.mesh, fit.state, displacement, partial(tell, done), should_stop)
        if fit.state.iteration < displacement.iterations:
            return False
    if fit.index < settings.relief_index:
        times = divisions(fit.mesh, views.cameras, settings.division) if settings.relief_steps else 0
        if not times:
            return True
        start_relief(fit, times, settings, radius)
    fit_surface(views, fit.mesh, fit.state, relief, partial(tell, total - relief.iterations), should_stop)
    return fit.state.iteration >= relief.iterations
