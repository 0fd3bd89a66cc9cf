"""Depth maps to mesh: fuse_depth, marching cubes, clean_mesh."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from skimage.measure import marching_cubes
from torch import Tensor

from drgs.reconstruct.capture.build_box import BuildBox
from drgs.reconstruct.geometry.extract_mesh.clean_mesh import clean_mesh
from drgs.reconstruct.geometry.extract_mesh.fuse_depth import DistanceField, fuse_depth
from drgs.reconstruct.geometry.extract_mesh.records import FAST_MESH, DepthMap, MeshSettings


def extract_mesh(
    depth_maps: Sequence[DepthMap],
    bounds_center: Float[Tensor, "3"],
    bounds_radius: float,
    settings: MeshSettings = FAST_MESH,
    box: BuildBox | None = None,
    outside: Callable[[Float[Tensor, "point 3"]], Float[Tensor, "point"]] | None = None,
) -> tuple[Float[Tensor, "vertex 3"], Int[Tensor, "face 3"]]:
    """Vertices (V, 3) float32 and faces (F, 3) int32 of the object's surface, counter-clockwise seen from outside.

    Args:
        bounds_center: (3,) world position of the middle of the object's box.
        bounds_radius: half the box's longest side [world units]; a little too large costs little, too small cuts the object.
        box: of the build: the surface is closed flat where the object goes on outside.
        outside: how far points lie outside of what the object may fill at most [world units].

    Raises:
        ValueError: no depth map, none of them reaches into the bounds, or nothing of the object is left after fusion.
    """
    field = fuse_depth(depth_maps, bounds_center, bounds_radius, settings)
    if box is not None:
        field = field_within(field, box, settings)
    if outside is not None:
        field = field_inside(field, outside, settings)
    vertices, faces = march(field)
    return clean_mesh(vertices, faces, settings, shortest_edge=1e-3 * field.voxel_size)


def field_within(field: DistanceField, box: BuildBox, settings: MeshSettings) -> DistanceField:
    """The field of what is both the object and in the box: the larger of the two distances."""
    truncation = settings.truncation_voxels * field.voxel_size
    values = field.values
    for axis in range(3):
        place = field.origin[axis] + field.voxel_size * torch.arange(values.shape[axis], device=values.device)
        outside = torch.maximum(box.low[axis] - place, place - box.high[axis]) / truncation
        values = torch.maximum(values, outside.clamp(-1, 1).reshape([-1 if k == axis else 1 for k in range(3)]))
    return replace(field, values=values)


def field_inside(
    field: DistanceField, outside: Callable[[Float[Tensor, "point 3"]], Float[Tensor, "point"]], settings: MeshSettings
) -> DistanceField:
    """The same of what the object may fill at most."""
    values, truncation = field.values, settings.truncation_voxels * field.voxel_size
    asked = (values < 1).nonzero()
    distance = outside(field.origin + field.voxel_size * asked.to(field.origin)).to(values.device) / truncation
    cut = values.clone()
    cut[asked[:, 0], asked[:, 1], asked[:, 2]] = torch.maximum(values[asked[:, 0], asked[:, 1], asked[:, 2]], distance.clamp(-1, 1))
    return replace(field, values=cut)


def march(field: DistanceField) -> tuple[Float[Tensor, "vertex 3"], Int[Tensor, "face 3"]]:
    """Zero level of a distance field, on the field's device.

    Raises:
        ValueError: the field has no zero level.
    """
    values = field.values.cpu().numpy()
    if values.min() >= 0.0:
        raise ValueError(
            "mesh extraction found no inside: the depth maps disagree with each other or with the masks; check the camera poses"
        )
    # Lewiner's "descent" is the direction in which faces look: here the field falls inwards, so they must look up the gradient.
    vertices, faces, _, _ = marching_cubes(values, 0.0, gradient_direction="descent", allow_degenerate=False)
    world = torch.from_numpy(vertices.astype("float32")).to(field.origin.device) * field.voxel_size + field.origin
    return world, torch.from_numpy(faces.astype("int32")).to(field.origin.device)
