"""Surfels on the faces of a mesh draw the mesh: closed, with its normals and materials, and bound to it exactly."""

import dataclasses

import torch

from drgs.maths.spherical_harmonics import radiance_from_sh
from drgs.reconstruct.geometry.bind_gaussians import points_from_binding
from drgs.reconstruct.geometry.face_surfels import radiating_surfels, surfels_on_faces_of
from drgs.render.visible.rasterize import rasterize_gbuffer
from drgs.scene.gaussians import surfel_tangents
from drgs.scene.materials import Materials
from drgs.scene.posed_scene import PosedSurfels
from tests.render.closed_form_scenes import constant_sky, front_camera, sphere_mesh


def drawn(gaussians):
    materials = Materials(gaussians.albedo, gaussians.roughness, gaussians.metallic)
    posed = PosedSurfels(gaussians.centers, surfel_tangents(gaussians), torch.sigmoid(gaussians.opacity_logits), materials)
    return rasterize_gbuffer(posed, front_camera(64))


def test_together_they_are_the_closed_surface_with_its_normals_and_materials():
    mesh = sphere_mesh(subdivisions=4)
    mesh = dataclasses.replace(mesh, albedo=0.5 + 0.4 * mesh.normals, roughness=0.5 + 0.3 * mesh.normals[:, 2])
    maps = drawn(surfels_on_faces_of(mesh)[0])
    offset = maps.position_world.norm(dim=-1)
    inside = maps.coverage > 0.5
    inside &= torch.nn.functional.avg_pool2d(inside.float()[None, None], 5, 1, 2)[0, 0] > 0.99
    assert float(maps.coverage[inside].min()) > 0.97
    assert float((offset[inside] - 1).abs().max()) < 0.02
    true = torch.nn.functional.normalize(maps.position_world, dim=-1)
    angle = torch.rad2deg(torch.arccos((maps.normal_world * true).sum(-1).clamp(-1, 1)))[inside]
    # The surfel in front covers those beside it, so a pixel shows the normal of half an edge nearer to the camera: 2 of the 4 degrees between.
    assert float(angle.mean()) < 3.0
    assert float((maps.albedo[inside] - (0.5 + 0.4 * true[inside])).abs().mean()) < 0.01


def test_centres_are_where_the_binding_says():
    mesh = sphere_mesh(subdivisions=2)
    gaussians, binding = surfels_on_faces_of(mesh)
    assert len(gaussians.centers) == len(mesh.faces) == len(binding.face.unique())
    torch.testing.assert_close(points_from_binding(binding, mesh.vertices, mesh.faces), gaussians.centers, atol=1e-6, rtol=0)


def test_faces_without_area_get_none():
    mesh = sphere_mesh(subdivisions=1)
    faces = mesh.faces.clone()
    faces[0] = faces[0, 0]
    gaussians, binding = surfels_on_faces_of(dataclasses.replace(mesh, faces=faces))
    assert len(gaussians.centers) == len(faces) - 1 and 0 not in binding.face.tolist()
    assert bool(torch.isfinite(gaussians.log_scales).all())


def test_under_a_constant_sky_white_surfels_send_out_the_sky():
    mesh = sphere_mesh(subdivisions=2, albedo=1.0, roughness=0.9)
    grey, binding = surfels_on_faces_of(dataclasses.replace(mesh, albedo=torch.full_like(mesh.albedo, 0.5)))
    gaussians = radiating_surfels(grey, binding, mesh, constant_sky(0.8, 128))
    assert torch.allclose(gaussians.albedo, torch.ones_like(gaussians.albedo)) and torch.equal(gaussians.centers, grey.centers)
    towards = -torch.nn.functional.normalize(gaussians.centers, dim=-1)
    assert float((radiance_from_sh(gaussians.sh, towards) - 0.8).abs().max()) < 0.08
