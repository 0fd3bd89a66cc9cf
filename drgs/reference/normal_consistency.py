"""How well shown normals agree with those of the surface that a depth map draws, as operations on whole maps: what
reconstruct/fit/normal_consistency.py computes. Differentiable by autograd, in any floating type."""

import torch
from jaxtyping import Float
from torch import Tensor

from drgs.scene.camera import Camera


def normals_from_depth(depth: Float[Tensor, "height width"], camera: Camera) -> Float[Tensor, "height width 3"]:
    """(height, width, 3) unit world normals, facing the camera, of the surface that a depth map draws; border pixels repeat."""
    fx, fy = camera.intrinsics[0, 0], camera.intrinsics[1, 1]
    cx, cy = camera.intrinsics[0, 2], camera.intrinsics[1, 2]
    x = (torch.arange(camera.width, device=depth.device) + 0.5 - cx) / fx
    y = (torch.arange(camera.height, device=depth.device) + 0.5 - cy) / fy
    # With P = z (x, y, 1), the cross product of P_x and P_y, divided by z: no 3-vectors until the end.
    z = depth
    dz_dx = torch.nn.functional.pad((z[:, 2:] - z[:, :-2])[None], (1, 1), mode="replicate")[0] * (0.5 * fx)
    dz_dy = torch.nn.functional.pad((z[2:] - z[:-2])[None, None], (0, 0, 1, 1), mode="replicate")[0, 0] * (0.5 * fy)
    normal = torch.stack([dz_dx, dz_dy, -(z + x * dz_dx + y[:, None] * dz_dy)], -1)
    return torch.nn.functional.normalize(normal, dim=-1) @ camera.camera_from_world[:3, :3]


def normal_consistency(
    normal_world: Float[Tensor, "height width 3"],
    depth: Float[Tensor, "height width"],
    coverage: Float[Tensor, "height width"],
    camera: Camera,
) -> Float[Tensor, ""]:
    """Scalar mean over solid pixels of 1 - n . n_depth: surfels lie in the surface that they draw (Huang et al. 2024, eq. 14)."""
    from_depth = normals_from_depth(depth, camera)
    solid = coverage.detach() > 0.5
    inside = -torch.nn.functional.max_pool2d(-solid.float()[None, None], 3, 1, 1)[0, 0]  # all nine neighbours solid
    agreement = 1 - (normal_world * from_depth).sum(-1)
    return (agreement * inside).sum() / inside.sum().clamp(min=1)
