"""More passes over a frame: refine as often as wished, look at any time.

A pass adds `samples_per_pass` rays to every covered pixel and updates the running sums; passes continue the same
low-discrepancy sequences, so n passes of k samples are as good as one of n k. With the mesh as primary
surface each pass also looks through another place of the pixel, and from the fifth on through more places of some pixels than
of others (spread_places.py). State is a frozen record: refining returns a new one.
"""

import time
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from drgs.render.integrate.choose_integrator import choose_integrator
from drgs.render.integrate.environment_pool import ROUNDS_KEPT, draw_ahead
from drgs.render.integrate.integrator import IntegratorSettings
from drgs.render.integrate.plan import at_rest, moving_counts
from drgs.render.intersect.horizon import usable_horizons
from drgs.render.intersect.ray_memory import RayMemory
from drgs.render.intersect.trace_rays import over_slices
from drgs.render.intersect.tracer import AbstractTracer
from drgs.render.progressive.converge import MIN_PASSES, still_active
from drgs.render.progressive.edited_picture import EditedPoints
from drgs.render.progressive.frame_state import FrameState, GaussianView, MeshView, Tiles, with_seconds
from drgs.render.progressive.frame_sums import add_estimate, copy_sums, no_sums, sum_arrays
from drgs.render.progressive.kept_light.shade_moving import shade_moving
from drgs.render.progressive.mean_radiance import frame_history, mean_gbuffer
from drgs.render.progressive.neighbours import neighbourhood
from drgs.render.progressive.quick_picture import quick_picture
from drgs.render.progressive.reproject import reproject
from drgs.render.progressive.see_middles import see_middles
from drgs.render.progressive.spread_places import (
    FIRST_LOOK,
    ONE,
    Looks,
    count_places,
    decide_rates,
    is_look,
    list_looks,
    next_look,
    places_between,
)
from drgs.render.records import PrimaryPoints
from drgs.render.visible.image_tiles import pixels_of_tiles, tile_of_pixels, tiles_of_mesh
from drgs.render.visible.points_at import points_at
from drgs.render.visible.trace_primary import trace_primary_points
from drgs.warp_torch import thread_count

MOST_SLICES = 8
"""Of the image for each thread when passes run side by side, where each still holds half of PIXELS_AT_ONCE: a slice takes milliseconds of Python,
which threads wait for in turn."""
PIXELS_AT_ONCE = 131072
"""Camera rays that a thread takes together, of as many passes as that makes: Python's share of the time falls with it."""
BLOCK_PIXELS = 256
"""Neighbours that one slice has together, for their rays search the same boxes. Blocks are dealt out in turn, so that slices take equally long,
though one part of the image costs twice another."""
POOLS_AT_ONCE = 16
"""Passes that a thread takes together at most where samples choose: their pools (environment_pool.py) then take 2 MiB."""


def refine_frame(state: FrameState, passes: int = 1, consume: bool = False) -> FrameState:
    """The frame after `passes` more passes over the tiles that still need them; the given state stays as it is.

    Args:
        consume: the given state is not needed any more, and its sums are added to instead of copied.
    """
    if state.is_quick:
        state = _begin_anew(state)
    if state.plan.every_other and state.passes == 0 and passes == 1:
        return _show_edit(state)
    if state.plan.moving and state.passes == 0 and passes == 1 and state.plan.counts.total > 0:
        return _move(state)
    state = replace(state, plan=at_rest(state.plan))
    if not consume or state.passes == 0:  # sums of no pass share one zero
        state = _with_sums_of_its_own(state)
    while passes > 0 and bool(state.tiles.active.any()):
        # Tiles that rested while others went on catch up first, so that passes of one tile follow each other.
        index = int(state.tiles.passes[state.tiles.active].min())
        chosen = state.tiles.active & (state.tiles.passes == index)
        if state.plan.spread_places and is_look(index):
            rates = decide_rates(state.sums, state.rates, chosen, state.inputs.camera.width, state.inputs.height)
            state = replace(state, rates=rates)
        count = _passes_at_once(state, chosen, index, passes)
        one_by_one = count == 1 and (state.rates is None or index < FIRST_LOOK)
        state = _add_pass(state, chosen, index) if one_by_one else _add_passes(state, chosen, index, count)
        state.tiles.passes[chosen] += count
        passes -= count
        if state.history is not None:
            found = reproject(state.history, mean_gbuffer(state), state.window.camera(state.inputs.camera))
            state = replace(state, reprojected=found, history=None)
        if state.inputs.settings.target_error is not None and index + count >= MIN_PASSES:
            state = replace(state, tiles=replace(state.tiles, active=still_active(state, state.tiles.active)))
    return state


def _begin_anew(state: FrameState) -> FrameState:
    """A frame whose one pass was a quick picture, before its first pass: what a moving one showed is history."""
    inputs = state.inputs
    if state.quick_picture is not None and state.quick_picture.of_edit:
        tiles = Tiles(state.tiles.covered, torch.zeros_like(state.tiles.passes), state.tiles.covered.clone())
        return replace(state, plan=at_rest(state.plan), tiles=tiles, quick_picture=None)
    covered = tiles_of_mesh(inputs.scene.mesh, inputs.camera)
    covered[0] |= ~covered.any()
    sums = no_sums(len(state.sums.weight), True, inputs.settings.split_indirect, covered.device)
    tiles = Tiles(covered, torch.zeros_like(state.tiles.passes), covered.clone())
    plan = at_rest(state.plan)
    history = frame_history(state)
    return replace(state, plan=plan, view=MeshView(), sums=sums, tiles=tiles, history=history, reprojected=None, quick_picture=None)


def _move(state: FrameState) -> FrameState:
    """The frame after the one pass of a moving picture; its sums stay empty."""
    started = time.perf_counter()
    middles = see_middles(state.traced.tracer, state.inputs.camera, state.tiles.covered)
    seen, primary = time.perf_counter(), middles.primary
    integrator, light, how = choose_integrator(state.traced.tracer.swift), state.traced.environment_light, _how(state)
    kept, kept_samples = state.kept_light, None
    if state.plan.kept_light:
        assert kept is not None
        where = neighbourhood(middles.window, 1.0 / float(state.inputs.camera.intrinsics[0, 0]), middles.place)
        moving = shade_moving(integrator, primary, light, how, kept, _horizon(state), where)
        found, kept, kept_samples = moving.light, moving.kept, moving.kept_samples
    else:
        found = integrator.shade(primary.points, primary.starts, light, how, 0, None, _horizon(state))
    shaded, camera = time.perf_counter(), middles.window.camera(state.inputs.camera)
    picture = quick_picture(middles.surface, middles.place, found, kept_samples, how.counts.total, camera, state.history)
    seconds = {"trace_primary": seen - started, "shade": shaded - seen, "history": time.perf_counter() - shaded}
    tiles = Tiles(middles.tiles, middles.tiles.long(), middles.tiles.clone())
    state = replace(state, tiles=tiles, view=MeshView(), history=None, kept_light=kept, quick_picture=picture)
    return _pay_for_horizons(with_seconds(state, seconds), primary.starts.face, len(primary.points.pixel))


def _show_edit(state: FrameState) -> FrameState:
    """The frame after the one pass of a picture that is shown at once after an edit; its sums stay empty."""
    started = time.perf_counter()
    assert isinstance(state.view, MeshView) and state.view.first_primary_points is not None
    primary, camera, how = state.view.first_primary_points, state.window.camera(state.inputs.camera), _how(state)
    edited = EditedPoints(primary, state.window, camera)
    found_out = time.perf_counter()
    integrator, light = choose_integrator(state.traced.tracer.swift_if_made), state.traced.environment_light
    known, horizon = state.first_rays, _horizon(state)
    found = integrator.shade(primary.points, primary.starts, light, how, 0, known, horizon, order=edited.order)
    shaded = time.perf_counter()
    picture = edited.picture(found, state.rays_a_pass)
    seconds = {"trace_primary": found_out - started, "shade": shaded - found_out, "history": time.perf_counter() - shaded}
    tiles = replace(state.tiles, passes=state.tiles.covered.long(), active=state.tiles.covered.clone())
    return with_seconds(replace(state, tiles=tiles, history=None, quick_picture=picture), seconds)


def _with_sums_of_its_own(state: FrameState) -> FrameState:
    """What passes write to is copied; nothing else is ever written to."""
    tiles = replace(state.tiles, passes=state.tiles.passes.clone())
    return replace(state, sums=copy_sums(state.sums), tiles=tiles, first_rays=replace(state.first_rays))


def _passes_at_once(state: FrameState, chosen: Tensor, index: int, passes: int) -> int:
    """How many of the next `passes` need nobody to look between them."""
    if isinstance(state.view, GaussianView) or index == 0 or state.sums.weight.is_cuda:
        return 1
    if state.inputs.settings.target_error is not None:
        passes = min(passes, max(MIN_PASSES, 1 << index.bit_length()) - index)  # the next look
    if state.plan.spread_places:
        passes = min(passes, next_look(index) - index)
    if state.plan.candidates > 1:
        passes = min(passes, ROUNDS_KEPT)  # so that all slices find the same pools
    behind = state.tiles.passes[state.tiles.active & ~chosen]
    return min(passes, int(behind.min()) - index) if len(behind) else passes


def _add_pass(state: FrameState, chosen: Tensor, index: int) -> FrameState:
    """One pass over chosen tiles; adds to the given state's sums."""
    started = time.perf_counter()
    whole_first_pass = index == 0 and bool((chosen == state.tiles.covered).all())
    primary = _primary_points(state, chosen, index, whole_first_pass)
    traced = time.perf_counter()
    arrays = sum_arrays(state.sums, state.inputs.first_pixel)
    _shade_and_add(state, arrays, _light_tracer(state, index), primary, index, state.first_rays if whole_first_pass else None)
    count_places(state.sums, _pixels(state, chosen).long() - state.inputs.first_pixel, None, index, index + 1)
    if whole_first_pass and isinstance(state.view, MeshView):
        state = replace(state, view=MeshView(first_primary_points=primary))
    seconds = {"trace_primary": traced - started, "shade": time.perf_counter() - traced}
    return _pay_for_horizons(with_seconds(state, seconds), primary.starts.face, len(primary.points.pixel))


def _add_passes(state: FrameState, chosen: Tensor, index: int, count: int) -> FrameState:
    """Several passes over chosen tiles of a mesh, each thread with pixels of its own: nobody waits for the others between passes."""
    started = time.perf_counter()
    camera, seed, tracer = state.inputs.camera, state.inputs.settings.seed, _light_tracer(state, index)
    pixels = _pixels(state, chosen)
    slices = thread_count() * min(max(1, 2 * len(pixels) * count // (PIXELS_AT_ONCE * thread_count())), MOST_SLICES)
    pixels = _dealt(pixels, slices)
    here = pixels.long() - state.inputs.first_pixel
    rates = None if index < FIRST_LOOK or state.rates is None else state.rates[here]
    places, arrays = state.sums.places[here].int(), sum_arrays(state.sums, state.inputs.first_pixel)

    def work(first: int, last: int) -> tuple[int, float, Tensor | None]:
        own, so_far = None if rates is None else rates[first:last], places[first:last]
        a_pass = last - first if own is None else int(own.sum()) // ONE
        points, tracing, at_once = 0, 0.0, max(1, PIXELS_AT_ONCE // max(1, a_pass))
        at_once = min(at_once, POOLS_AT_ONCE) if state.plan.candidates > 1 else at_once
        for round_ in range(index, index + count, at_once):
            began = time.perf_counter()
            end = min(round_ + at_once, index + count)
            looks = list_looks(pixels[first:last], round_, end, own, so_far)
            if own is not None:
                so_far = so_far + places_between(own, round_, end)
            primary = trace_primary_points(state.traced.tracer, camera, seed, round_, pixels=looks.pixels, rounds=looks.rounds)
            tracing += time.perf_counter() - began
            _shade_and_add(state, arrays, tracer, primary, looks, None)
            points += len(primary.points.pixel)
        return points, tracing, primary.starts.face

    if state.plan.candidates > 1:
        draw_ahead(state.traced.environment_light, state.inputs.settings.seed, index, index + count, pixels.device)
    done = over_slices(len(pixels), pixels.device, work, max(1, -(-len(pixels) // slices)))
    count_places(state.sums, here, None if rates is None else state.rates, index, index + count)
    traced = sum(seconds for _, seconds, _ in done) / max(1, min(thread_count(), len(done)))
    seconds = {"trace_primary": traced, "shade": max(0.0, time.perf_counter() - started - traced)}
    starts = torch.cat([faces for *_, faces in done if faces is not None])
    return _pay_for_horizons(with_seconds(state, seconds), starts, sum(points for points, *_ in done))


def _dealt(pixels: Tensor, hands: int) -> Tensor:
    """Pixels (pixel,) in blocks of neighbours, each hand's blocks behind one another: every so manieth of the image."""
    blocks = pixels.split(BLOCK_PIXELS)
    return torch.cat([block for hand in range(hands) for block in blocks[hand::hands]])


def _primary_points(state: FrameState, chosen: Tensor, index: int, whole_first_pass: bool) -> PrimaryPoints:
    """What the camera sees in the chosen tiles in pass `index`."""
    camera, view = state.inputs.camera, state.view
    if isinstance(view, GaussianView):
        everywhere = bool((chosen == state.tiles.covered).all())
        return view.primary_points if everywhere else points_in_tiles(view.primary_points, chosen, camera.width, state.inputs.first_pixel)
    if whole_first_pass and view.first_primary_points is not None:
        return view.first_primary_points
    seed, pixels = state.inputs.settings.seed, _pixels(state, chosen)
    return trace_primary_points(state.traced.tracer, camera, seed, index, pixels=pixels)


def _light_tracer(state: FrameState, index: int) -> AbstractTracer:
    """Of the light rays of pass `index`. The first one does not wait for a second tree, which a shape that moves would need for every picture."""
    tracer = state.traced.tracer
    return tracer.swift if index > 0 and state.plan.swift else tracer


def _pixels(state: FrameState, chosen: Tensor) -> Tensor:
    """(pixel,) int32 numbers in the image of the pixels of chosen tiles."""
    inputs = state.inputs
    pixels = pixels_of_tiles(chosen, inputs.camera.width, inputs.height)
    return pixels if inputs.band is None else pixels + inputs.first_pixel


def points_in_tiles(primary: PrimaryPoints, tiles: Tensor, width: int, first_pixel: int = 0) -> PrimaryPoints:
    """The points whose pixels lie in chosen tiles (tile,) bool of an image of this width, or of its band that begins at `first_pixel`."""
    return points_at(primary, torch.nonzero(tiles[tile_of_pixels(primary.points.pixel - first_pixel, width)]).squeeze(-1))


def _shade_and_add(
    state: FrameState,
    arrays: Any,
    tracer: AbstractTracer,
    primary: PrimaryPoints,
    looks: int | Looks,
    memory: RayMemory | None,
) -> None:
    """Light of the points of one pass, or of several passes' looks, added to the sums of their pixels (`sum_arrays`)."""
    integrator, light_there, how = choose_integrator(tracer), state.traced.environment_light, _how(state)
    rounds: int | Tensor
    if isinstance(looks, int):
        rounds, pools = looks, None
    else:
        assert primary.ray is not None
        rounds, pools = looks.rounds[primary.ray], looks.passes[primary.ray]
    light = integrator.shade(primary.points, primary.starts, light_there, how, rounds, memory, _horizon(state), pool_rounds=pools)
    add_estimate(state.sums, arrays, primary, light)


def _how(state: FrameState) -> IntegratorSettings:
    plan, settings = state.plan, state.inputs.settings
    counts = moving_counts(plan.counts) if plan.moving else plan.counts
    return IntegratorSettings(counts, plan.bounces, settings.seed, plan.by_material, settings.split_indirect, plan.candidates)


def _horizon(state: FrameState) -> Tensor | None:
    settings = state.inputs.settings
    return usable_horizons(state.traced.tracer.horizons, settings.skip_error) if settings.skip else None


def _pay_for_horizons(state: FrameState, starts: Tensor | None, points: int) -> FrameState:
    """The search for horizons goes on as far as the rays of these points pay for it.

    Args:
        starts: (point,) faces of some of the points.
    """
    started, horizons = time.perf_counter(), state.traced.tracer.horizons
    if state.inputs.settings.skip and horizons is not None:
        horizons.pay(points * _how(state).counts.total, starts)
    return with_seconds(state, {"horizons": time.perf_counter() - started})
