"""Mesh extraction from depth maps of shapes whose distance functions are known."""

import math
import sys
from collections.abc import Callable
from functools import cache

import pytest
import torch

from drgs.reconstruct.geometry.extract_mesh import DepthMap, MeshSettings, extract_mesh, fuse_depth, mesh_report
from drgs.reconstruct.geometry.extract_mesh.extract_mesh import march
from drgs.reconstruct.geometry.extract_mesh.fuse_depth import camera_rays, integrate_blocks, pack_views, packed_pixels
from drgs.reference.extract_mesh import distance_field_at
from drgs.scene.camera import Camera

DRAFT = MeshSettings(resolution=80, face_limit=20_000)


def sphere_distance(p: torch.Tensor) -> torch.Tensor:
    return p.norm(dim=-1) - 0.7


def torus_distance(p: torch.Tensor) -> torch.Tensor:
    return torch.hypot(torch.hypot(p[..., 0], p[..., 1]) - 0.6, p[..., 2]) - 0.25


def box_distance(p: torch.Tensor) -> torch.Tensor:
    q = p.abs() - torch.tensor([0.6, 0.45, 0.3], dtype=p.dtype)
    return q.clamp(min=0).norm(dim=-1) + q.amax(-1).clamp(max=0)


SIDE = 120
"""Of depth maps [pixels]: at the shapes a pixel is narrower than a voxel of DRAFT."""
AROUND = 1.05
"""Radius of a ball that holds every shape."""
VOLUMES = {sphere_distance: 4 / 3 * math.pi * 0.7**3, torus_distance: 2 * math.pi**2 * 0.6 * 0.25**2, box_distance: 8 * 0.6 * 0.45 * 0.3}


def orbit_camera(eye: torch.Tensor, size: int = 160, target: torch.Tensor | None = None) -> Camera:
    """Looks from `eye` at `target` (the origin), up towards z."""
    eye = eye.double()
    forward = torch.nn.functional.normalize((torch.zeros(3) if target is None else target).double() - eye, dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, torch.tensor([0.02, 0.01, 1.0], dtype=torch.float64)), dim=0)
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    camera_from_world = torch.eye(4, dtype=torch.float64)
    camera_from_world[:3, :3], camera_from_world[:3, 3] = rotation, -rotation @ eye
    focal = 1.7 * size
    intrinsics = torch.tensor([[focal, 0, size / 2 + 1.3], [0, focal, size / 2 - 0.8], [0, 0, 1]])
    return Camera(camera_from_world.float(), intrinsics, size, size)


def sphere_directions(count: int) -> torch.Tensor:
    i = torch.arange(count, dtype=torch.float64) + 0.5
    z, angle = 1 - 2 * i / count, i * math.pi * (3 - math.sqrt(5))
    ring = (1 - z * z).sqrt()
    return torch.stack([ring * angle.cos(), ring * angle.sin(), z], -1)


def traced_depth(distance: Callable[[torch.Tensor], torch.Tensor], camera: Camera, center: torch.Tensor, scale: float) -> DepthMap:
    """Depth of a shape scaled and moved, by sphere tracing; coverage by the pixel centre."""
    rays = camera_rays(camera, (camera.height, camera.width), torch.device("cpu")).double().reshape(-1, 3)
    length = rays.norm(dim=-1)
    directions = rays / length[:, None] @ camera.camera_from_world[:3, :3].double()
    origin = (camera.center_world.double() - center) / scale
    t, gap = torch.zeros_like(length), torch.ones_like(length)
    # Only where a ray is within the ball that holds the shape: a distance function is slowest to tell those that miss.
    middle = -(directions @ origin)
    half = (middle**2 - origin @ origin + AROUND**2).clamp(min=0).sqrt()
    going = half.nonzero()[:, 0]
    place, ahead = middle[going] - half[going], directions[going]
    for _ in range(70):
        here = distance(origin + place[:, None] * ahead)
        place = place + here
        t[going], gap[going] = place, here
        left = (here > 1e-9) & (place < middle[going] + half[going])
        going, place, ahead = going[left], place[left], ahead[left]
    depth = torch.where(gap < 1e-4, t * scale / length, torch.zeros_like(t))
    return DepthMap(camera, depth.reshape(camera.height, camera.width).float(), (gap < 1e-4).reshape(camera.height, camera.width).float())


def capture(
    distance: Callable[[torch.Tensor], torch.Tensor],
    directions: torch.Tensor,
    center: torch.Tensor | None = None,
    scale: float = 1.0,
    size: int = SIDE,
) -> list[DepthMap]:
    center = torch.zeros(3, dtype=torch.float64) if center is None else center.double()
    return [traced_depth(distance, orbit_camera(center + 4 * scale * d, size, center), center, scale) for d in directions]


@cache
def orbit(distance: Callable[[torch.Tensor], torch.Tensor]) -> list[DepthMap]:
    """Of the shape at the origin, from all sides."""
    return capture(distance, sphere_directions(30))


@pytest.fixture(scope="module")
def torus_views() -> list[DepthMap]:
    return orbit(torus_distance)


def torus_error(vertices: torch.Tensor) -> torch.Tensor:
    """Distance of vertices from the true torus in draft voxels."""
    return torus_distance(vertices.double()).abs() / (2 / 80)


@pytest.mark.slow
@pytest.mark.parametrize("distance", [sphere_distance, torus_distance, box_distance])
def test_orbit_gives_a_closed_mesh_within_a_voxel_and_a_percent(distance):
    vertices, faces = extract_mesh(orbit(distance), torch.zeros(3), 1.0, DRAFT)
    report = mesh_report(vertices, faces)
    assert vertices.dtype == torch.float32 and faces.dtype == torch.int32
    assert report.watertight and report.component_count == 1
    error = distance(vertices.double()).abs() / (2 / 80)
    assert error.max() < 1.0 and error.mean() < 0.15
    assert report.volume == pytest.approx(VOLUMES[distance], rel=0.01)  # positive: wound outward


@pytest.mark.slow
@pytest.mark.parametrize(("scale", "center"), [(50.0, (300.0, -40.0, 7.0)), (1e-7, (0.0, 0.0, 0.0))])
def test_scale_and_place_do_not_matter(scale, center):
    center = torch.tensor(center)
    vertices, faces = extract_mesh(capture(torus_distance, sphere_directions(30), center, scale=scale), center, scale, DRAFT)
    assert mesh_report(vertices, faces).watertight
    assert torus_error((vertices - center) / scale).max() < 1.0


@pytest.mark.slow
def test_field_matches_the_float64_twin(torus_views):
    views = torus_views[:7]
    settings = MeshSettings(resolution=64)
    blocks = torch.tensor([[0, 1, 2], [3, 3, 3], [2, 2, 1], [3, 1, 2]])
    origin, voxel = torch.tensor([-0.9, -0.9, -0.55]), 0.04
    field = integrate_blocks(pack_views(views), blocks, origin, voxel, 0.13, voxel, settings)
    offsets = torch.cartesian_prod(*[torch.arange(8)] * 3)
    points = (blocks[:, None] * 8 + offsets).reshape(-1, 3) * float(voxel) + origin
    expected = distance_field_at(points.double(), views, [packed_pixels(v).double() for v in views], 0.13, voxel, 2, 0.05)
    difference = (field.reshape(-1).double() - expected).abs()
    # A vote that sits on a threshold may fall either way in float32.
    assert (difference > 1e-3).float().mean() < 2e-3
    assert difference[difference <= 1e-3].max() < 1e-3 and (expected.abs() < 0.9).sum() > 100


@pytest.mark.slow
def test_field_is_a_distance_with_unit_slope_near_the_surface(torus_views):
    field = fuse_depth(torus_views, torch.zeros(3), 1.0, DRAFT)
    index = (field.values.abs() < 0.5).nonzero()
    distance = torus_distance(field.origin.double() + field.voxel_size * index.double())
    measured = field.values[index[:, 0], index[:, 1], index[:, 2]] * DRAFT.truncation_voxels * field.voxel_size
    assert (measured - distance).abs().mean() < 0.25 * field.voxel_size


@pytest.mark.slow
def test_noise_is_averaged_away(torus_views):
    generator = torch.Generator().manual_seed(0)
    noise = 0.025  # one voxel
    noisy = [
        DepthMap(v.camera, torch.where(v.depth > 0, v.depth + noise * torch.randn(v.depth.shape, generator=generator), v.depth), v.coverage)
        for v in torus_views
    ]
    vertices, faces = extract_mesh(noisy, torch.zeros(3), 1.0, DRAFT)
    report = mesh_report(vertices, faces)
    assert report.watertight and report.volume == pytest.approx(VOLUMES[torus_distance], rel=0.02)
    assert torus_error(vertices).mean() < 0.25


@pytest.mark.slow
def test_one_corrupt_depth_map_does_no_harm(torus_views):
    bad = torus_views[4]
    generator = torch.Generator().manual_seed(1)
    corrupt = DepthMap(bad.camera, 2.5 + 3.0 * torch.rand(bad.depth.shape, generator=generator), torch.ones_like(bad.coverage))
    vertices, faces = extract_mesh([*torus_views[:4], corrupt, *torus_views[5:]], torch.zeros(3), 1.0, DRAFT)
    assert mesh_report(vertices, faces).watertight
    assert torus_error(vertices).max() < 1.5


@pytest.mark.slow
def test_one_shifted_depth_map_digs_no_tunnel(torus_views):
    bad = torus_views[11]
    shifted = DepthMap(bad.camera, torch.where(bad.depth > 0, bad.depth + 0.3, bad.depth), bad.coverage)
    vertices, _ = extract_mesh([*torus_views[:11], shifted, *torus_views[12:]], torch.zeros(3), 1.0, DRAFT)
    assert torus_error(vertices).max() < 2.0


@pytest.mark.slow
def test_missing_depth_is_neither_surface_nor_hole(torus_views):
    """Covered pixels without depth (NaN, 0, inf) say nothing."""
    patchy = []
    for k, view in enumerate(torus_views):
        depth = view.depth.clone()
        depth[SIDE // 5 : 4 * SIDE // 5 : 7, :] = (float("nan"), 0.0, float("inf"))[k % 3]
        patchy.append(DepthMap(view.camera, depth, view.coverage))
    vertices, faces = extract_mesh(patchy, torch.zeros(3), 1.0, DRAFT)
    assert mesh_report(vertices, faces).watertight and torus_error(vertices).max() < 1.0


@pytest.mark.slow
def test_views_from_above_only_still_close_the_mesh():
    directions = sphere_directions(60)
    vertices, faces = extract_mesh(capture(sphere_distance, directions[directions[:, 2] > 0.2]), torch.zeros(3), 1.0, DRAFT)
    assert mesh_report(vertices, faces).watertight
    upper = vertices[vertices[:, 2] > 0.1]
    assert sphere_distance(upper.double()).abs().max() < 2 / 80
    assert (sphere_distance(vertices.double()) > -2 / 80).all()  # what nobody saw is filled, not dug out


@pytest.mark.slow
def test_views_from_one_side_close_at_the_bounds():
    directions = torch.nn.functional.normalize(
        torch.tensor([[4.0, y, z] for y in (-1.0, 0, 1) for z in (-1.0, 0, 1)], dtype=torch.float64), dim=-1
    )
    vertices, faces = extract_mesh(capture(sphere_distance, directions), torch.zeros(3), 1.0, DRAFT)
    assert mesh_report(vertices, faces).watertight
    assert sphere_distance(vertices[vertices[:, 0] > 0.2].double()).abs().max() < 1.5 * 2 / 80


@pytest.mark.slow
def test_largest_component_is_kept_unless_asked_otherwise():
    def two_spheres(p: torch.Tensor) -> torch.Tensor:
        return torch.minimum(p.norm(dim=-1) - 0.45, (p - torch.tensor([0.75, 0.0, 0.0], dtype=p.dtype)).norm(dim=-1) - 0.2)

    views = capture(two_spheres, sphere_directions(30))
    one = mesh_report(*extract_mesh(views, torch.zeros(3), 1.0, DRAFT))
    both = mesh_report(*extract_mesh(views, torch.zeros(3), 1.0, MeshSettings(resolution=80, keep_component_fraction=0.02)))
    assert (one.component_count, both.component_count) == (1, 2)
    assert one.volume == pytest.approx(4 / 3 * math.pi * 0.45**3, rel=0.02)
    assert both.volume == pytest.approx(4 / 3 * math.pi * (0.45**3 + 0.2**3), rel=0.02)


@pytest.mark.slow
def test_face_limit_binds_and_keeps_the_mesh_closed(torus_views):
    vertices, faces = extract_mesh(torus_views, torch.zeros(3), 1.0, MeshSettings(resolution=80, face_limit=1500))
    report = mesh_report(vertices, faces)
    assert report.face_count <= 1500 and report.watertight
    assert report.volume == pytest.approx(VOLUMES[torus_distance], rel=0.02)


@pytest.mark.slow
def test_given_normals_change_little_against_estimated_ones(torus_views):
    with_normals = []
    for view in torus_views:
        rays = camera_rays(view.camera, view.depth.shape, torch.device("cpu")) * view.depth[..., None]
        points = ((rays - view.camera.camera_from_world[:3, 3]) @ view.camera.camera_from_world[:3, :3]).double().requires_grad_()
        (normal,) = torch.autograd.grad(torus_distance(points).sum(), points)
        with_normals.append(DepthMap(view.camera, view.depth, view.coverage, normal.float()))
    vertices, _ = extract_mesh(with_normals, torch.zeros(3), 1.0, DRAFT)
    assert torus_error(vertices).max() < 1.0


@pytest.mark.slow
def test_views_of_different_sizes_and_small_batches_give_the_same_mesh(torus_views, monkeypatch):
    expected = fuse_depth(torus_views, torch.zeros(3), 1.0, DRAFT)
    monkeypatch.setattr(sys.modules["drgs.reconstruct.geometry.extract_mesh.fuse_depth"], "BATCH_BYTES", 3 * SIDE * SIDE * 16)
    torch.testing.assert_close(fuse_depth(torus_views, torch.zeros(3), 1.0, DRAFT).values, expected.values, atol=1e-5, rtol=0)
    mixed = [*torus_views, *capture(torus_distance, sphere_directions(5), size=100)]
    vertices, _ = extract_mesh(mixed, torch.zeros(3), 1.0, DRAFT)
    assert torus_error(vertices).max() < 1.0


@pytest.mark.slow
def test_the_same_depth_maps_give_the_same_bits(torus_views):
    first, second = (extract_mesh(torus_views, torch.zeros(3), 1.0, MeshSettings(resolution=48, face_limit=3000)) for _ in range(2))
    assert torch.equal(first[0], second[0]) and torch.equal(first[1], second[1])


def test_marched_faces_look_outward(torus_views):
    vertices, faces = march(fuse_depth(torus_views, torch.zeros(3), 1.0, MeshSettings(resolution=48)))
    assert mesh_report(vertices, faces).volume > 0


def test_bad_input_is_refused(torus_views):
    with pytest.raises(ValueError, match="no depth maps"):
        extract_mesh([], torch.zeros(3), 1.0, DRAFT)
    with pytest.raises(ValueError, match="no depth sample lies within 1 of"):
        extract_mesh(torus_views, torch.tensor([50.0, 0.0, 0.0]), 1.0, DRAFT)
