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
from drgs.render.resolve_frame import frame_errors, frame_history, linear_picture, resolve_frame, window_gbuffer
from drgs.render.sample_rays import PointArrays, point_arrays, shading_points
from drgs.render.shade import RayStarts, shade
from drgs.render.trace_primary import PrimaryPoints, trace_primary_points
from drgs.render.trace_rays import build_tracer, over_slices
from drgs.render.tracer import AbstractTracer
from drgs.scene.camera import Camera
from drgs.scene.posed_scene import PosedScene
from drgs.warp_torch import launch, thread_count, warp_array, warp_device

__all__ = [
    "FrameState",
    "RenderSettings",
    "linear_picture",
    "passes_needed",
    "refine_frame",
    "resolve_frame",
    "samples_a_pass",
    "start_frame",
]

wp.set_module_options({"enable_backward": False})

SLICES_A_THREAD = (2, 8)
"""Slices of the image for each thread when passes run side by side, fewest and most: with few, some thread waits, for one slice's rays may
cost twice another's; many are worth it where each still holds half of PIXELS_AT_ONCE."""
PIXELS_AT_ONCE = 32768
"""Camera rays that a thread takes together, of as many passes as that makes: Python's share of the time falls with it."""
SUMS = ("diffuse", "specular", "weight", "luminance", "luminance_squared", "scatter", "visibility")


@wp.kernel
def add_pass(
    first: int,
    pixel: wp.array[int],
    pass_diffuse: wp.array[wp.vec3],
    pass_specular: wp.array[wp.vec3],
    pass_variance: wp.array[wp.vec3],
    pass_visibility: wp.array[float],
    # outputs; each pixel occurs once a launch, or all launch indices run on one thread, so plain adds are exact and ordered
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
        tracer.horizons = Horizons(tracer.mesh, tracer.lift, scene.horizons)
    lap("build_tracer")
    table = build_environment_table(scene.environment) if previous is None or "environment_table" in make else previous.table
    light = environment_light(table, scene.environment_rotation_degrees, scene.environment_intensity)
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
    memory = (
        RayMemory(writes=not changed & {"camera", "shape"}) if previous is None or "first_rays" in make else RayMemory(previous.memory.rays)
    )
    pixels, device = camera.width * camera.height, seen.device
    # Memory is taken by the first pass, which copies them.
    numbers = [torch.zeros(1, *tail, device=device).expand(pixels, *tail) for tail in ((3,), (3,), (), (), (), (3,), ())]
    surface = torch.zeros(pixels if mesh_seen else 1, 15, device=device).expand(pixels, 15)
    history = frame_history(previous) if previous is not None and changed == {"camera"} and settings.denoise != "none" else None
    tile_passes = torch.zeros(across * down, dtype=torch.int64, device=device)
    lap("history")
    return FrameState(
        scene, camera, settings, tracer, table, light, plan, fixed, seen, memory, first, gbuffer, *numbers, surface,
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
    state = replace(state, **sums, surface=surface, tile_passes=state.tile_passes.clone(), memory=replace(state.memory))
    while passes > 0 and bool(state.active.any()):
        # Tiles that rested while others went on catch up first, so that passes of one tile follow each other.
        index = int(state.tile_passes[state.active].min())
        chosen = state.active & (state.tile_passes == index)
        count = _passes_at_once(state, chosen, index, passes)
        state = _add_first_pass(state, chosen, index) if count == 1 else _add_passes(state, chosen, index, count)
        state.tile_passes[chosen] += count
        passes -= count
        if state.history is not None:
            state = replace(
                state, reprojected=reproject(state.history, window_gbuffer(state), state.window.camera(state.camera)), history=None
            )
        if state.settings.target_error is not None and index + count >= MIN_PASSES:
            state = replace(state, active=_still_active(state, state.active))
    return state


def _passes_at_once(state: FrameState, chosen: Tensor, index: int, passes: int) -> int:
    """How many of the next `passes` need nobody to look between them."""
    if state.fixed is not None or index == 0 or state.weight.is_cuda:
        return 1
    if state.settings.target_error is not None:
        passes = min(passes, max(MIN_PASSES, 1 << index.bit_length()) - index)  # the next look
    behind = state.tile_passes[state.active & ~chosen]
    return min(passes, int(behind.min()) - index) if len(behind) else passes


def _add_first_pass(state: FrameState, chosen: Tensor, index: int) -> FrameState:
    """One pass over chosen tiles; adds to the given state's sums."""
    clock = time.perf_counter()
    whole_first_pass = index == 0 and bool((chosen == state.seen).all())
    primary = _primary_points(state, chosen, index, whole_first_pass)
    traced = time.perf_counter()
    _shade_and_add(state, primary, index, state.memory if whole_first_pass else None)
    if state.fixed is None and whole_first_pass:
        state = replace(state, first=primary)
    return _pay(
        state, primary.starts.face, len(primary.points.pixel), {"trace_primary": traced - clock, "shade": time.perf_counter() - traced}
    )


def _add_passes(state: FrameState, chosen: Tensor, index: int, count: int) -> FrameState:
    """Several passes over chosen tiles of a mesh, each thread with pixels of its own: nobody waits for the others between passes."""
    clock = time.perf_counter()
    pixels = pixels_of_tiles(chosen, state.camera.width, state.camera.height)

    def work(first: int, last: int) -> tuple[int, float, Tensor | None]:
        points, tracing, at_once = 0, 0.0, max(1, PIXELS_AT_ONCE // (last - first))
        for round_ in range(index, index + count, at_once):
            began = time.perf_counter()
            together = min(at_once, index + count - round_)
            primary = trace_primary_points(
                state.tracer, state.camera, state.settings.seed, round_, pixels=pixels[first:last], passes=together
            )  # fmt: skip
            tracing += time.perf_counter() - began
            _shade_and_add(state, primary, round_ if primary.round is None else primary.round, None)
            points += len(primary.points.pixel)
        return points, tracing, primary.starts.face

    fewest, most = (slices * thread_count() for slices in SLICES_A_THREAD)
    slices = min(max(fewest, 2 * len(pixels) * count // PIXELS_AT_ONCE), most)
    done = over_slices(len(pixels), pixels.device, work, max(1, -(-len(pixels) // slices)))
    traced = sum(seconds for _, seconds, _ in done) / max(1, min(thread_count(), len(done)))
    seconds = {"trace_primary": traced, "shade": max(0.0, time.perf_counter() - clock - traced)}
    starts = torch.cat([faces for *_, faces in done if faces is not None])
    return _pay(state, starts, sum(points for points, *_ in done), seconds)


def _shade_and_add(state: FrameState, primary: PrimaryPoints, index: int | Tensor, memory: RayMemory | None) -> None:
    """Light of the points of pass `index`, or of several passes, added to the sums of their pixels."""
    plan, settings, points, device = state.plan, state.settings, primary.points, warp_device(state.weight)
    horizon = usable_horizons(state.tracer.horizons, settings.skip_error) if settings.skip else None
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
    vectors = [warp_array(light.diffuse, wp.vec3), warp_array(light.specular, wp.vec3)]
    numbers = [warp_array(light.variance, wp.vec3), warp_array(light.visibility)]
    arrays = [warp_array(sum_, wp.vec3 if sum_.dim() == 2 else None) for sum_ in (getattr(state, name) for name in SUMS)]
    launch(add_pass, len(points.pixel), [warp_array(points.pixel), *vectors, *numbers], arrays, device)
    if state.fixed is None:
        launch(add_surface, len(points.pixel), [point_arrays(points), warp_array(primary.depth)], [warp_array(state.surface)], device)


def _pay(state: FrameState, starts: Tensor | None, points: int, durations: dict[str, float]) -> FrameState:
    """Books a step's time, and the search for horizons on its rays.

    Args:
        starts: (point,) faces of some of the points.
    """
    clock = time.perf_counter()
    if state.settings.skip and state.tracer.horizons is not None:
        state.tracer.horizons.pay(points * state.plan.counts.total, starts)
    seconds = dict(state.seconds)
    for step, duration in (*durations.items(), ("horizons", time.perf_counter() - clock)):
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
