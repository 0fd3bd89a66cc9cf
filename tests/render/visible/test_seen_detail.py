"""Albedo between the vertices, as cameras and rays see it: the kernels against their twin, from the first picture on and after edits."""

from dataclasses import replace

import pytest
import torch

from drgs.reference.mesh_surface import surfaces_at
from drgs.render.intersect.trace_rays import build_tracer, trace_rays
from drgs.render.records import PrimaryPoints, RayStarts, RenderSettings, ShadingPoints
from drgs.render.render_frame import render_frame
from drgs.render.visible.refresh_materials import refresh_primary
from drgs.render.visible.trace_primary import trace_primary
from drgs.scene.albedo_detail import AlbedoDetail, codes_of, samples_of
from drgs.scene.camera import pixel_rays_world
from drgs.scene.environment import Environment
from drgs.scene.mesh import TriangleMesh
from drgs.scene.posed_scene import PosedScene
from tests.render.closed_form_scenes import front_camera, sphere_mesh

CAMERA = front_camera(64)


def detailed_ball(parts: int, share: bool) -> TriangleMesh:
    mesh = sphere_mesh(subdivisions=2, albedo=0.3)
    numbers = torch.Generator().manual_seed(parts)
    factors = 3 * torch.rand(len(mesh.faces), samples_of(parts), 3, generator=numbers)
    worn = torch.rand(len(mesh.vertices), generator=numbers) if share else None
    return replace(mesh, detail=AlbedoDetail(codes_of(factors), worn))


@pytest.mark.parametrize("share", [False, True])
@pytest.mark.parametrize("parts", [1, 2, 5, 8])
def test_cameras_see_the_detail_as_its_twin_says(parts: int, share: bool):
    mesh = detailed_ball(parts, share)
    gbuffer = trace_primary(mesh, CAMERA)
    origin, directions = pixel_rays_world(CAMERA)
    flat = directions.reshape(-1, 3)
    hits = trace_rays(origin.expand_as(flat), flat, build_tracer(mesh))
    assert int(hits.hit.sum()) > 500
    expected = surfaces_at(mesh, hits.face[hits.hit], hits.barycentric[hits.hit]).albedo
    found = gbuffer.albedo.reshape(-1, 3)[hits.hit]
    # A ray that was found on the other side of an edge between samples sees the same, but for rounding.
    torch.testing.assert_close(found, expected, rtol=0, atol=2e-4)
    plain = trace_primary(replace(mesh, detail=None), CAMERA).albedo.reshape(-1, 3)[hits.hit]
    assert float((found - plain).abs().mean()) > 0.03


def test_points_with_fresh_materials_wear_the_detail():
    mesh = detailed_ball(4, True)
    generator = torch.Generator().manual_seed(0)
    face = torch.randint(len(mesh.faces), (50,), generator=generator)
    where = torch.rand(50, 2, generator=generator) / 2
    nothing, lost = torch.zeros(50), torch.zeros(50, 3)
    points = ShadingPoints(lost, lost, lost, lost, nothing, nothing, torch.arange(50, dtype=torch.int32))
    seen = PrimaryPoints(points, RayStarts(lost, lost, face.int()), nothing, where)
    torch.testing.assert_close(refresh_primary(seen, mesh).points.albedo, surfaces_at(mesh, face, where).albedo)


def test_a_picture_under_an_even_light_shows_it():
    """A white sky sends back albedo, so where the factor is 2 on one half and 0.5 on the other pictures differ fourfold there."""
    mesh = sphere_mesh(subdivisions=3, albedo=0.2, roughness=1.0)
    middle = mesh.vertices[mesh.faces.long()].mean(1)
    factors = torch.where(middle[:, 2] > 0, 2.0, 0.5)[:, None, None].expand(-1, samples_of(2), 3)
    scene = PosedScene(None, replace(mesh, detail=AlbedoDetail(codes_of(factors))), Environment(torch.ones(8, 16, 3)))
    settings = RenderSettings(samples_per_pixel=64, bounces=0, primary="mesh")
    seen = render_frame(scene, CAMERA, settings)
    plain = render_frame(replace(scene, mesh=mesh), CAMERA, settings)
    ratio = (seen.radiance.diffuse / plain.radiance.diffuse.clamp(min=1e-6))[..., 0]
    height = trace_primary(mesh, CAMERA)
    upper, lower = ((sign * height.position_world[..., 2] > 0.15) & (height.coverage > 0.99) for sign in (1, -1))
    torch.testing.assert_close(ratio[upper].mean(), torch.tensor(2.0), rtol=0.02, atol=0)
    torch.testing.assert_close(ratio[lower].mean(), torch.tensor(0.5), rtol=0.02, atol=0)
