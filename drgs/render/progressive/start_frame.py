"""A frame before its first pass: what rays meet, what the camera sees, and sums to add to.

In: what the frame is made of, and the frame before. Out: a FrameState. invalidate.py says what of the frame before still holds; here each
part is taken over or computed.
"""

import time
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from drgs.render.integrate.environment_table import build_environment_table, environment_light
from drgs.render.integrate.plan import after_edit, at_rest, plan_frame, samples_per_pass, scene_facts
from drgs.render.integrate.sample_rays import shading_points
from drgs.render.intersect.horizon import Horizons
from drgs.render.intersect.ray_memory import RayMemory
from drgs.render.intersect.trace_rays import build_tracer
from drgs.render.intersect.tracer import AbstractTracer
from drgs.render.progressive.converge import still_active
from drgs.render.progressive.frame_state import FrameState, GaussianView, MeshView, Tiles, TracedScene, with_seconds
from drgs.render.progressive.frame_sums import brighten_sums, no_sums
from drgs.render.progressive.invalidate import NOTHING_BEFORE, PARTS, Invalidation, Part, changed_in_scene, invalidate, parts_made_from
from drgs.render.progressive.kept_light.kept_light import MOST_VERTICES, KeptLight, brighten_kept, no_light, without_indirect
from drgs.render.progressive.mean_radiance import frame_history
from drgs.render.progressive.quick_picture import brighten_picture
from drgs.render.progressive.reproject import brighten_light
from drgs.render.records import FrameInputs, GBuffer, History, PrimaryPoints, RenderPlan, RenderSettings
from drgs.render.visible.image_tiles import TILE, tile_grid, tile_of_pixels, tiles_of_box, tiles_of_mesh
from drgs.render.visible.lift_points import lift_points
from drgs.render.visible.rasterize import rasterize_gbuffer
from drgs.render.visible.refresh_materials import refresh_gbuffer, refresh_points, refresh_primary
from drgs.scene.camera import Camera
from drgs.scene.posed_scene import PosedScene


def start_frame(
    scene: PosedScene,
    camera: Camera,
    settings: RenderSettings,
    tracer: AbstractTracer | None = None,
    gbuffer: GBuffer | None = None,
    previous: FrameState | None = None,
    band: slice | None = None,
) -> FrameState:
    """All that a frame needs before its first pass.

    Args:
        tracer: of scene.mesh, to reuse one.
        gbuffer: of the scene's Gaussians through this camera, to reuse one.
        previous: the frame before, at any stage: what did not change is taken over, its sums included, so that a frame of which only
            the exposure changed goes on where it was.
        band: the rows of the image that the frame shall hold, from a tile's edge to a tile's edge; None: all of them.

    Raises:
        ValueError: the camera is to see Gaussians, and there are none.
    """
    inputs = FrameInputs(scene, camera, settings, band)
    if inputs.primary == "gaussians" and scene.surfels is None and gbuffer is None:
        raise ValueError("primary 'gaussians' was asked for, but this scene has no Gaussians; use primary 'mesh'")
    reuse = Reuse(previous, NOTHING_BEFORE if previous is None else invalidate(previous.inputs, inputs))
    clock = StepClock()
    traced = _trace_scene(inputs, tracer, reuse, clock)
    view = _see_mesh(scene, reuse, clock) if inputs.primary == "mesh" else _see_gaussians(inputs, traced.tracer, gbuffer, reuse, clock)
    covered = _covered_tiles(inputs, view, reuse, clock)
    plan = _spend_samples(inputs, int((~covered).sum()), len(covered), reuse)
    if isinstance(view, MeshView) and view.first_primary_points is not None and reuse.keeps("sums") is None and _is_live(inputs):
        plan = after_edit(plan)
    kept_light = _kept_light(inputs, plan, reuse)
    clock.lap("kept_light")
    if (before := reuse.keeps("sums")) is not None:
        state = replace(before, inputs=inputs, traced=traced, plan=plan, computed_parts=reuse.computed_parts, kept_light=kept_light)
        return with_seconds(_continue_sums(state, _brightness(before.inputs.scene, scene)), clock.seconds)
    history = _history(settings, reuse)
    clock.lap("history")
    return FrameState(
        inputs=inputs,
        traced=traced,
        plan=plan,
        view=view,
        tiles=Tiles(covered=covered, passes=torch.zeros_like(covered, dtype=torch.int64), active=covered.clone()),
        sums=no_sums(camera.width * inputs.height, inputs.primary == "mesh", settings.split_indirect, covered.device),
        rates=None,
        first_rays=_first_rays(inputs, reuse),
        history=history,
        reprojected=None,
        kept_light=kept_light,
        quick_picture=None,
        computed_parts=reuse.computed_parts,
        seconds=clock.seconds,
    )


class StepClock:
    """Final. Books the time since the last lap on a step."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, step: str) -> None:
        now = time.perf_counter()
        self.seconds[step] = self.seconds.get(step, 0.0) + now - self._last
        self._last = now


# ---- what is reused ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Reuse:
    """What a new frame may take over from the one before."""

    previous: FrameState | None
    invalidation: Invalidation

    def keeps(self, part: Part) -> FrameState | None:
        """The frame before, where this part of it still holds."""
        return None if part in self.invalidation.old_parts else self.previous

    @property
    def computed_parts(self) -> tuple[Part, ...]:
        kept = None if self.previous is None else self.previous.kept_light
        nothing = frozenset[Part]() if kept is not None else frozenset[Part]({"kept_direct", "kept_indirect"})
        return tuple(part for part in PARTS if part in self.invalidation.old_parts - nothing)


def tracer_of(scene: PosedScene, before: tuple[PosedScene, AbstractTracer] | None) -> AbstractTracer:
    """A tracer of the scene's mesh.

    Args:
        before: another scene and its tracer, whose tree is shared where the shape is the same.
    """
    if before is None or "tracer" in parts_made_from(changed_in_scene(before[0], scene)):
        return build_tracer(scene.mesh)
    return before[1] if before[1].mesh is scene.mesh else before[1].with_materials(scene.mesh)


def _trace_scene(inputs: FrameInputs, tracer: AbstractTracer | None, reuse: Reuse, clock: StepClock) -> TracedScene:
    scene, previous = inputs.scene, reuse.previous
    if tracer is None:
        tracer = tracer_of(scene, None if previous is None else (previous.inputs.scene, previous.traced.tracer))
    if tracer.horizons is None and inputs.settings.skip:
        tracer.horizons = Horizons(tracer.mesh, tracer.lift, scene.horizons)
    clock.lap("build_tracer")
    before = reuse.keeps("environment_table")
    table = build_environment_table(scene.environment) if before is None else before.traced.environment_table
    turned_and_bright = _turned_and_bright(scene)
    if before is not None and turned_and_bright == _turned_and_bright(before.inputs.scene):
        light = before.traced.environment_light  # and the pools that are kept with it
    else:
        light = environment_light(table, *turned_and_bright)
    clock.lap("environment_table")
    return TracedScene(tracer, table, light)


def _turned_and_bright(scene: PosedScene) -> tuple[float, float]:
    return scene.environment_rotation_degrees, scene.environment_intensity


def _is_moving(inputs: FrameInputs, reuse: Reuse) -> bool:
    """Of a picture that somebody sees while the camera moves."""
    changed = reuse.invalidation.changed
    return "camera" in changed and "shape" not in changed and _is_live(inputs)


def _is_live(inputs: FrameInputs) -> bool:
    """Whether a first pass may be a quick picture: it is shown for a moment, and filtered."""
    settings = inputs.settings
    shown = settings.keep_light and settings.skip and settings.denoise != "none"
    is_plain = settings.counts is None and not settings.split_indirect and inputs.band is None
    return shown and is_plain and inputs.primary == "mesh"


def _spend_samples(inputs: FrameInputs, empty_tiles: int, tiles: int, reuse: Reuse) -> RenderPlan:
    before = reuse.keeps("plan")
    if before is not None:
        return before.plan if reuse.keeps("sums") is not None else at_rest(before.plan)
    scene, settings = inputs.scene, inputs.settings
    facts = scene_facts(scene, empty_tiles, tiles, inputs.primary)
    if len(scene.mesh.vertices) > MOST_VERTICES:
        facts = replace(facts, diffuse_share=0.0)  # too many to keep light on
    return plan_frame(
        scene.environment,
        scene.environment_intensity,
        samples_per_pass(inputs),
        settings.bounces,
        settings.skip,
        facts,
        settings.skip_error,
        counts_given=settings.counts is not None,
        moving=_is_moving(inputs, reuse),
        spread_places=inputs.primary == "mesh" and settings.counts is None and scene.mesh.vertices.device.type == "cpu",
    )


# ---- what is seen --------------------------------------------------------------------------------------------------------


def _see_mesh(scene: PosedScene, reuse: Reuse, clock: StepClock) -> MeshView:
    """Points of the first pass, where the frame before had the same; else that pass will find them."""
    before = reuse.keeps("view")
    first = None if before is None or not isinstance(before.view, MeshView) else before.view.first_primary_points
    if first is not None and reuse.keeps("materials") is None:
        first = refresh_primary(first, scene.mesh)
    clock.lap("trace_primary")
    return MeshView(first)


def _see_gaussians(inputs: FrameInputs, tracer: AbstractTracer, gbuffer: GBuffer | None, reuse: Reuse, clock: StepClock) -> GaussianView:
    """Points of every pass. What a change of materials leaves of them is taken over."""
    surfels, camera = inputs.scene.surfels, inputs.camera
    before = reuse.keeps("view")
    if before is not None and isinstance(before.view, GaussianView):
        view = before.view
        if reuse.keeps("materials") is None:
            assert surfels is not None
            maps = refresh_gbuffer(view.gbuffer, surfels, camera)
            primary = replace(view.primary_points, points=refresh_points(view.primary_points.points, maps))
            view = GaussianView(maps, primary)
        clock.lap("rasterize_gbuffer")
        return view
    if gbuffer is None:
        assert surfels is not None
        gbuffer = rasterize_gbuffer(surfels, camera, band=inputs.band)
    clock.lap("rasterize_gbuffer")
    points = shading_points(gbuffer, inputs.first_pixel)
    primary = PrimaryPoints(points, lift_points(points, tracer), gbuffer.depth.reshape(-1)[points.pixel.long() - inputs.first_pixel])
    clock.lap("lift_points")
    return GaussianView(gbuffer, primary)


def _covered_tiles(inputs: FrameInputs, view: GaussianView | MeshView, reuse: Reuse, clock: StepClock) -> Tensor:
    """(tile,) bool: may show a surface; at least one, for a picture of nothing is done after one pass as well."""
    before = reuse.keeps("view")
    if before is not None and (before.quick_picture is None or before.quick_picture.of_edit):
        return before.tiles.covered
    camera, mesh = inputs.camera, inputs.scene.mesh
    across, down = tile_grid(camera.width, inputs.height)
    covered = torch.zeros(across * down, dtype=torch.bool, device=mesh.vertices.device)
    if not inputs.settings.skip:
        covered[:] = True
    elif isinstance(view, MeshView):
        above = inputs.rows.start // TILE * across
        # A moving picture finds out by its rays which tiles show something.
        find_tiles = tiles_of_box if _is_moving(inputs, reuse) else tiles_of_mesh
        covered = find_tiles(mesh, camera)[above : above + across * down].clone()
    else:
        covered[tile_of_pixels(view.primary_points.points.pixel - inputs.first_pixel, camera.width)] = True
    if not bool(covered.any()):
        covered[0] = True
    clock.lap("covered_tiles")
    return covered


# ---- what is kept on the mesh --------------------------------------------------------------------------------------------


def _kept_light(inputs: FrameInputs, plan: RenderPlan, reuse: Reuse) -> KeptLight | None:
    """What the frame before has, without what is old of it."""
    previous, old = reuse.previous, reuse.invalidation
    kept = None if previous is None or "shape" in old.changed else previous.kept_light
    if kept is None:
        return no_light(inputs.scene.mesh) if plan.kept_light else None
    assert previous is not None
    if "kept_direct" in old.old_parts:
        return no_light(inputs.scene.mesh, kept.around)
    if "kept_indirect" in old.old_parts:
        kept = without_indirect(kept)
    brightness = _brightness(previous.inputs.scene, inputs.scene)
    return kept if brightness == 1.0 else brighten_kept(kept, brightness)


# ---- what is summed ------------------------------------------------------------------------------------------------------


def _first_rays(inputs: FrameInputs, reuse: Reuse) -> RayMemory:
    before = reuse.keeps("first_rays")
    # A band is finished and forgotten: nobody will ask for its rays again.
    return RayMemory(writes=not reuse.invalidation.moving and inputs.band is None) if before is None else RayMemory(before.first_rays.rays)


def _history(settings: RenderSettings, reuse: Reuse) -> History | None:
    if reuse.previous is None or not reuse.invalidation.only_camera_moved or settings.denoise == "none":
        return None
    return frame_history(reuse.previous)


def _brightness(before: PosedScene, now: PosedScene) -> float:
    """Of the light, as a factor of what it was."""
    same = before.environment_intensity == now.environment_intensity
    return 1.0 if same else now.environment_intensity / before.environment_intensity


def _continue_sums(state: FrameState, brightness: float) -> FrameState:
    """The same sums under new settings of showing, and under a light `brightness` times as strong."""
    if not state.inputs.settings.split_indirect:
        state = replace(state, sums=replace(state.sums, indirect=None))
    if brightness != 1.0:
        old, found, moving = state.history, state.reprojected, state.quick_picture
        state = replace(
            state,
            sums=brighten_sums(state.sums, brightness),
            history=None if old is None else replace(old, light=brighten_light(old.light, brightness)),
            reprojected=None if found is None else replace(found, light=brighten_light(found.light, brightness)),
            quick_picture=None if moving is None else brighten_picture(moving, brightness),
        )
    return replace(state, tiles=replace(state.tiles, active=still_active(state, state.tiles.covered)))
