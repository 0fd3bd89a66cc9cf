"""Small scenes whose light is known, shared by the light-transport tests."""

import math

import torch
import trimesh

from drgs.render.records import ShadingPoints
from drgs.scene.camera import Camera, camera_from_opengl
from drgs.scene.environment import Environment
from drgs.scene.mesh import TriangleMesh


def constant_sky(value: float = 1.0, height: int = 16) -> Environment:
    return Environment(torch.full((height, 2 * height, 3), value))


def sunny_sky(height: int = 16, sun: float = 200.0) -> Environment:
    """Coloured noise and a sun of one texel, above the horizon."""
    radiance = torch.rand(height, 2 * height, 3, generator=torch.Generator().manual_seed(5)) + 0.1
    radiance[height // 4, height // 2] = sun
    return Environment(radiance)


def sphere_mesh(
    subdivisions: int = 3, albedo: float = 0.7, roughness: float = 0.5, metallic: float = 0.0, radius: float = 1.0, smooth: bool = True
) -> TriangleMesh:
    """A unit icosphere; smooth: shading normals of the true sphere."""
    shape = trimesh.creation.icosphere(subdivisions, radius)
    return mesh_of(shape, albedo, roughness, metallic)


def two_spheres(albedo: float = 0.7, roughness: float = 0.5, metallic: float = 0.0) -> TriangleMesh:
    """Two unit spheres, nearly touching: the smallest scene that sees itself."""
    left, right = trimesh.creation.icosphere(3), trimesh.creation.icosphere(3)
    left.apply_translation([-1.02, 0, 0])
    right.apply_translation([1.02, 0, 0])
    return mesh_of(trimesh.util.concatenate([left, right]), albedo, roughness, metallic)


def mesh_of(shape: trimesh.Trimesh, albedo: float, roughness: float, metallic: float) -> TriangleMesh:
    count = len(shape.vertices)
    return TriangleMesh(
        torch.tensor(shape.vertices, dtype=torch.float32),
        torch.tensor(shape.faces, dtype=torch.int32),
        torch.tensor(shape.vertex_normals.copy(), dtype=torch.float32),
        torch.full((count, 3), albedo),
        torch.full((count,), roughness),
        torch.full((count,), metallic),
    )


def crumpled_mesh() -> TriangleMesh:
    """A ball with bumps, its materials all different; bare dielectrics below."""
    shape = trimesh.creation.icosphere(2)
    numbers = torch.Generator().manual_seed(3)
    shape.vertices *= (1 + 0.2 * torch.rand(len(shape.vertices), 1, generator=numbers)).numpy()
    mesh = mesh_of(shape, 0.7, 0.5, 0.0)
    count = len(mesh.vertices)
    albedo, roughness = torch.rand(count, 3, generator=numbers), torch.rand(count, generator=numbers)
    metallic = torch.where(mesh.vertices[:, 2] < 0, 0.0, torch.rand(count, generator=numbers))
    return TriangleMesh(mesh.vertices, mesh.faces, mesh.normals, albedo, roughness, metallic)


def on_device(mesh: TriangleMesh, device: str) -> TriangleMesh:
    return TriangleMesh(*(getattr(mesh, name).to(device) for name in ("vertices", "faces", "normals", "albedo", "roughness", "metallic")))


def front_camera(size: int = 24, distance: float = 4.0, field_of_view: float = 0.6) -> Camera:
    """Looks along +y at the origin, z up."""
    world_from_opengl = torch.tensor([[1.0, 0, 0, 0], [0, 0, -1.0, -distance], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])
    focal = 0.5 * size / math.tan(0.5 * field_of_view)
    return camera_from_opengl(world_from_opengl, torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]]), size, size)


def points_seen_at(
    polar_degrees: list[float], albedo: float = 0.7, roughness: float = 0.5, metallic: float = 0.0, copies: int = 1
) -> ShadingPoints:
    """Points at the origin, tilted normals, seen under the given angles; pixel numbers count up."""
    theta = torch.tensor(polar_degrees).deg2rad().repeat_interleave(copies)
    count = len(theta)
    normal = torch.nn.functional.normalize(torch.tensor([0.3, -0.2, 0.9]), dim=0).expand(count, 3).contiguous()
    tangent = torch.nn.functional.normalize(torch.linalg.cross(normal, torch.tensor([0.0, 1.0, 0.0]).expand(count, 3)), dim=-1)
    wo = torch.cos(theta)[:, None] * normal + torch.sin(theta)[:, None] * tangent
    full = torch.full((count,), 1.0)
    return ShadingPoints(
        torch.zeros(count, 3), normal, wo, torch.full((count, 3), albedo), roughness * full, metallic * full, torch.arange(count).int()
    )
