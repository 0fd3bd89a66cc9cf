"""Rays from points of a sphere. It is convex: what leaves it sees the sky, what goes below its surface starts inside of it."""

import torch

from drgs.render.records import Rays, ShadingPoints
from drgs.scene.mesh import TriangleMesh


def rays_of_convex(mesh: TriangleMesh) -> tuple[ShadingPoints, Rays]:
    """Twelve rays in all directions from each seventh vertex; the first of each point weighs nothing."""
    normal = mesh.normals[::7].contiguous()
    count = len(normal)
    half = torch.full((count,), 0.5)
    points = ShadingPoints(
        mesh.vertices[::7].contiguous(), normal, normal, half[:, None].expand(count, 3), half, half, torch.arange(count).int()
    )
    directions = torch.nn.functional.normalize(torch.randn(count, 12, 3, generator=torch.Generator().manual_seed(1)), dim=-1)
    weight = torch.ones(count, 12)
    weight[:, 0] = 0.0
    return points, Rays(points.position_world, directions, weight)


def assert_only_the_sky_is_seen(points: ShadingPoints, rays: Rays, transmittance: torch.Tensor, hit_radiance: torch.Tensor) -> None:
    """Of the rays of `rays_of_convex`: those above the surface see the sky, others bring nothing."""
    height = (rays.direction_world * points.normal_world[:, None]).sum(-1)
    assert float(transmittance[:, 0].max()) == 0.0
    assert float(transmittance[:, 1:][height[:, 1:] > 0.15].min()) == 1.0
    assert float(transmittance[:, 1:][height[:, 1:] < -0.15].max()) == 0.0
    assert float(hit_radiance.abs().max()) == 0.0
