"""Horizons: a proof must never be wrong, so rays above them are traced and must all escape."""

import math

import pytest
import torch
import trimesh
import warp as wp

from drgs.deform.pose_scene import pose_scene
from drgs.reference.rasterize_gbuffer import look_at_camera
from drgs.render.intersect import horizon as horizon_module
from drgs.render.intersect.horizon import (
    BLOCKED,
    RAYS_A_FACE,
    RAYS_A_FACE_AHEAD,
    TRIAL,
    Horizons,
    find_horizons,
    stored_horizons,
    usable_horizons,
)
from drgs.render.intersect.trace_rays import build_tracer
from drgs.render.intersect.tracer import mesh_extent
from drgs.render.progressive.start_frame import start_frame
from drgs.render.records import RenderSettings
from drgs.scene.asset import Asset
from drgs.scene.edits import parse_edits
from drgs.scene.mesh import TriangleMesh
from drgs.warp_torch import warp_array
from tests.render.closed_form_scenes import constant_sky, mesh_of, on_device, sphere_mesh, two_spheres


def crumpled_sphere() -> TriangleMesh:
    """Bumps, dents and folds of many sizes."""
    shape = trimesh.creation.icosphere(3)
    noise = torch.rand(len(shape.vertices), generator=torch.Generator().manual_seed(3)).numpy()
    shape.vertices *= (1 + 0.15 * noise)[:, None]
    return mesh_of(shape, 0.7, 0.5, 0.0)


def open_box() -> TriangleMesh:
    """A box without a lid, outside only: its inner sides are the backs of its triangles; and a smaller, closed box in it."""
    box, inner = trimesh.creation.box(extents=(2, 2, 2)), trimesh.creation.box(extents=(0.5, 0.5, 0.5))
    box.update_faces(box.triangles_center[:, 2] < 0.99)
    return mesh_of(trimesh.util.concatenate([box, inner]), 0.7, 0.5, 0.0)


def floor_and_ball() -> TriangleMesh:
    ball, floor = trimesh.creation.icosphere(2), trimesh.creation.box(extents=(40, 40, 0.1))
    ball.apply_translation([0, 0, 1.2])
    return mesh_of(trimesh.util.concatenate([ball, floor]), 0.7, 0.5, 0.0)


SCENES = {"crumpled": crumpled_sphere, "two spheres": two_spheres, "open box": open_box, "floor": floor_and_ball}


def sectors(normal: torch.Tensor, direction: torch.Tensor) -> torch.Tensor:
    """(ray,) horizon_sector in float64."""
    normal, direction = normal.double(), direction.double()
    u = torch.nn.functional.normalize(torch.stack([-normal[:, 1], normal[:, 0], 0 * normal[:, 0]], -1), dim=-1)
    x, y = (direction * u).sum(-1), (direction * torch.linalg.cross(normal, u)).sum(-1)
    return (x < 0).long() + 2 * (y < 0).long() + 4 * (y.abs() > x.abs()).long()


@pytest.mark.parametrize("name", SCENES)
def test_rays_above_the_horizon_never_meet_the_mesh(name: str) -> None:
    mesh = SCENES[name]()
    tracer = build_tracer(mesh)
    sine = find_horizons(mesh, tracer.lift)
    face = torch.nonzero((sine < 1).any(1)).squeeze(-1)
    assert len(face)
    face = face.repeat(-(-60_000 // len(face)))
    corners = mesh.vertices[mesh.faces[face].long()]
    weights = torch.rand(len(face), 3).pow(2.0)  # towards the edges, where neighbours rise
    weights /= weights.sum(1, keepdim=True)
    normal = torch.nn.functional.normalize(torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), dim=-1)
    origin = (weights[..., None] * corners).sum(1) + tracer.lift * normal
    # Just above the horizon of each sector.
    across = torch.nn.functional.normalize(torch.linalg.cross(normal, torch.randn(len(face), 3)), dim=-1)
    limit = sine[face, sectors(normal, across)]
    height = (limit + (1 - limit) * torch.rand(len(face)).pow(4.0)).clamp(max=1)
    direction = torch.nn.functional.normalize(height[:, None] * normal + torch.sqrt(1 - height**2)[:, None] * across, dim=-1)
    above = ((direction * normal).sum(-1) > limit) & (sectors(normal, direction) == sectors(normal, across))
    assert float(above.float().mean()) > 0.1
    assert not bool(tracer.occluded(origin[above].contiguous(), direction[above].contiguous()).any())


def test_a_convex_mesh_sees_nothing_of_itself() -> None:
    assert float(find_horizons(sphere_mesh(3), 1e-5).max()) < 1e-4


def step(tilt_degrees: float) -> TriangleMesh:
    """A floor of 1 by 1 before a wall of height 1 at distance 1, turned about the axis along the wall's foot."""
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0], [2, 1, 0], [2, 0, 1], [2, 1, 1]])
    angle = torch.tensor(tilt_degrees).deg2rad()
    x, y, z = vertices.unbind(1)
    vertices = torch.stack([torch.cos(angle) * x - torch.sin(angle) * z, y, torch.sin(angle) * x + torch.cos(angle) * z], -1)
    faces = torch.tensor([[0, 1, 2], [0, 2, 3], [4, 6, 5], [5, 6, 7]], dtype=torch.int32)
    one = torch.ones(8)
    return TriangleMesh(vertices, faces, torch.tensor([0.0, 0, 1]).expand(8, 3).contiguous(), torch.ones(8, 3), one, 0 * one)


@pytest.mark.parametrize("tilt", [0.0, 30.0])
def test_the_horizon_of_a_step_is_its_slope(tilt: float) -> None:
    """Seen from the floor's edge the wall rises to 45 degrees."""
    sine = find_horizons(step(tilt), 1e-6)
    assert abs(float(sine[0].max()) - math.sin(math.pi / 4)) < 1e-3
    assert float(sine[1].max()) < float(sine[0].max()) + 1e-3


def test_only_sectors_that_look_at_the_wall_have_a_horizon() -> None:
    """A face that looks straight up, where its frame may turn, has the highest all around."""
    assert 2 <= int((find_horizons(step(30.0), 1e-6)[0] < 1e-4).sum()) <= 5
    assert float(find_horizons(step(0.0), 1e-6)[0].min()) > 0.5


@pytest.mark.parametrize("name", SCENES)
def test_sixteen_triangles_at_once_are_the_triangles_one_by_one(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = SCENES[name]()
    together = find_horizons(mesh, 1e-5)
    launch, plain = horizon_module.launch, horizon_module.raise_horizons

    def launch_plain(kernel, count, inputs, outputs, device, slices_per_thread):
        which, corners, *_, lift = inputs
        in_order = wp.to_torch(corners).view(-1, 3, 3)
        boxes = [warp_array(box, wp.vec3) for size in (16, 256) for box in horizon_module._boxes(in_order, size)]
        launch(plain, count, [which, corners, len(mesh.faces), *boxes, lift], outputs, device)

    monkeypatch.setattr(horizon_module, "launch", launch_plain)
    torch.testing.assert_close(together, find_horizons(mesh, 1e-5), rtol=0, atol=1e-4)


def test_kernel_finds_the_same_on_each_device(device: str) -> None:
    mesh = two_spheres()
    torch.testing.assert_close(find_horizons(on_device(mesh, device), 1e-5).cpu(), find_horizons(mesh, 1e-5), rtol=0, atol=1e-4)


def test_faces_without_area_are_never_let_off() -> None:
    mesh = sphere_mesh(1)
    faces = torch.cat([mesh.faces, torch.tensor([[0, 0, 1], [2, 2, 2]], dtype=torch.int32)])
    flat = TriangleMesh(mesh.vertices, faces, mesh.normals, mesh.albedo, mesh.roughness, mesh.metallic)
    assert bool((find_horizons(flat, 1e-5)[-2:] == BLOCKED).all())


def started(horizons: Horizons) -> Horizons:
    """After the rays that every search waits for."""
    horizons.pay(math.ceil(RAYS_A_FACE * TRIAL * horizons.faces))
    return horizons


def test_horizons_are_found_as_rays_pay_for_them() -> None:
    horizons = started(Horizons(sphere_mesh(3), 1e-5))
    horizons.pay(1000)
    assert horizons.found == 0 and usable_horizons(horizons) is None
    horizons.pay(RAYS_A_FACE_AHEAD * horizons.faces // 2)  # the trial
    horizons.pay(RAYS_A_FACE_AHEAD * horizons.faces // 2)
    assert 0 < horizons.found < horizons.faces
    known = (horizons.sine < BLOCKED).all(1)
    assert int(known.sum()) == horizons.found
    horizons.pay(RAYS_A_FACE_AHEAD * horizons.faces)
    assert horizons.found == horizons.faces and bool((horizons.sine < BLOCKED).all())


def test_short_renders_and_meshes_that_move_with_every_frame_search_nothing() -> None:
    horizons = Horizons(sphere_mesh(3), 1e-5)
    horizons.pay(math.floor(0.9 * RAYS_A_FACE * TRIAL * horizons.faces))
    horizons.pay(10**9)
    assert horizons.found == 0
    horizons.pay(10**6)
    assert horizons.found > 0


def test_faces_that_rays_start_from_come_first() -> None:
    horizons = started(Horizons(sphere_mesh(4), 1e-5))
    horizons.find(math.ceil(TRIAL * horizons.faces))
    starts = torch.tensor([7, -1, 300, 7, *range(1000, 2000)], dtype=torch.int32)
    horizons.pay(RAYS_A_FACE * 2000, starts)
    assert bool((horizons.sine[starts[starts >= 0].long()] < BLOCKED).all())
    assert horizons.found < horizons.faces / 2


def test_the_search_ends_where_hardly_a_ray_would_be_spared() -> None:
    """A sphere turned inside out: every face looks at all the others."""
    shape = trimesh.creation.icosphere(3)
    shape.invert()
    horizons = Horizons(mesh_of(shape, 0.7, 0.5, 0.0), 1e-5)
    for _ in range(20):
        horizons.pay(400 * 256)
    assert horizons.found < horizons.faces


def test_a_share_of_sky_may_be_given_up_where_little_is_blocked() -> None:
    horizons = Horizons(floor_and_ball(), 1e-5)
    horizons.find(horizons.faces)
    allowed = usable_horizons(horizons, 0.05)
    assert allowed is not None
    given_up = (allowed < 0).all(1)
    assert torch.equal(given_up, horizons.sine.square().mean(1) <= 0.05) and bool(given_up.any()) and not bool(given_up.all())
    assert torch.equal(allowed[~given_up], horizons.sine[~given_up])


@pytest.mark.parametrize("name", SCENES)
def test_stored_horizons_are_never_lower_and_hardly_higher(name: str) -> None:
    mesh = SCENES[name]()
    lift = mesh_extent(mesh)[1]
    found = find_horizons(mesh, lift)
    read = Horizons(mesh, lift, stored_horizons(found))
    assert read.found == read.faces and bool((read.sine >= found).all())
    assert float((read.sine - found).max()) < 1 / 250
    read.pay(10**9)  # nothing is left to be found
    assert bool(((read.sine == BLOCKED) == (found == BLOCKED)).all())


def test_a_scene_at_rest_brings_its_horizons_and_a_moved_one_finds_its_own() -> None:
    mesh = two_spheres()
    stored = stored_horizons(find_horizons(mesh, mesh_extent(mesh)[1]))
    asset = Asset(None, mesh, None, constant_sky(), horizons=stored)
    settings = RenderSettings(samples_per_pixel=4)
    known, moved = (
        start_frame(pose_scene(asset, edits), look_at_camera(32, 32, focal=40.0), settings).traced.tracer.horizons
        for edits in ([], parse_edits([{"op": "deform", "map": {"type": "twist", "rate": 0.3}}]))
    )
    assert known is not None and known.found == known.faces
    assert moved is not None and moved.found == 0
