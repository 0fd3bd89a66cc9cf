"""A pinhole camera in OpenCV convention: +z forward, y down, pixel centres at +0.5."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Camera:
    """Where a picture is taken from. Files hold OpenGL camera-to-world; `camera_from_opengl` converts."""

    camera_from_world: Float[Tensor, "4 4"]
    """OpenCV rigid transform; world is right-handed, z up."""
    intrinsics: Float[Tensor, "3 3"]
    """K [pixels]; a point at K @ p / z = (0.5, 0.5) falls on the centre of the top-left pixel."""
    width: int
    height: int
    name: str = ""
    """Stem of the image file, names the output."""

    @property
    def center_world(self) -> Tensor:
        """(3,) camera position [world units]."""
        rotation, translation = self.camera_from_world[:3, :3], self.camera_from_world[:3, 3]
        return -rotation.T @ translation

    def to(self, device: torch.device | str) -> "Camera":
        return Camera(self.camera_from_world.to(device), self.intrinsics.to(device), self.width, self.height, self.name)


def camera_from_opengl(world_from_opengl: Tensor, intrinsics: Tensor, width: int, height: int, name: str = "") -> Camera:
    """Camera from an OpenGL camera-to-world matrix (4, 4), as transforms.json files hold it."""
    opengl_from_opencv = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
    world_from_camera = world_from_opengl.to(torch.float64) @ opengl_from_opencv
    return Camera(torch.linalg.inv(world_from_camera).float(), intrinsics.float(), width, height, name)


def opengl_from_camera(camera: Camera) -> Tensor:
    """(4, 4) OpenGL camera-to-world, the inverse of `camera_from_opengl`."""
    opencv_from_opengl = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
    return torch.linalg.inv(camera.camera_from_world.double()) @ opencv_from_opengl.to(camera.camera_from_world.device)


def scaled_camera(camera: Camera, factor: float) -> Camera:
    """The same view at `factor` times the size (exact: pixel centres stay at +0.5)."""
    width, height = round(camera.width * factor), round(camera.height * factor)
    scale = torch.diag(torch.tensor([width / camera.width, height / camera.height, 1.0], device=camera.intrinsics.device))
    return Camera(camera.camera_from_world, scale @ camera.intrinsics, width, height, camera.name)


def windowed_camera(camera: Camera, rows: slice, columns: slice) -> Camera:
    """The part of the view in these rows and columns (exact: what falls on a pixel falls on it still)."""
    intrinsics = camera.intrinsics.clone()
    intrinsics[0, 2] -= columns.start
    intrinsics[1, 2] -= rows.start
    return Camera(camera.camera_from_world, intrinsics, columns.stop - columns.start, rows.stop - rows.start, camera.name)


def world_from_pixel(camera: Camera) -> Tensor:
    """(3, 3): takes (x, y, 1) of a place on the image [pixels; centres at + 0.5] to its viewing direction, not of unit length."""
    return camera.camera_from_world[:3, :3].T @ torch.linalg.inv(camera.intrinsics)


def pixel_rays_world(camera: Camera) -> tuple[Tensor, Tensor]:
    """Origin (3,) and unit directions (height, width, 3) through the pixel centres.

    Shares its pixel-centre rule with the rasteriser; there is no second one in the project.
    """
    device = camera.intrinsics.device
    x = torch.arange(camera.width, device=device, dtype=torch.float32) + 0.5
    y = torch.arange(camera.height, device=device, dtype=torch.float32) + 0.5
    pixels = torch.stack(
        [x.expand(camera.height, -1), y[:, None].expand(-1, camera.width), torch.ones(camera.height, camera.width, device=device)], -1
    )
    directions = pixels @ world_from_pixel(camera).T
    return camera.center_world, torch.nn.functional.normalize(directions, dim=-1)
