"""Exact masks of a mesh, from cameras all around it."""

import numpy as np
import torch
import trimesh

from drgs.reconstruct.capture.hull_rays import surface_of
from drgs.render.intersect.trace_rays import trace_rays
from drgs.scene.camera import Camera, pixel_rays_world, scaled_camera
from drgs.scene.views import Views
from tests.reconstruct import tiny_capture as tiny

SIDE, VIEWS = 128, 36


def photographed(*parts: trimesh.Trimesh) -> Views:
    """Masks of the parts, coverage of a pixel by four places in it."""
    solid = trimesh.util.concatenate(parts)
    tracer = surface_of(torch.from_numpy(np.asarray(solid.vertices)).float(), torch.from_numpy(np.asarray(solid.faces)).int())
    intrinsics = torch.tensor([[1.3 * SIDE, 0, SIDE / 2], [0, 1.3 * SIDE, SIDE / 2], [0, 0, 1]])
    cameras, masks = [], []
    for number, position in enumerate(tiny.camera_positions(VIEWS)):
        camera = Camera(torch.from_numpy(tiny.look_at(position)).float(), intrinsics, SIDE, SIDE, f"r_{number}")
        fine = scaled_camera(camera, 2.0)
        origin, directions = pixel_rays_world(fine)
        direction = torch.nn.functional.normalize(directions.reshape(-1, 3), dim=-1).contiguous()
        hit = trace_rays(origin.expand_as(direction).contiguous(), direction, tracer).hit.reshape(fine.height, fine.width)
        cameras.append(camera)
        masks.append((255 * torch.nn.functional.avg_pool2d(hit.float()[None], 2)[0]).round().to(torch.uint8))
    pictures = tuple(torch.zeros(SIDE, SIDE, 3, dtype=torch.uint8) for _ in cameras)
    return Views(tuple(cameras), pictures, tuple(masks), None, None, True, "nerfstudio")
