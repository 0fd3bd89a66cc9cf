"""What the passes so far amount to: sums in; mean radiance, its variance and the mean G-buffer out, of the window that shows something."""

from dataclasses import replace
from typing import Any
from weakref import WeakKeyDictionary

import torch
import warp as wp
from torch import Tensor

from drgs.render.progressive.demodulate_albedo import remodulate_albedo
from drgs.render.progressive.frame_state import FrameState, GaussianView
from drgs.render.progressive.frame_sums import FrameSums, SumArrays, sum_arrays
from drgs.render.progressive.quick_picture import QuickPicture
from drgs.render.progressive.reproject import blend_history, remember
from drgs.render.records import DemodulatedLight, GBuffer, History, Radiance
from drgs.render.visible.image_tiles import Window
from drgs.render.visible.rasterize.gbuffer import GBufferArrays, gbuffer_arrays
from drgs.warp_torch import launch, warp_array, warp_device

wp.set_module_options({"enable_backward": False})


@wp.struct
class WindowPlace:
    """Where a window lies in the image; it begins at a tile's corner [pixels]."""

    width: int
    row: int
    column: int
    image_width: int


@wp.struct
class MeanMaps:
    """Radiance as kernels see it."""

    diffuse: wp.array2d[wp.vec3]
    specular: wp.array2d[wp.vec3]
    variance: wp.array2d[float]
    visibility: wp.array2d[float]
    diffuse_variance: wp.array2d[float]
    specular_variance: wp.array2d[float]
    indirect: wp.array2d[wp.vec3]
    """Empty unless asked for."""


@wp.kernel
def mean_over_passes(
    first: int,
    window: WindowPlace,
    sums: SumArrays,
    # outputs
    mean: MeanMaps,
):
    """Variance: converge.mean_variance, of places that found a surface."""
    i = first + wp.tid()
    y = i / window.width
    x = i - y * window.width
    p = (window.row + y) * window.image_width + window.column + x
    count = wp.max(sums.places[p], 1.0)
    w = wp.max(sums.weight[p], 1.0)
    mean.diffuse[y, x] = sums.diffuse[p] / w
    mean.specular[y, x] = sums.specular[p] / w
    mean.visibility[y, x] = sums.visibility[p] / w
    if sums.indirect.shape[0] > 0:
        mean.indirect[y, x] = sums.indirect[p] / w
    within = sums.scatter[p]
    of_mean = within[0]
    if count > 1.0:
        luminance = sums.luminance[p] / count
        of_mean = wp.max(sums.luminance_squared[p] / count - luminance * luminance, 0.0) / (count - 1.0)
    mean.variance[y, x] = of_mean * (count / w) * (count / w)
    mean.diffuse_variance[y, x] = within[1] / (w * w)
    mean.specular_variance[y, x] = within[2] / (w * w)


_means: WeakKeyDictionary[FrameState, Radiance] = WeakKeyDictionary()
"""Of states that live: the picture that is shown is the next one's history."""


def mean_radiance(state: FrameState) -> Radiance:
    """Straight (alpha-normalised) radiance of the window, with what history adds; the variance is that of the mean of one pixel's passes."""
    if state in _means:
        return _means[state]
    if state.quick_picture is not None:
        radiance = _means[state] = quick_radiance(state.quick_picture, state.quick_picture.history.light, state.samples)
        return radiance
    own = _own_samples(state)
    height, width = own.shape[:2]
    diffuse, specular = (own.new_empty(height, width, 3) for _ in range(2))
    variance, visibility, diffuse_variance, specular_variance = (own.new_empty(height, width) for _ in range(4))
    indirect = None if state.sums.indirect is None else torch.empty_like(diffuse)
    radiance = Radiance(diffuse, specular, variance, visibility, state.samples, diffuse_variance, specular_variance, indirect)
    inputs = [_window_place(state.window), sum_arrays(state.sums)]
    launch(mean_over_passes, height * width, inputs, [_mean_maps(radiance)], warp_device(own))
    if state.reprojected is not None:
        blend_history(radiance, state.reprojected, mean_gbuffer(state), own)
    _means[state] = radiance
    return radiance


def quick_radiance(picture: QuickPicture, light: DemodulatedLight, samples: int) -> Radiance:
    """A moving picture's, with this light, as it is or filtered. Its variance is the most that the sum of both parts can have.

    Args:
        samples: rays a pixel.
    """
    none, surface = torch.empty_like(picture.visibility), picture.history.gbuffer
    radiance = remodulate_albedo(light, Radiance(light.diffuse, light.specular, none, picture.visibility, samples), surface)
    assert radiance.diffuse_variance is not None and radiance.specular_variance is not None
    return replace(radiance, variance=2 * (radiance.diffuse_variance + radiance.specular_variance))


@wp.func
def mean_vector(surface: wp.array2d[float], pixel: int, column: int, weight: float) -> wp.vec3:
    return wp.vec3(surface[pixel, column], surface[pixel, column + 1], surface[pixel, column + 2]) / weight


@wp.kernel
def mean_surface(
    first: int,
    window: WindowPlace,
    sums: SumArrays,
    # outputs
    mean: GBufferArrays,
):
    """Over the places that found a surface; 0 where none did, infinitely far."""
    i = first + wp.tid()
    y = i / window.width
    x = i - y * window.width
    p = (window.row + y) * window.image_width + window.column + x
    w = wp.max(sums.weight[p], 1.0)
    mean.coverage[i] = sums.weight[p] / wp.max(sums.places[p], 1.0)
    mean.depth[i] = wp.where(sums.weight[p] > 0.0, sums.surface[p, 14] / w, wp.inf)
    mean.position[i] = mean_vector(sums.surface, p, 0, w)
    mean.normal[i] = wp.normalize(mean_vector(sums.surface, p, 3, w))
    mean.wo[i] = wp.normalize(mean_vector(sums.surface, p, 6, w))
    mean.albedo[i] = mean_vector(sums.surface, p, 9, w)
    mean.roughness[i] = sums.surface[p, 12] / w
    mean.metallic[i] = sums.surface[p, 13] / w


_gbuffers: WeakKeyDictionary[FrameSums, tuple[int, GBuffer]] = WeakKeyDictionary()
"""Of sums that live, after so many passes over all tiles: denoiser, history and whoever shows the picture ask for it."""


def mean_gbuffer(state: FrameState) -> GBuffer:
    """Of the window: the rasterised one, or the mean over passes of what rays to the mesh saw."""
    if isinstance(state.view, GaussianView):
        return GBuffer(**{name: state.window.crop(values) for name, values in vars(state.view.gbuffer).items()})
    if state.quick_picture is not None:
        return state.quick_picture.history.gbuffer
    passes = int(state.tiles.passes.sum())
    known = _gbuffers.get(state.sums)
    if known is None or known[0] != passes:
        known = _gbuffers[state.sums] = passes, _mean_surface(state)
    return known[1]


def _mean_surface(state: FrameState) -> GBuffer:
    assert state.sums.surface is not None
    rows, columns = state.window.shape
    numbers = torch.empty(4, rows, columns, device=state.sums.weight.device)
    vectors = torch.empty(4, rows, columns, 3, device=numbers.device)
    coverage, depth, roughness, metallic = numbers.unbind()
    position, normal, wo, albedo = vectors.unbind()
    gbuffer = GBuffer(coverage, depth, position, normal, wo, albedo, roughness, metallic)
    inputs = [_window_place(state.window), sum_arrays(state.sums)]
    launch(mean_surface, rows * columns, inputs, [gbuffer_arrays(gbuffer)], warp_device(numbers))
    return gbuffer


def frame_history(state: FrameState) -> History | None:
    """What the frame is worth to the next one, seen by another camera; before the first pass that of the frame before it."""
    if state.passes == 0:
        return state.history
    if state.quick_picture is not None:
        return state.quick_picture.history
    camera = state.window.camera(state.inputs.camera)
    return remember(mean_radiance(state), mean_gbuffer(state), camera, _own_samples(state), state.reprojected)


def _own_samples(state: FrameState) -> Tensor:
    """(rows, columns, 2) behind the diffuse and the specular part of the frame's own mean."""
    samples = state.places_in_window * state.rays_a_pass
    return torch.stack([samples, samples], -1)


def _window_place(window: Window) -> Any:
    place = WindowPlace()
    place.row, place.column = window.rows.start, window.columns.start
    place.width, place.image_width = window.columns.stop - window.columns.start, window.width
    return place


def _mean_maps(radiance: Radiance) -> Any:
    maps = MeanMaps()
    maps.diffuse, maps.specular = warp_array(radiance.diffuse, wp.vec3), warp_array(radiance.specular, wp.vec3)
    maps.variance, maps.visibility = warp_array(radiance.variance), warp_array(radiance.visibility)
    assert radiance.diffuse_variance is not None and radiance.specular_variance is not None
    maps.diffuse_variance, maps.specular_variance = warp_array(radiance.diffuse_variance), warp_array(radiance.specular_variance)
    if radiance.indirect is not None:
        maps.indirect = warp_array(radiance.indirect, wp.vec3)
    return maps
