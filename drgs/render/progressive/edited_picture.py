"""The first picture after an edit at rest: every other pixel has rays, and those between take their light.

In: the points that the first pass sees, which are known of the picture before, and their new light. Out: a QuickPicture. Pixels whose rays are left out
lie like a chessboard's black fields; one that is unlike all of its neighbours (an edge, a thin part, another material) has rays of its own.
The passes behind it do without it: what it leaves out is in no sum.
"""

from dataclasses import dataclass, replace
from typing import Any
from weakref import WeakKeyDictionary

import torch
import warp as wp
from torch import Tensor

from drgs.render.integrate.integrator import light_sums
from drgs.render.integrate.sample_arrays import PointArrays, point_arrays
from drgs.render.integrate.sum_samples import LightSums
from drgs.render.progressive.demodulate_albedo import diffuse_reflectance, mean_square, specular_reflectance
from drgs.render.progressive.neighbours import Neighbourhood, column_of, neighbour_alike, neighbourhood, point_beside, row_of
from drgs.render.progressive.quick_picture import QuickPicture
from drgs.render.progressive.reproject import LightMaps, light_maps
from drgs.render.records import DemodulatedLight, GBuffer, History, PrimaryPoints, RayStarts, ShadedPoints
from drgs.render.visible.image_tiles import Window
from drgs.render.visible.rasterize.gbuffer import GBufferArrays, gbuffer_arrays
from drgs.scene.camera import Camera
from drgs.warp_torch import launch, warp_array, warp_device

wp.set_module_options({"enable_backward": False})


@wp.kernel
def write_surface(
    first: int,
    points: PointArrays,
    depth: wp.array[float],
    there: Neighbourhood,
    width: int,
    # outputs; each pixel has one point
    place: wp.array2d[int],
    maps: GBufferArrays,
):
    """But for materials."""
    p = first + wp.tid()
    y = row_of(there, points.pixel[p])
    x = column_of(there, points.pixel[p])
    place[y, x] = p + 1
    i = y * width + x
    maps.coverage[i] = 1.0
    maps.depth[i] = depth[p]
    maps.position[i] = points.position[p]
    maps.normal[i] = points.normal[p]
    maps.wo[i] = points.wo[p]


@wp.kernel
def write_materials(
    first: int,
    points: PointArrays,
    depth: wp.array[float],
    there: Neighbourhood,
    width: int,
    # outputs
    maps: GBufferArrays,
    alike: wp.array[wp.uint8],
):
    """And choose the points that need rays.

    Args:
        alike: of each point the sides on which neighbours lend it their light, a bit each; 0: it needs rays.
    """
    p = first + wp.tid()
    i = row_of(there, points.pixel[p]) * width + column_of(there, points.pixel[p])
    maps.albedo[i] = points.albedo[p]
    maps.roughness[i] = points.roughness[p]
    maps.metallic[i] = points.metallic[p]
    sides = int(0)
    if (points.pixel[p] // there.image_width + points.pixel[p] % there.image_width) % 2 == 1:
        for side in range(4):
            if neighbour_alike(points, depth, there, p, side) >= 0:
                sides = sides | (1 << side)
    alike[p] = wp.uint8(sides)


@wp.kernel
def put_light(
    first: int,
    points: PointArrays,
    there: Neighbourhood,
    alike: wp.array[wp.uint8],
    found: LightSums,
    # outputs
    light: LightMaps,
    visibility: wp.array2d[float],
):
    """Light without what textures reflect: a point's own, or the mean over neighbours that are alike."""
    p = first + wp.tid()
    diffuse = wp.vec3(0.0, 0.0, 0.0)
    specular = wp.vec3(0.0, 0.0, 0.0)
    variance = wp.vec2(0.0, 0.0)
    open_share = wp.float32(0.0)
    count = wp.float32(0.0)
    for side in range(4):
        own = alike[p] == wp.uint8(0) and side == 0
        if own or (int(alike[p]) & (1 << side)) != 0:
            q = p
            if not own:
                q = point_beside(points, there, p, side)
            d = diffuse_reflectance(points.albedo[q], points.metallic[q])
            s = specular_reflectance(points.albedo[q], points.metallic[q])
            diffuse += wp.cw_div(found.diffuse[q], d)
            specular += wp.cw_div(found.specular[q], s)
            variance += wp.vec2(found.variance[q][1] / mean_square(d), found.variance[q][2] / mean_square(s))
            open_share += found.visibility[q]
            count += 1.0
    y = row_of(there, points.pixel[p])
    x = column_of(there, points.pixel[p])
    light.diffuse[y, x] = diffuse / count
    light.specular[y, x] = specular / count
    light.variance[y, x] = variance / (count * count)
    visibility[y, x] = open_share / count


@dataclass(frozen=True, eq=False)
class _View:
    """What a window shows of some points but for their materials."""

    window: Window
    surface: GBuffer
    place: Tensor


_views: WeakKeyDictionary[RayStarts, _View] = WeakKeyDictionary()
"""Of points that live, by where their rays start: those after the next edit are the same in other materials."""


class EditedPoints:
    """Final. The points of a picture, which of them need rays, and the picture of their light."""

    def __init__(self, primary: PrimaryPoints, window: Window, camera: Camera) -> None:
        """
        Args:
            camera: of the window.
        """
        points, device, warp = primary.points, primary.depth.device, warp_device(primary.depth)
        self._camera, self._count = camera, len(points.pixel)
        self._there: Any = neighbourhood(window, 1.0 / float(camera.intrinsics[0, 0]))
        self._points = [point_arrays(points), warp_array(primary.depth), self._there]
        view = _views.get(primary.starts)
        if view is None or view.window != window:
            view = _views[primary.starts] = self._see(window, device)
        albedo, of_material = torch.zeros(*window.shape, 3, device=device), torch.zeros(2, *window.shape, device=device)
        self._surface = replace(view.surface, albedo=albedo, roughness=of_material[0], metallic=of_material[1])
        self._there.place = warp_array(view.place)
        self._alike = torch.empty(self._count, dtype=torch.uint8, device=device)
        outputs = [gbuffer_arrays(self._surface), warp_array(self._alike)]
        launch(write_materials, self._count, [*self._points, window.shape[1]], outputs, warp)

    def _see(self, window: Window, device: torch.device) -> _View:
        numbers, vectors = torch.zeros(4, *window.shape, device=device), torch.zeros(4, *window.shape, 3, device=device)
        coverage, depth, roughness, metallic = numbers.unbind()
        depth.fill_(torch.inf)
        position, normal, wo, albedo = vectors.unbind()
        surface = GBuffer(coverage, depth, position, normal, wo, albedo, roughness, metallic)
        place = torch.zeros(window.shape, dtype=torch.int32, device=device)
        inputs, outputs = [*self._points, window.shape[1]], [warp_array(place), gbuffer_arrays(surface)]
        launch(write_surface, self._count, inputs, outputs, warp_device(place))
        return _View(window, surface, place)

    @property
    def order(self) -> Tensor:
        """(chosen,) int32, the points that need rays."""
        return torch.nonzero(self._alike == 0).squeeze(-1).int()

    def picture(self, found: ShadedPoints, samples: int) -> QuickPicture:
        """Of the light that their rays found.

        Args:
            samples: rays of a pixel, in the mean.
        """
        shape, device = self._surface.coverage.shape, self._surface.coverage.device
        diffuse, specular, variance = (torch.zeros(*shape, channels, device=device) for channels in (3, 3, 2))
        visibility, worth = torch.zeros(shape, device=device), torch.full((*shape, 2), float(samples), device=device)
        history = History(self._camera, self._surface, DemodulatedLight(diffuse, specular, variance), worth)
        points, _, there = self._points
        inputs = [points, there, warp_array(self._alike), light_sums(found)]
        launch(put_light, self._count, inputs, [light_maps(history), warp_array(visibility)], warp_device(visibility))
        return QuickPicture(history, visibility, None, of_edit=True)
