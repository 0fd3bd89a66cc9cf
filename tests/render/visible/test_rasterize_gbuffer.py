"""The G-buffer of surfels: maps do not depend on opacity, points lie on their rays, empty pixels say so."""

import math

import torch

from drgs.maths.constants import MIN_COVERAGE
from drgs.reference.rasterize_gbuffer import look_at_camera
from drgs.render.visible.rasterize import RasterSettings
from drgs.render.visible.rasterize.gbuffer import (
    LEAST_FACING,
    differentiable_gbuffer,
    face_camera,
    facing_normals,
    rasterize_gbuffer,
)
from drgs.render.visible.rasterize.near_plane import near_plane_of
from drgs.scene.camera import Camera, pixel_rays_world
from drgs.scene.gaussians import surfel_tangents
from drgs.scene.materials import Materials
from drgs.scene.posed_scene import PosedSurfels
from tests.reconstruct.surfel_spheres import surfel_sphere
from tests.render.closed_form_scenes import front_camera


def disc_before(camera: Camera, distances: list[float], opacities: list[float], albedos: list[tuple[float, float, float]], size=0.4):
    """Discs that face the camera, centred on its axis."""
    count = len(distances)
    right, down, forward = camera.camera_from_world[:3, :3]
    centers = camera.center_world + torch.tensor(distances)[:, None] * forward
    tangents = size * torch.stack([right, down], -1).expand(count, 3, 2).contiguous()
    roughness = torch.linspace(0.2, 0.8, count)
    return PosedSurfels(centers, tangents, torch.tensor(opacities), Materials(torch.tensor(albedos), roughness, 1 - roughness))


def sphere(opacity: float, device: str = "cpu") -> PosedSurfels:
    surfels = surfel_sphere(800)
    count = len(surfels.centers)
    materials = Materials(
        torch.tensor([0.7, 0.3, 0.2]).expand(count, 3).contiguous().to(device),
        torch.full((count,), 0.35, device=device),
        torch.full((count,), 0.9, device=device),
    )
    return PosedSurfels(
        surfels.centers.to(device), surfel_tangents(surfels).to(device), torch.full((count,), opacity, device=device), materials
    )


def test_a_uniform_material_is_the_same_however_transparent_the_surfels(device: str):
    camera = look_at_camera(48, 40, focal=60.0).to(device)
    for opacity in (0.03, 0.3, 0.99):
        gbuffer = rasterize_gbuffer(sphere(opacity, device), camera)
        covered = gbuffer.coverage >= MIN_COVERAGE
        count = int(covered.sum())
        assert count > 400
        expected = torch.tensor([0.7, 0.3, 0.2], device=device).expand(count, 3)
        torch.testing.assert_close(gbuffer.albedo[covered], expected, atol=2e-4, rtol=0)
        torch.testing.assert_close(gbuffer.roughness[covered], torch.full((count,), 0.35, device=device), atol=2e-4, rtol=0)
        torch.testing.assert_close(gbuffer.metallic[covered], torch.full((count,), 0.9, device=device), atol=2e-4, rtol=0)
        torch.testing.assert_close(gbuffer.normal_world[covered].norm(dim=-1), torch.ones(count, device=device))
    assert float(rasterize_gbuffer(sphere(0.3, device), camera).coverage.median()) < 0.9  # the surfels were see-through


def test_a_half_opaque_front_and_an_opaque_back_mix_by_their_weights():
    camera = front_camera(33)
    gbuffer = rasterize_gbuffer(disc_before(camera, [3.0, 5.0], [0.5, 0.98], [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0)]), camera)
    middle = (16, 16)
    weights = torch.tensor([0.5, 0.5 * 0.98])
    shares = weights / weights.sum()
    torch.testing.assert_close(gbuffer.coverage[middle], weights.sum(), atol=1e-4, rtol=0)
    torch.testing.assert_close(gbuffer.albedo[middle], torch.tensor([float(shares[0]), float(shares[1]), 0.0]), atol=1e-4, rtol=0)
    torch.testing.assert_close(gbuffer.roughness[middle], shares @ torch.tensor([0.2, 0.8]), atol=1e-4, rtol=0)
    torch.testing.assert_close(gbuffer.metallic[middle], shares @ torch.tensor([0.8, 0.2]), atol=1e-4, rtol=0)
    torch.testing.assert_close(gbuffer.depth[middle], shares @ torch.tensor([3.0, 5.0]), atol=1e-3, rtol=0)


def test_where_nothing_is_met_depth_is_infinite_and_the_rest_zero():
    camera = front_camera(32)
    gbuffer = rasterize_gbuffer(disc_before(camera, [4.0], [0.9], [(0.5, 0.5, 0.5)], size=0.1), camera)
    empty = gbuffer.coverage < MIN_COVERAGE
    assert 0 < int(empty.sum()) < empty.numel()
    assert torch.equal(torch.isinf(gbuffer.depth), empty)
    for name in ("albedo", "roughness", "metallic", "normal_world"):
        assert float(getattr(gbuffer, name)[empty].abs().max()) == 0.0, name
    assert bool(torch.isfinite(gbuffer.position_world).all())
    nothing = rasterize_gbuffer(disc_before(camera, [-4.0], [0.9], [(0.5, 0.5, 0.5)]), camera)  # behind the camera
    assert bool(torch.isinf(nothing.depth).all())


def test_points_lie_on_their_pixels_ray_at_the_depth_along_the_viewing_axis():
    camera = look_at_camera(48, 40, focal=60.0)
    gbuffer = rasterize_gbuffer(sphere(0.9), camera)
    covered = gbuffer.coverage > 0.5
    points = gbuffer.position_world[covered]
    in_camera = points @ camera.camera_from_world[:3, :3].T + camera.camera_from_world[:3, 3]
    torch.testing.assert_close(in_camera[:, 2], gbuffer.depth[covered], atol=1e-5, rtol=1e-5)
    pixel = in_camera @ camera.intrinsics.T
    y, x = covered.nonzero().unbind(-1)
    torch.testing.assert_close(pixel[:, :2] / pixel[:, 2:], torch.stack([x, y], -1) + 0.5, atol=1e-3, rtol=0)
    _, directions = pixel_rays_world(camera)
    torch.testing.assert_close(gbuffer.wo_world, -directions)
    # Discs touch the sphere from outside, on the side that faces the camera.
    assert float((points.norm(dim=-1) - 1).abs().max()) < 0.2
    assert float((points * gbuffer.wo_world[covered]).sum(-1).min()) > -0.3


def test_normals_face_the_camera_whichever_way_a_surfel_is_turned():
    camera = front_camera(33)
    surfels = disc_before(camera, [4.0], [0.9], [(0.5, 0.5, 0.5)])
    flipped = PosedSurfels(surfels.centers, surfels.tangents.flip(-1), surfels.opacities, surfels.materials)
    expected = -camera.camera_from_world[2, :3]
    for posed in (surfels, flipped):
        torch.testing.assert_close(rasterize_gbuffer(posed, camera).normal_world[16, 16], expected, atol=1e-5, rtol=0)


def test_only_surfels_clearly_seen_from_behind_are_turned_round():
    # On an outline half of a closed surface's normals tip away a little: turned one by one they would not average to the outline's own.
    camera = front_camera(33)
    right, forward = camera.camera_from_world[0, :3], camera.camera_from_world[2, :3]
    away = torch.tensor([-1.0, -0.1, 0.1, 0.9, 1.0])
    normals = away[:, None] * forward + (1 - away * away).sqrt()[:, None] * right
    centers = (camera.center_world + 4 * forward).expand(5, 3)
    signs = (facing_normals(normals, centers, camera) * normals).sum(-1)
    torch.testing.assert_close(signs, torch.tensor([1.0, 1.0, 1.0, -1.0, -1.0]))


def test_blended_normals_are_bent_towards_the_camera_only_where_they_look_away():
    wo = torch.nn.functional.normalize(torch.randn(500, 3), dim=-1)
    normals = torch.randn(500, 3)
    bent = face_camera(normals, wo)
    unit = torch.nn.functional.normalize(normals, dim=-1)
    torch.testing.assert_close(bent.norm(dim=-1), torch.ones(500))
    cosine = (unit * wo).sum(-1)
    looks = cosine >= LEAST_FACING
    torch.testing.assert_close(bent[looks], unit[looks], atol=1e-6, rtol=0)
    lifted = (bent * wo).sum(-1)[~looks & (cosine > -0.99)]
    assert len(lifted) > 100 and float(lifted.min()) >= LEAST_FACING - 1e-5
    # Bent within the plane of normal and wo, no further round than needed.
    beside = torch.linalg.cross(unit, wo)
    assert float((bent * beside).sum(-1).abs().max()) < 1e-5


def test_sheared_surfels_have_the_normal_of_their_plane():
    # After a deformation tangents are neither orthogonal nor of their old length.
    camera = front_camera(33)
    right, down, forward = camera.camera_from_world[:3, :3]
    plane = torch.nn.functional.normalize(-forward + 0.5 * right, dim=0)
    across = torch.nn.functional.normalize(torch.linalg.cross(plane, down), dim=0)
    along = torch.linalg.cross(plane, across)
    tangents = torch.stack([0.5 * across, 0.2 * along + 0.4 * across], -1)[None]
    center = (camera.center_world + 4 * forward)[None]
    surfels = PosedSurfels(center, tangents, torch.tensor([0.9]), Materials(torch.ones(1, 3), torch.ones(1), torch.ones(1)))
    torch.testing.assert_close(rasterize_gbuffer(surfels, camera).normal_world[16, 16], plane, atol=1e-5, rtol=0)


def test_gradients_reach_materials_and_geometry():
    camera = front_camera(24)
    surfels = disc_before(camera, [4.0, 4.5], [0.6, 0.9], [(0.9, 0.2, 0.1), (0.1, 0.8, 0.3)])
    centers, tangents, opacities = (x.clone().requires_grad_(True) for x in (surfels.centers, surfels.tangents, surfels.opacities))
    albedo = surfels.materials.albedo.clone().requires_grad_(True)
    materials = Materials(albedo, surfels.materials.roughness, surfels.materials.metallic)
    gbuffer = rasterize_gbuffer(PosedSurfels(centers, tangents, opacities, materials), camera)
    loss = gbuffer.albedo.square().sum() + gbuffer.normal_world.sum() + gbuffer.depth[gbuffer.coverage > 0.5].sum()
    loss.backward()
    for leaf in (centers, tangents, opacities, albedo):
        assert bool(torch.isfinite(leaf.grad).all()) and float(leaf.grad.abs().max()) > 0


def test_nothing_nearer_than_the_near_plane_is_drawn():
    camera = front_camera(16)
    surfels = disc_before(camera, [1.0, 4.0], [0.9, 0.9], [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0)])
    gbuffer = rasterize_gbuffer(surfels, camera, RasterSettings(near=2.0))
    torch.testing.assert_close(gbuffer.albedo[8, 8], torch.tensor([0.0, 1.0, 0.0]), atol=1e-5, rtol=0)
    assert math.isclose(float(gbuffer.depth[8, 8]), 4.0, rel_tol=1e-4)


def scattered_surfels(count: int, device: str) -> PosedSurfels:
    """Of any size, shape, transparency and facing, around the origin."""
    centers, tangents = 0.5 * torch.randn(count, 3), 0.1 * torch.randn(count, 3, 2)
    # A little outside 0..1, where edits leave values that the maps must not show.
    materials = Materials(torch.rand(count, 3) * 1.2 - 0.1, torch.rand(count) * 1.2 - 0.1, torch.rand(count) * 1.2 - 0.1)
    materials = Materials(*(values.to(device) for values in vars(materials).values()))
    return PosedSurfels(centers.to(device), tangents.to(device), torch.rand(count).to(device), materials)


def seen_in_part_and_nowhere(device: str) -> dict[str, tuple[PosedSurfels, Camera]]:
    camera = look_at_camera(53, 39, focal=60.0).to(device)  # neither side a multiple of the tile's
    none = scattered_surfels(0, device)
    away = scattered_surfels(20, device)
    behind = PosedSurfels(away.centers + 100 * camera.center_world, away.tangents, away.opacities, away.materials)
    return {
        "partial cover, backs and fronts": (scattered_surfels(300, device), camera),
        "a few surfels in a corner of the picture": (scattered_surfels(5, device), look_at_camera(160, 128, focal=60.0).to(device)),
        "closed and opaque": (sphere(0.9, device), look_at_camera(48, 32, focal=60.0).to(device)),
        "behind the camera": (behind, camera),
        "no surfels": (none, camera),
    }


def test_kernels_write_the_maps_that_torch_writes(device: str):
    # Sums of up to hundreds of float32 terms differ in nothing: the blending is the same. What is left is a few roundings a pixel, grown by
    # the division where coverage, and by normalising where the blended normal, is small.
    for name, (surfels, camera) in seen_in_part_and_nowhere(device).items():
        kernels = rasterize_gbuffer(surfels, camera)
        by_torch = differentiable_gbuffer(surfels, camera, RasterSettings(near=near_plane_of(surfels.centers)))
        covered = by_torch.coverage >= MIN_COVERAGE
        assert bool(covered.any()) == (name not in ("behind the camera", "no surfels")), name
        for field in vars(kernels):
            mine, twin = getattr(kernels, field), getattr(by_torch, field)
            torch.testing.assert_close(mine, twin, atol=2e-5, rtol=1e-5, msg=lambda text, at=(name, field): f"{at}: {text}")
            if field not in ("coverage", "wo_world"):
                assert torch.equal(mine[~covered], torch.full_like(mine[~covered], torch.inf if field == "depth" else 0.0)), (name, field)


def test_maps_carry_gradients_only_where_they_are_asked_for():
    camera = front_camera(24)
    surfels = disc_before(camera, [4.0], [0.6], [(0.9, 0.2, 0.1)])
    surfels.materials.roughness.requires_grad_(True)
    assert rasterize_gbuffer(surfels, camera).roughness.requires_grad
    with torch.no_grad():
        assert not rasterize_gbuffer(surfels, camera).roughness.requires_grad
    surfels.materials.roughness.requires_grad_(False)
    assert not rasterize_gbuffer(surfels, camera).roughness.requires_grad
