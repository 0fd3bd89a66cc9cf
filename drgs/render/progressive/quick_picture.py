"""The picture of a moving camera before it is filtered: what its one pass found and what the picture before says of the same places, put together.

In: the window's maps, the light of its points, the picture before. Out: a QuickPicture, which is the next one's history as it stands. Frames at
rest go a longer way to the same: sums over passes, their mean (mean_radiance.py), history looked up and blended in (reproject.py), and all of it
divided by what textures reflect (demodulate_albedo.py). Here one kernel goes once over the window. A test compares the two ways.
"""

from dataclasses import dataclass, replace
from typing import Any

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from drgs.render.progressive.demodulate_albedo import diffuse_reflectance, mean_square, specular_reflectance
from drgs.render.progressive.reproject import (
    MOST_SAMPLES,
    LightMaps,
    PinholeArrays,
    SurfaceMaps,
    brighten_light,
    faded,
    history_share,
    light_maps,
    look_up,
    pinhole_arrays,
    surface_maps,
)
from drgs.render.records import DemodulatedLight, GBuffer, History, ShadedPoints
from drgs.scene.camera import Camera
from drgs.warp_torch import launch, warp_array, warp_device, warp_view

wp.set_module_options({"enable_backward": False})


@dataclass(frozen=True, eq=False)
class QuickPicture:
    """A picture of one pass that is in no sum: a moving camera's, or the first one after an edit. Of the window."""

    history: History
    """What it shows, not filtered, and what that is worth to the next picture."""
    visibility: Float[Tensor, "rows columns"]
    """Open share of the cosine-weighted sky."""
    kept_samples: Float[Tensor, "rows columns"] | None
    """Rays behind the kept light that it shows, 0 where it shows none; None where that was not asked."""
    of_edit: bool = False
    """It is the first one after an edit, before a camera that rests (edited_picture.py)."""


@wp.struct
class LightOfPoints:
    """ShadedPoints of one pass, packed."""

    place: wp.array2d[int]
    """Of each pixel: its point's number and one."""
    diffuse: wp.array[wp.vec3]
    specular: wp.array[wp.vec3]
    variance: wp.array[wp.vec3]
    visibility: wp.array[float]
    kept_samples: wp.array[float]
    """Rays behind diffuse light that was kept; empty where none is."""
    samples: float
    """Rays of this pass."""


@wp.kernel
def put_together(
    first: int,
    width: int,
    found: LightOfPoints,
    surface: SurfaceMaps,
    albedo: wp.array2d[wp.vec3],
    metallic: wp.array2d[float],
    old_camera: PinholeArrays,
    old_surface: SurfaceMaps,
    old_light: LightMaps,
    most_samples: float,
    # outputs
    light: LightMaps,
    visibility: wp.array2d[float],
    kept_samples: wp.array2d[float],
):
    """Many arguments because what one pass found, what the picture before knew and what comes of both meet here."""
    i = first + wp.tid()
    y = i / width
    x = i - y * width
    light.diffuse[y, x] = wp.vec3(0.0, 0.0, 0.0)
    light.specular[y, x] = wp.vec3(0.0, 0.0, 0.0)
    light.variance[y, x] = wp.vec2(0.0, 0.0)
    light.samples[y, x] = wp.vec2(found.samples, found.samples)
    visibility[y, x] = 0.0
    if kept_samples.shape[0] > 0:
        kept_samples[y, x] = 0.0
    if surface.coverage[y, x] <= 0.0:
        return
    p = found.place[y, x] - 1
    own_d = found.samples
    own_s = found.samples
    if kept_samples.shape[0] > 0:
        kept_samples[y, x] = found.kept_samples[p]
        if found.kept_samples[p] > 0.0:
            own_d = found.kept_samples[p]
    visibility[y, x] = found.visibility[p]
    d = diffuse_reflectance(albedo[y, x], metallic[y, x])
    s = specular_reflectance(albedo[y, x], metallic[y, x])
    here = surface.position[y, x]
    old = look_up(here, surface.normal[y, x], surface.wo[y, x], surface.roughness[y, x], old_camera, old_surface, old_light, most_samples)
    share_d = history_share(old.samples[0], own_d)
    share_s = history_share(old.samples[1], own_s)
    rest_d = 1.0 - share_d
    rest_s = 1.0 - share_s
    light.diffuse[y, x] = rest_d * wp.cw_div(found.diffuse[p], d) + share_d * old.diffuse
    light.specular[y, x] = rest_s * wp.cw_div(found.specular[p], s) + share_s * old.specular
    light.variance[y, x] = wp.vec2(
        rest_d * rest_d * found.variance[p][1] / mean_square(d) + share_d * share_d * old.variance[0],
        rest_s * rest_s * found.variance[p][2] / mean_square(s) + share_s * share_s * old.variance[1],
    )
    light.samples[y, x] = wp.vec2(own_d + old.samples[0] * faded(own_d), own_s + old.samples[1] * faded(own_s))


def quick_picture(
    surface: GBuffer,
    place: Tensor,
    found: ShadedPoints,
    kept_samples: Tensor | None,
    samples: int,
    camera: Camera,
    before: History | None,
) -> QuickPicture:
    """What is shown, once it is filtered, and remembered.

    Args:
        surface: of the window. place: (rows, columns) int32 of each pixel its point's number and one; means nothing where nothing is covered.
        found: light of the points. kept_samples: (point,) rays behind diffuse light that was kept, else 0; None where that was not asked.
        samples: rays of each point. camera: of the window. before: the picture before the camera's move.
    """
    height, width = surface.coverage.shape
    diffuse, specular, variance, worth = (surface.coverage.new_empty(height, width, channels) for channels in (3, 3, 2, 2))
    visibility, none = torch.empty_like(surface.coverage), surface.coverage.new_empty(0, 0)
    kept = None if kept_samples is None else torch.empty_like(visibility)
    picture = QuickPicture(History(camera, surface, DemodulatedLight(diffuse, specular, variance), worth), visibility, kept)
    old = _no_picture(camera, surface.coverage) if before is None else before
    inputs = [
        width, _light_of_points(place, found, kept_samples, samples), surface_maps(surface), warp_view(surface.albedo, wp.vec3),
        warp_view(surface.metallic), pinhole_arrays(old.camera, old.gbuffer), surface_maps(old.gbuffer), light_maps(old), MOST_SAMPLES,
    ]  # fmt: skip
    outputs = [light_maps(picture.history), warp_array(visibility), warp_array(none if kept is None else kept)]
    launch(put_together, height * width, inputs, outputs, warp_device(visibility))
    return picture


def _no_picture(camera: Camera, like: Tensor) -> History:
    """In which nothing can be found."""
    none, vectors, pairs = (like.new_empty(0, 0, *tail) for tail in ((), (3,), (2,)))
    maps = GBuffer(none, none, vectors, vectors, vectors, vectors, none, none)
    return History(camera, maps, DemodulatedLight(vectors, vectors, pairs), pairs)


def brighten_picture(picture: QuickPicture, factor: float) -> QuickPicture:
    """The same under an environment `factor` times as strong."""
    return replace(picture, history=replace(picture.history, light=brighten_light(picture.history.light, factor)))


def _light_of_points(place: Tensor, found: ShadedPoints, kept_samples: Tensor | None, samples: int) -> Any:
    light = LightOfPoints()
    light.place, light.samples = warp_array(place), float(samples)
    light.diffuse, light.specular, light.variance = (warp_array(x, wp.vec3) for x in (found.diffuse, found.specular, found.variance))
    light.visibility = warp_array(found.visibility)
    light.kept_samples = warp_array(found.visibility[:0] if kept_samples is None else kept_samples)
    return light
