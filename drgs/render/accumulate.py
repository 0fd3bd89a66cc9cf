"""Progressive frames: start, refine as often as wished, look at any time.

A pass adds `samples_per_pass` rays to every covered pixel and updates the running sums; passes continue the same
low-discrepancy sequences, so n passes of k samples are as good as one of n k. With the mesh as primary
surface each pass also looks through another place of the pixel. State is a frozen record: refining returns a new one.
A frame that follows another takes over all that its inputs did not change (invalidate.py).
"""

import time
from dataclasses import replace

import torch
import warp as wp
from torch import Tensor

from drgs.render.converge import MIN_PASSES, tiles_to_go_on
from drgs.render.environment_table import build_environment_table, environment_light
from drgs.render.frame_state import FrameState, RenderSettings, passes_needed, rays_key, samples_a_pass
from drgs.render.horizon import Horizons, usable_horizons
from drgs.render.image_tiles import pixels_of_tiles, tile_grid, tile_of_pixels, tiles_of_mesh
from drgs.render.invalidate import PARTS, FrameInputs, Input, changed_inputs, parts_to_make
from drgs.render.lift_points import lift_points
from drgs.render.plan import RenderPlan, plan_frame, scene_facts
from drgs.render.rasterize_gbuffer import rasterize_gbuffer
from drgs.render.ray_memory import RayMemory
from drgs.render.records import GBuffer, ShadingPoints
from drgs.render.refresh_materials import refresh_gbuffer, refresh_points, refresh_primary
from drgs.render.reproject import brighten, reproject
from drgs.render.resolve_frame import frame_errors, frame_gbuffer, frame_history, resolve_frame
from drgs.render.sample_rays import PointArrays, point_arrays, shading_points
from drgs.render.shade import RayStarts, shade
from drgs.render.trace_primary import PrimaryPoints, trace_primary_points
from drgs.render.trace_rays import build_tracer
from drgs.render.tracer import AbstractTracer
from drgs.scene.camera import Camera
from drgs.scene.posed_scene import PosedScene
from drgs.warp_torch import launch, warp_array, warp_device

__all__ = ["FrameState", "RenderSettings", "passes_needed", "refine_frame", "resolve_frame", "samples_a_pass", "start_frame"]

wp.set_module_options({"enable_backward": False})

SUMS = ("diffuse", "specular", "weight", "luminance", "luminance_squared", "scatter", "visibility")


@wp.kernel
def add_pass(
    first: int,
    pixel: wp.array[int],
    pass_diffuse: wp.array[wp.vec3],
    pass_specular: wp.array[wp.vec3],
    pass_variance: wp.array[wp.vec3],
    pass_visibility: wp.array[float],
    # outputs; each pixel occurs once a pass, so plain adds are exact and ordered
    diffuse: wp.array[wp.vec3],
    specular: wp.array[wp.vec3],
    weight: wp.array[float],
    luminance: wp.array[float],
    luminance_squared: wp.array[float],
    scatter: wp.array[wp.vec3],
    visibility: wp.array[float],
):
    i = first + wp.tid()
    p = pixel[i]
    c = pass_diffuse[i] + pass_specular[i]
    y = 0.2126 * c[0] + 0.7152 * c[1] + 0.0722 * c[2]
    diffuse[p] = diffuse[p] + pass_diffuse[i]
    specular[p] = specular[p] + pass_specular[i]
    weight[p] = weight[p] + 1.0
    luminance[p] = luminance[p] + y
    luminance_squared[p] = luminance_squared[p] + y * y
    scatter[p] = scatter[p] + pass_variance[i]
    visibility[p] = visibility[p] + pass_visibility[i]


@wp.kernel
def add_surface(
    first: int,
    points: PointArrays,
    depth: wp.array[float],
    # outputs
    surface: wp.array2d[float],
):
    i = first + wp.tid()
    p = points.pixel[i]
    for k in range(3):
        surface[p, k] = surface[p, k] + points.position[i][k]
        surface[p, 3 + k] = surface[p, 3 + k] + points.normal[i][k]
        surface[p, 6 + k] = surface[p, 6 + k] + points.wo[i][k]
        surface[p, 9 + k] = surface[p, 9 + k] + points.albedo[i][k]
    surface[p, 12] = surface[p, 12] + points.roughness[i]
    surface[p, 13] = surface[p, 13] + points.metallic[i]
    surface[p, 14] = surface[p, 14] + depth[i]


def start_frame(
    scene: PosedScene,
    camera: Camera,
    settings: RenderSettings,
    tracer: AbstractTracer | None = None,
    gbuffer: GBuffer | None = None,
    previous: FrameState | None = None,
) -> FrameState:
    """All that a frame needs before its first pass.

    Args:
        tracer: of scene.mesh, to reuse one.
        gbuffer: of the scene's Gaussians through this camera, to reuse one.
        previous: the frame before, at any stage: what did not change is taken over, its sums included, so that a frame of which only
            the exposure changed goes on where it was.
    """
    seconds: dict[str, float] = {}
    clock = time.perf_counter()

    def lap(step: str) -> None:
        nonlocal clock
        now = time.perf_counter()
        seconds[step] = seconds.get(step, 0.0) + now - clock
        clock = now

    primary = settings.primary or ("gaussians" if scene.surfels is not None else "mesh")
    if primary == "gaussians" and scene.surfels is None and gbuffer is None:
        raise ValueError("primary 'gaussians' was asked for, but this scene has no Gaussians; use primary 'mesh'")
    mesh_seen = primary == "mesh"
    make = frozenset(PARTS)
    changed: frozenset[Input] = frozenset()
    if previous is not None:
        old_inputs = FrameInputs(previous.scene, previous.camera, rays_key(previous.settings, previous.fixed is None))
        changed = changed_inputs(old_inputs, FrameInputs(scene, camera, rays_key(settings, mesh_seen)))
        make = parts_to_make(changed)

    if tracer is None:
        if previous is None or "tracer" in make:
            tracer = build_tracer(scene.mesh)
        else:
            tracer = previous.tracer if previous.tracer.mesh is scene.mesh else previous.tracer.with_materials(scene.mesh)
    if tracer.horizons is None and settings.skip:
        tracer.horizons = Horizons(tracer.mesh, tracer.lift)
    lap("build_tracer")
    table = build_environment_table(scene.environment) if previous is None or "environment_table" in make else previous.table
    light = environment_light(scene.environment, table, scene.environment_rotation_degrees, scene.environment_intensity)
    lap("environment_table")

    fixed = first = None
    across, down = tile_grid(camera.width, camera.height)
    seen = torch.ones(across * down, dtype=torch.bool, device=scene.mesh.vertices.device)
    if mesh_seen:
        gbuffer = None
        if previous is not None and "view" not in make:
            seen, first = previous.seen, previous.first
            if first is not None and "materials" in make:
                first = refresh_primary(first, scene.mesh)
        elif settings.skip:
            seen = tiles_of_mesh(scene.mesh, camera)
        lap("trace_primary")
    elif previous is not None and "view" not in make and previous.gbuffer is not None and previous.fixed is not None:
        gbuffer, fixed = previous.gbuffer, previous.fixed
        if "materials" in make:
            assert scene.surfels is not None
            gbuffer = refresh_gbuffer(gbuffer, scene.surfels, camera)
            fixed = replace(fixed, points=refresh_points(fixed.points, gbuffer))
        lap("rasterize_gbuffer")
    else:
        if gbuffer is None:
            assert scene.surfels is not None
            gbuffer = rasterize_gbuffer(scene.surfels, camera)
        lap("rasterize_gbuffer")
        points = shading_points(gbuffer)
        fixed = PrimaryPoints(points, lift_points(points, tracer), gbuffer.depth.reshape(-1)[points.pixel.long()])
        lap("lift_points")
    if fixed is not None and settings.skip:
        seen = torch.zeros_like(seen)
        seen[tile_of_pixels(fixed.points.pixel, camera.width)] = True
    if not bool(seen.any()):
        seen[0] = True  # a picture of nothing is done after one pass as well

    plan = _plan(scene, settings, mesh_seen, seen, previous, "plan" in make)
    made = tuple(part for part in PARTS if part in make)
    if previous is not None and "sums" not in make:
        factor = scene.environment_intensity / previous.scene.environment_intensity if "scale" in make else 1.0
        parts = {"tracer": tracer, "table": table, "light": light, "plan": plan, "made": made, "seconds": seconds}
        return _continued(replace(previous, scene=scene, settings=settings, **parts), factor)
    memory = RayMemory() if previous is None or "first_rays" in make else RayMemory(previous.memory.rays)
    pixels, device = camera.width * camera.height, seen.device
    numbers = [torch.zeros(pixels, *tail, device=device) for tail in ((3,), (3,), (), (), (), (3,), (), (15,))]
    history = frame_history(previous) if previous is not None and changed == {"camera"} and settings.denoise != "none" else None
    tile_passes = torch.zeros(across * down, dtype=torch.int64, device=device)
    lap("history")
    return FrameState(
        scene, camera, settings, tracer, table, light, plan, fixed, seen, memory, first, gbuffer, *numbers,
        tile_passes, seen.clone(), history, None, made, seconds,
    )  # fmt: skip


def _plan(scene: PosedScene, settings: RenderSettings, mesh_seen: bool, seen: Tensor, previous: FrameState | None, old: bool) -> RenderPlan:
    if previous is not None and not old:
        return previous.plan
    facts = scene_facts(scene, empty_tiles=int((~seen).sum()), tiles=len(seen))
    return plan_frame(
        scene.environment, scene.environment_intensity, samples_a_pass(settings, mesh_seen), settings.bounces, settings.skip, facts,
        settings.skip_error,
    )  # fmt: skip


def _continued(state: FrameState, factor: float) -> FrameState:
    """Sums that go on under new settings of showing, or under a light `factor` times as strong."""
    if factor != 1.0:
        powers = {"diffuse": 1, "specular": 1, "luminance": 1, "luminance_squared": 2, "scatter": 2}
        state = replace(state, **{name: getattr(state, name) * factor**power for name, power in powers.items()})
        if state.history is not None:
            state = replace(state, history=brighten(state.history, factor))
        if state.reprojected is not None:
            state = replace(state, reprojected=brighten(state.reprojected, factor))
    return replace(state, active=_still_active(state, state.seen))


def _still_active(state: FrameState, active: Tensor) -> Tensor:
    """The active tiles without those below the error asked for."""
    target = state.settings.target_error
    return active.clone() if target is None else active & tiles_to_go_on(frame_errors(state), state.tile_passes, target)


def refine_frame(state: FrameState, passes: int = 1) -> FrameState:
    """The frame after `passes` more passes over the tiles that still need them; the given state stays as it is."""
    sums = {name: getattr(state, name).clone() for name in SUMS}
    surface = state.surface if state.fixed is not None else state.surface.clone()
    state = replace(state, **sums, surface=surface, tile_passes=state.tile_passes.clone(), memory=RayMemory(state.memory.rays))
    for _ in range(passes):
        if not bool(state.active.any()):
            break
        state = _add_pass(state)
    return state


def _add_pass(state: FrameState) -> FrameState:
    """One pass over the active tiles that have had fewest; adds to the given state's sums."""
    clock = time.perf_counter()
    plan, settings, device = state.plan, state.settings, warp_device(state.surface)
    index = int(state.tile_passes[state.active].min())
    chosen = state.active & (state.tile_passes == index)
    whole_first_pass = index == 0 and bool((chosen == state.seen).all())
    primary = _primary_points(state, chosen, index, whole_first_pass)
    points = primary.points
    traced = time.perf_counter()
    horizon = usable_horizons(state.tracer.horizons, settings.skip_error) if settings.skip else None
    memory = state.memory if whole_first_pass else None
    light = shade(
        points,
        primary.starts,
        state.light,
        state.tracer,
        plan.counts,
        plan.bounces,
        settings.seed,
        index,
        plan.by_material,
        memory,
        horizon,
    )
    if settings.skip and state.tracer.horizons is not None:
        state.tracer.horizons.pay(len(points.pixel) * plan.counts.total)
    shaded = time.perf_counter()
    vectors = [warp_array(light.diffuse, wp.vec3), warp_array(light.specular, wp.vec3)]
    numbers = [warp_array(light.variance, wp.vec3), warp_array(light.visibility)]
    arrays = [warp_array(sum_, wp.vec3 if sum_.dim() == 2 else None) for sum_ in (getattr(state, name) for name in SUMS)]
    launch(add_pass, len(points.pixel), [warp_array(points.pixel), *vectors, *numbers], arrays, device)
    if state.fixed is None:
        launch(add_surface, len(points.pixel), [point_arrays(points), warp_array(primary.depth)], [warp_array(state.surface)], device)
    state.tile_passes[chosen] += 1
    if state.fixed is None and whole_first_pass:
        state = replace(state, first=primary)
    if state.history is not None:
        state = replace(state, reprojected=reproject(state.history, frame_gbuffer(state), state.camera), history=None)
    if settings.target_error is not None and index + 1 >= MIN_PASSES:
        state = replace(state, active=_still_active(state, state.active))
    ended = time.perf_counter()
    seconds = dict(state.seconds)
    for step, duration in (("trace_primary", traced - clock), ("shade", shaded - traced), ("accumulate", ended - shaded)):
        seconds[step] = seconds.get(step, 0.0) + duration
    return replace(state, seconds=seconds)


def _primary_points(state: FrameState, chosen: Tensor, index: int, whole_first_pass: bool) -> PrimaryPoints:
    """What the camera sees in the chosen tiles in pass `index`."""
    camera = state.camera
    if state.fixed is None:
        if whole_first_pass and state.first is not None:
            return state.first
        pixels = pixels_of_tiles(chosen, camera.width, camera.height)
        return trace_primary_points(state.tracer, camera, state.settings.seed, index, pixels=pixels)
    if bool((chosen == state.seen).all()):
        return state.fixed
    fixed = state.fixed
    here = torch.nonzero(chosen[tile_of_pixels(fixed.points.pixel, camera.width)]).squeeze(-1)
    points = ShadingPoints(**{name: values[here] for name, values in vars(fixed.points).items()})
    face = None if fixed.starts.face is None else fixed.starts.face[here]
    starts = RayStarts(fixed.starts.origin_world[here], fixed.starts.surface_normal_world[here], face)
    return PrimaryPoints(points, starts, fixed.depth[here])
