"""Cameras moved to where the fitted surface looks most like their photographs.

Cameras of photographs are a part of a pixel off: structure from motion knows them by a few hundred points, and a turntable by its steps. A surface fitted
to all of them is the mean of what they say, sharp where they agree; against it each camera can be held alone. A small motion of a camera moves all that it
sees, and how depends on depth; so six numbers a view follow by least squares from what is left between the photograph and its prediction (split sum,
as the surface is fitted), times the gradient of both, and from how far the mesh's outlines lie from the mask's. A robust weight leaves out what the
surface does not explain.

Right cameras would be made worse by a twentieth of a pixel, and what is wrong elsewhere looks like motion, too: light and gloss that the surface does not
explain move colours, rough masks move outlines. So colours and outlines find their motions apart: what both say is the camera's, what only one says is
noise. Where they agree on less than LEAST_AGREED, or on not much more than the noise, all cameras stay. (Two halves of each picture are no such witnesses:
what moves colours in one moves them in the other.) What all views have in common is no camera's error but the world's own place and size, and is left out.
Sources: small motions as a linear least squares of images: lucas1981; docs/sources.md.

In: the mesh through its tracer, its normals and materials, photographs, outlines of masks. Out: moved cameras, or that they are right.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from numpy import ndarray
from scipy.ndimage import binary_erosion, gaussian_filter
from scipy.spatial.transform import Rotation
from torch import Tensor

from drgs.reconstruct.capture.turning_light import with_light_of_camera
from drgs.reconstruct.fit.light.mesh_light import LightOf, MeshLight, at_corners
from drgs.reconstruct.fit.surface.shade_surface import SOLID, photo_of, seen_places, shade_places, steep_enough
from drgs.reconstruct.fit.view_targets import ViewTarget
from drgs.reconstruct.geometry.mask_outlines import MaskOutline, outline_rays, outline_residuals
from drgs.render.intersect.tracer import AbstractTracer
from drgs.scene.camera import Camera
from drgs.scene.views import Views
from drgs.warp_torch import by_pool

LEAST_AGREED = 0.1
"""[pixels] Root mean square of the motion on which colours and outlines agree, below which cameras stay."""
OVER_NOISE = 1.5
"""Times what is not known of it: what cameras move by is more than that. A bunny and a teapot with cameras a quarter of a pixel off have 3.5 and 2.4, right ones 0; a
real tankard on a turntable, whose cameras are no worse than its masks, 0.8."""
FIRST_LOOK = 16
"""Views, evenly among all, that say first whether cameras are right."""
PRIOR = 0.5
"""[pixels] Standard deviation of each of a camera's six numbers, by what it moves at the middle of the picture."""
FARTHEST = 2.0
"""[pixels] Root mean square by which one camera moves at once: farther away pictures are no longer straight in it, so it is asked again after the next pass."""
BLUR = 0.7
"""[pixels] Standard deviation of the smoothing of both pictures before they are compared."""
RIM = 3
"""[pixels] from where nothing is compared inwards: smoothing brings it along."""
MOST_PIXELS = 16_000
"""Of a picture that are compared, evenly among all."""
DRAWS = 2
"""Of what mirrors see."""
ALIKE = 0.1
"""Of a residual's information: neighbours err alike."""
ROUNDS = 6
"""Of the robust weights."""
LEAST_DEVIATION = 0.004, 0.03
"""Of residuals: of colours [sRGB, 0..1] and of outlines [pixels]."""


@dataclass(frozen=True, eq=False)
class CamerasFound:
    """What photographs say of their cameras."""

    camera_from_world: Float64[Tensor, "view 4 4"] | None
    """Moved; None: they are right, as far as can be told."""
    agreed: float
    """[pixels] Root mean square of the motion on which colours and outlines of the pictures that were looked at agree; 0 where they contradict each other."""
    noise: float
    """[pixels] Root mean square of what is not known of it."""


@torch.no_grad()
def register_cameras(
    tracer: AbstractTracer,
    targets: Sequence[ViewTarget],
    outlines: Sequence[MaskOutline | None],
    light_of: LightOf,
    surface: Float[Tensor, "vertex 8"],
    seed: int,
) -> CamerasFound:
    """The cameras of the targets, moved; their intrinsics stay.

    Args:
        tracer: its mesh has the materials that mirrors see. outlines: of the targets' masks. surface: of packed_surface.
    """

    def looks_at(numbers: Sequence[int]) -> list[_Motion]:
        def look(k: int, _: int) -> _Motion:
            number = numbers[k]
            generator = torch.Generator().manual_seed(seed * 1_000_003 + number)
            target = targets[number]
            return _motion_of(target, outlines[number], tracer, light_of(target), surface, generator)

        return by_pool(look, range(len(numbers) + 1), surface.device)

    count = len(targets)
    some = sorted({round(k) for k in np.linspace(0, count - 1, min(FIRST_LOOK, count))})
    motions = dict(zip(some, looks_at(some), strict=True))
    agreed, noise = agreement([motions[number] for number in some])
    if not agreed >= max(LEAST_AGREED, OVER_NOISE * noise):
        return CamerasFound(None, agreed, noise)
    others = [number for number in range(count) if number not in motions]
    motions |= dict(zip(others, looks_at(others), strict=True))
    every = [motions[number] for number in range(count)]
    twists = without_common(every, [motion.both * min(1.0, FARTHEST / max(motion.pixels(motion.both), 1e-9)) for motion in every])
    moved = [_rigid(twist) @ motion.camera_from_world for motion, twist in zip(every, twists, strict=True)]
    agreed, noise = agreement(every)
    return CamerasFound(torch.from_numpy(np.stack(moved)), agreed, noise)


def seen_from(views: Views, camera_from_world: Float64[Tensor, "view 4 4"]) -> Views:
    """The views with their cameras there; light that turns with cameras turns with these."""
    transforms = camera_from_world.cpu()
    cameras = tuple(
        replace(camera, camera_from_world=transform.float()) for camera, transform in zip(views.cameras, transforms, strict=True)
    )
    seen = replace(views, cameras=cameras)
    return seen if views.light_from_world is None else with_light_of_camera(seen)


def moved_pixels(before: Views, after: Views, places: Float[Tensor, "place 3"]) -> float:
    """[pixels] Root mean square by which places of the world [world units] moved in the pictures; those behind a camera, or beside its picture, do not count."""
    squares = []
    for one, other in zip(before.cameras, after.cameras, strict=True):
        pixels, within = [], torch.ones(len(places), dtype=torch.bool)
        for camera in (one, other):
            transform, intrinsics = camera.camera_from_world.double(), camera.intrinsics.double()
            seen = (places.double() @ transform[:3, :3].T + transform[:3, 3]) @ intrinsics.T
            at = seen[:, :2] / seen[:, 2:].clamp(min=1e-9)
            within &= (seen[:, 2] > 1e-9) & ((at >= 0) & (at <= torch.tensor([camera.width, camera.height]))).all(1)
            pixels.append(at)
        squares.append((pixels[0] - pixels[1])[within].square().sum(1))
    every = torch.cat(squares)
    return float(every.mean().sqrt()) if len(every) else 0.0


@dataclass(frozen=True, eq=False)
class _Motion:
    """Of one camera: by which its picture fits the photograph better. Motions are twists (rotation vector, translation) of what the camera sees, in its
    frame [radians, world units]."""

    camera_from_world: Float64[ndarray, "4 4"]
    apart: tuple[Float64[ndarray, "6"], Float64[ndarray, "6"]]
    """As colours alone say, and as outlines do."""
    both: Float64[ndarray, "6"]
    """As they say together."""
    metric: Float64[ndarray, "6 6"]
    """Mean square [pixels^2] by which a twist moves what the camera sees."""

    @property
    def center(self) -> Float64[ndarray, "3"]:
        return -self.camera_from_world[:3, :3].T @ self.camera_from_world[:3, 3]

    def pixels(self, twist: Float64[ndarray, "6"]) -> float:
        """Root mean square by which a twist moves what the camera sees."""
        return float(np.sqrt(twist @ self.metric @ twist))

    def of_camera(self, twist: Float64[ndarray, "6"]) -> Float64[ndarray, "6"]:
        """A twist of the world before it is seen, as one of what the camera sees."""
        rotation, translation = self.camera_from_world[:3, :3], self.camera_from_world[:3, 3]
        turn = rotation @ twist[:3]
        return np.concatenate([turn, rotation @ twist[3:] - np.cross(turn, translation)])


def agreement(motions: Sequence[_Motion]) -> tuple[float, float]:
    """[pixels] Root mean squares of what colours and outlines agree on, and of the noise of their mean, without what all views have in common."""
    first, second = (without_common(motions, [motion.apart[kind] for motion in motions]) for kind in range(2))
    every = list(zip(first, second, (motion.metric for motion in motions), strict=True))
    agreed = np.mean([a @ metric @ b for a, b, metric in every])
    noise = np.mean([(a - b) @ metric @ (a - b) for a, b, metric in every]) / 4
    return float(np.sqrt(max(agreed, 0.0))), float(np.sqrt(noise))


def without_common(motions: Sequence[_Motion], twists: Sequence[Float64[ndarray, "6"]]) -> list[Float64[ndarray, "6"]]:
    """Twists, one a camera in its frame, without the similarity of the world that comes nearest to them all in the pictures: the world's place, orientation and
    size are no camera's error.

    A world that grows by a small share looks to a camera at c like one that moved by that share of c, and kept its size.
    """
    bases = []
    for motion in motions:
        growing = motion.of_camera(np.concatenate([np.zeros(3), motion.center]))
        bases.append(np.stack([*(motion.of_camera(axis) for axis in np.eye(6)), growing], 1))
    every = list(zip(bases, (motion.metric for motion in motions), twists, strict=True))
    normal = np.sum([basis.T @ metric @ basis for basis, metric, _ in every], 0)
    right = np.sum([basis.T @ metric @ twist for basis, metric, twist in every], 0)
    common = np.linalg.lstsq(normal, right, rcond=None)[0]
    return [twist - basis @ common for basis, _, twist in every]


def _motion_of(
    target: ViewTarget,
    outline: MaskOutline | None,
    tracer: AbstractTracer,
    light: MeshLight,
    surface: Float[Tensor, "vertex 8"],
    generator: torch.Generator,
) -> _Motion:
    parts = [_of_colors(target, tracer, light, surface, generator)]
    parts += [] if outline is None else [_of_outline(target.camera, outline, tracer)]
    camera_from_world, nothing = _float64(target.camera.camera_from_world), np.zeros(6)
    places = np.concatenate([part.places for part in parts])
    if len(places) == 0:
        return _Motion(camera_from_world, (nothing, nothing), nothing, np.zeros((6, 6)))
    # In pixels, so that one prior holds for all six.
    focal = float(target.camera.intrinsics[0, 0])
    scale = np.repeat([1 / focal, float(np.median(places[:, 2])) / focal], 3)
    flows = _flows(places, _float64(target.camera.intrinsics)) * scale
    metric = np.einsum("pka,pkb->ab", flows, flows) / len(places)
    equations = [_robust(part, scale) for part in parts]
    prior = np.eye(6) / PRIOR**2
    apart = [np.linalg.solve(normal + prior, right) * scale for normal, right in equations]
    both = np.linalg.solve(sum(normal for normal, _ in equations) + prior, sum(right for _, right in equations)) * scale
    return _Motion(camera_from_world, (apart[0], apart[1] if len(apart) > 1 else nothing), both, metric / np.outer(scale, scale))


@dataclass(frozen=True, eq=False)
class _Residuals:
    """What motion should explain."""

    places: Float64[ndarray, "place 3"]
    """In the camera's frame [world units]."""
    values: Float64[ndarray, "place k"]
    slopes: Float64[ndarray, "place k 3"]
    """Derivative of what is predicted by the place, moving in the camera's frame."""
    least_deviation: float

    def rows(self, scale: Float64[ndarray, "6"]) -> Float64[ndarray, "row 6"]:
        """Derivatives of the values, one after the other, by the scaled twist."""
        slopes = self.slopes.reshape(-1, 3)
        places = np.repeat(self.places, self.values.shape[1], axis=0)
        return np.concatenate([np.cross(places, slopes), slopes], 1) * scale


def _robust(part: _Residuals, scale: Float64[ndarray, "6"]) -> tuple[Float64[ndarray, "6 6"], Float64[ndarray, "6"]]:
    """Normal equations without the prior; weights of a Cauchy distribution of the residuals' own width."""
    rows, values = part.rows(scale), part.values.reshape(-1)
    normal, right = np.zeros((6, 6)), np.zeros(6)
    for _ in range(ROUNDS if len(values) else 0):
        left = values - rows @ np.linalg.solve(normal + np.eye(6) / PRIOR**2, right)
        deviation = 1.48 * float(np.median(np.abs(left))) + part.least_deviation
        weighted = rows * (ALIKE / (deviation**2 * (1 + np.square(left / (2 * deviation)))))[:, None]
        normal, right = weighted.T @ rows, weighted.T @ values
    return normal, right


def _of_colors(
    target: ViewTarget, tracer: AbstractTracer, light: MeshLight, surface: Float[Tensor, "vertex 8"], generator: torch.Generator
) -> _Residuals:
    """Of pixels that mask and mesh fill."""
    camera, (height, width) = target.camera, target.mask.shape
    seen = seen_places(target, (target.mask.flatten() > SOLID).nonzero().squeeze(1), tracer)
    seen = seen[steep_enough(seen, surface[:, :3].contiguous())]
    predicted = torch.stack([shade_places(seen, target, tracer, surface, light, generator) for _ in range(DRAWS)]).mean(0)
    photo = photo_of(seen, target)
    world = at_corners(tracer.mesh.vertices, seen.corners, seen.weights)
    in_camera = world @ camera.camera_from_world[:3, :3].T + camera.camera_from_world[:3, 3]
    pixels = seen.pixels.cpu().numpy()

    def map_of(values: Tensor) -> Float[ndarray, "height width *rest"]:
        whole = np.zeros((height * width, *values.shape[1:]), np.float32)
        whole[pixels] = values.cpu().numpy()
        return whole.reshape(height, width, *values.shape[1:])[target.rows, target.columns]

    valid: Bool[ndarray, "rows columns"] = map_of(torch.ones(len(pixels), dtype=torch.bool)) > 0
    pictures = [gaussian_filter(map_of(values), (BLUR, BLUR, 0)) for values in (photo, predicted)]
    if min(valid.shape) < 2:
        return _Residuals(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3, 3)), LEAST_DEVIATION[0])
    down, across = np.gradient((pictures[0] + pictures[1]) / 2, axis=(0, 1))
    row, column = binary_erosion(valid, iterations=RIM).nonzero()
    stride = max(1, -(-len(row) // MOST_PIXELS))
    row, column = row[stride // 2 :: stride], column[stride // 2 :: stride]
    places = map_of(in_camera)[row, column].astype(np.float64)
    # A picture that moves by a flow shows at a place what was that far before it.
    by_pixel = -np.stack([across, down], -1)[row, column].astype(np.float64)
    slopes = by_pixel @ _flow_by_place(places, _float64(camera.intrinsics))
    values = (pictures[0] - pictures[1])[row, column].astype(np.float64)
    return _Residuals(places, values, slopes, LEAST_DEVIATION[0])


def _of_outline(camera: Camera, outline: MaskOutline, tracer: AbstractTracer) -> _Residuals:
    """Of places where the mask ends."""
    device = tracer.mesh.vertices.device
    found = outline_residuals(tracer, outline_rays((camera,), [outline], device))
    world = at_corners(tracer.mesh.vertices, found.corners, found.weights)
    rotation, translation = camera.camera_from_world[:3, :3], camera.camera_from_world[:3, 3]
    places, slopes = _float64(world @ rotation.T + translation), _float64(found.gradient @ rotation.T)
    return _Residuals(places, -_float64(found.distance)[:, None], slopes[:, None], LEAST_DEVIATION[1])


def _flow_by_place(places: Float64[ndarray, "place 3"], intrinsics: Float64[ndarray, "3 3"]) -> Float64[ndarray, "place 2 3"]:
    """Derivative of the pixel by the place in the camera's frame."""
    x, y, z = places.T
    zero, (focal_x, focal_y) = np.zeros_like(z), np.diagonal(intrinsics)[:2]
    return np.stack(
        [
            np.stack([focal_x / z, zero, -focal_x * x / z**2], -1),
            np.stack([zero, focal_y / z, -focal_y * y / z**2], -1),
        ],
        1,
    )


def _flows(places: Float64[ndarray, "place 3"], intrinsics: Float64[ndarray, "3 3"]) -> Float64[ndarray, "place 2 6"]:
    """Derivative of the pixel by a twist."""
    by_place = _flow_by_place(places, intrinsics)
    return np.concatenate([np.cross(places[:, None], by_place), by_place], -1)


def _rigid(twist: Float64[ndarray, "6"]) -> Float64[ndarray, "4 4"]:
    """The transform of a small twist."""
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = Rotation.from_rotvec(twist[:3]).as_matrix(), twist[3:]
    return transform


def _float64(values: Tensor) -> Float64[ndarray, "*shape"]:
    return values.detach().double().cpu().numpy()
