"""The other systems' ways: rigid motion leaves every picture as it was, and each has the property that its paper claims."""

import math
from dataclasses import replace
from functools import cache

import pytest
import torch
import trimesh
from torch import Tensor

from benchmarks.paper.face_splats import THIRDS, areas, edge_frames, splats_on_faces
from benchmarks.paper.fields import at_rest, field_of_map, field_of_moved_mesh, rigid_field
from benchmarks.paper.harmonics import BakeSettings, bake_harmonics, even_colors, harmonic_colors
from benchmarks.paper.splats import covariances, directions_at_rest, draw, moved_splats
from benchmarks.paper.variant import Bound, FaceAnchors, Subject, bound_of_tensors, own_gaussians
from benchmarks.paper.variants import VARIANTS
from benchmarks.paper.variants.gaussian_mesh import drive_by_corners, split
from benchmarks.paper.variants.gsp import shortest_axes
from benchmarks.paper.variants.mani_gs import drive_in_frames, frame_lengths
from benchmarks.paper.variants.ours import OursVariant
from benchmarks.paper.variants.physgaussian import drive_particles
from benchmarks.paper.variants.sugar import drive_with_faces
from drgs.deform.carry.gmls import polar_rotation
from drgs.maths.constants import MIN_ALPHA
from drgs.maths.spherical_harmonics import rotate_sh, sh_basis
from drgs.reconstruct.geometry.face_surfels import surfels_on_faces_of
from drgs.scene.asset import Asset
from drgs.scene.camera import Camera
from drgs.scene.environment import Environment, rotate_environment
from drgs.scene.views import Views
from tests.render.closed_form_scenes import front_camera, mesh_of

SPLAT_WAYS = [name for name, variant in VARIANTS.items() if not isinstance(variant, OursVariant)]
SIZE = 32


def turned_camera(camera: Camera, rotation: Tensor, shift: Tensor) -> Camera:
    """The camera that sees of the moved world what this one saw."""
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, :3], motion[:3, 3] = rotation, shift
    moved = (camera.camera_from_world.double() @ torch.linalg.inv(motion)).float()
    return Camera(moved, camera.intrinsics, camera.width, camera.height, camera.name)


def rotation_about(axis: tuple[float, float, float], degrees: float) -> Tensor:
    direction = torch.nn.functional.normalize(torch.tensor(axis, dtype=torch.float64), dim=0)
    cross = torch.linalg.cross(direction.expand(3, 3), torch.eye(3, dtype=torch.float64)).T
    return torch.matrix_exp(math.radians(degrees) * cross).float()


UPRIGHT = rotation_about((0, 0, 1), 45)
SHIFT = torch.tensor([0.3, -0.2, 0.1])
CAMERAS = tuple(turned_camera(front_camera(SIZE), rotation_about((0.2 * k, 0.1, 1), 36 * k), torch.zeros(3)) for k in range(10))


@cache
def subject() -> Subject:
    """A bumpy shiny ball of 320 faces in a sky with a bright side, and photographs that are no more than stripes."""
    shape = trimesh.creation.icosphere(2, 0.8)
    numbers = torch.Generator().manual_seed(1)
    shape.vertices *= (1 + 0.08 * torch.rand(len(shape.vertices), 1, generator=numbers)).numpy()
    mesh = replace(mesh_of(shape, 0.6, 0.3, 0.5), albedo=torch.rand(len(shape.vertices), 3, generator=numbers))
    sky = torch.ones(128, 256, 3)
    sky[30:60, 40:80] = 6.0
    gaussians, binding = surfels_on_faces_of(mesh)
    stripes = (torch.arange(SIZE) * 8)[:, None, None].expand(SIZE, SIZE, 3).to(torch.uint8).contiguous()
    images = tuple(stripes if k % 2 else stripes.transpose(0, 1).contiguous() for k in range(len(CAMERAS)))
    coverage = (torch.full((SIZE, SIZE), 255, dtype=torch.uint8),) * len(CAMERAS)
    views = Views(CAMERAS, images, coverage, None, None, True, "test")
    return Subject(Asset(gaussians, mesh, binding, Environment(sky), primary="mesh"), views, 240, BakeSettings(rounds=1), 8)


@cache
def bound(name: str) -> dict[str, Tensor]:
    return VARIANTS[name].bind(subject())


def pictures(name: str, field, light, cameras=CAMERAS[:2]) -> list[Tensor]:
    drawn = VARIANTS[name].pose(subject(), bound(name), field, light)
    return [drawn(camera) for camera in cameras]


@pytest.mark.parametrize("name", SPLAT_WAYS)
def test_rigid_motion_with_camera_and_light_leaves_the_picture_as_it_was(name: str):
    light = rotate_environment(subject().asset.environment, 45)  # 32 texels: exact
    before = pictures(name, at_rest, None)
    cameras = [turned_camera(camera, UPRIGHT, SHIFT) for camera in CAMERAS[:2]]
    after = pictures(name, rigid_field(UPRIGHT, SHIFT), light, cameras)
    for a, b in zip(before, after, strict=True):
        assert a[..., 3].max() > 0.9 and a[..., :3].std() > 0.02, "there is something to see"
        difference = (a - b).abs().amax(-1)
        assert difference.median() < 1e-5 and difference.mean() < 2e-5
        assert difference.max() < MIN_ALPHA, "where rounding decides, a Gaussian at the least opacity is drawn or not"


def test_points_near_a_mesh_follow_it_as_one_when_it_moves_rigidly():
    rest, points = subject().asset.mesh, bound("gsp")["centers"] * 1.05
    rigid = rigid_field(UPRIGHT, SHIFT)
    places, gradients = field_of_moved_mesh(rest, rigid(rest.vertices)[0])(points)
    wanted, turn = rigid(points)
    assert torch.allclose(places, wanted, atol=1e-5) and torch.allclose(gradients, turn, atol=1e-4)


@pytest.mark.parametrize("name", ["ours_particles", "ours_mesh", "ours_gaussians"])
def test_rigid_motion_moves_our_surfaces_as_one(name: str):
    """Pictures are of random rays; what they start from and what they meet is compared."""
    variant = VARIANTS[name]
    assert isinstance(variant, OursVariant)
    turn = rotation_about((1, 2, 3), 70)
    rest, moved = (variant.scene(subject(), bound(name), field, None) for field in (at_rest, rigid_field(turn, SHIFT)))
    assert torch.allclose(moved.mesh.vertices, rest.mesh.vertices @ turn.T + SHIFT, atol=2e-6)
    assert torch.allclose(moved.mesh.normals, rest.mesh.normals @ turn.T, atol=2e-5)
    assert moved.surfels is not None and rest.surfels is not None
    assert torch.allclose(moved.surfels.centers, rest.surfels.centers @ turn.T + SHIFT, atol=2e-6)
    assert torch.allclose(moved.surfels.tangents, turn @ rest.surfels.tangents, atol=2e-6)


def test_a_rigidly_moved_object_is_the_same_traced_picture_up_to_noise():
    light = rotate_environment(subject().asset.environment, 45)
    many = replace(subject(), samples_per_pixel=256)
    variant = VARIANTS["ours_particles"]
    before = variant.pose(many, bound("ours_particles"), at_rest, None)(CAMERAS[0])
    camera = turned_camera(CAMERAS[0], UPRIGHT, SHIFT)
    after = variant.pose(many, bound("ours_particles"), rigid_field(UPRIGHT, SHIFT), light)(camera)
    assert (before - after).abs().mean() < 0.01


def test_physgaussians_covariance_is_f_sigma_f_transposed():
    rest = own_gaussians(subject())
    field = field_of_map({"type": "twist", "rate": 0.8})
    centers, gradient = field(rest.splats.centers)
    moved = drive_particles(rest, field)
    assert torch.equal(moved.centers, centers)
    assert torch.allclose(covariances(moved), gradient @ covariances(rest.splats) @ gradient.mT, atol=1e-7)
    assert torch.allclose(moved.turn, polar_rotation(gradient), atol=1e-6)


def test_baked_harmonics_turn_as_turned_coefficients_do():
    """Looking from R^T d is the same as coefficients that Wigner's matrices turned by R."""
    turn = rotation_about((1, -2, 0.5), 110)
    rest = own_gaussians(subject()).splats
    sh = torch.randn(len(rest.centers), 16, 3, generator=torch.Generator().manual_seed(2))
    moved = moved_splats(rest, rest.centers @ turn.T, turn.expand(len(rest.centers), 3, 3))
    ours = harmonic_colors(sh, moved, CAMERAS[3], even_colors(moved))
    towards = torch.nn.functional.normalize(moved.centers - CAMERAS[3].center_world, dim=-1)
    turned = (sh_basis(towards)[..., None] * rotate_sh(sh, turn)).sum(1) + 0.5
    assert torch.allclose(ours, turned.clamp(min=0), atol=1e-4)


def test_harmonics_fitted_to_drawn_pictures_draw_them_again():
    rest = own_gaussians(subject()).splats
    sh = 0.15 * torch.randn(len(rest.centers), 16, 3, generator=torch.Generator().manual_seed(3))
    truth = [draw(rest, harmonic_colors(sh, rest, camera, even_colors(rest)), camera) for camera in CAMERAS]
    images = tuple((rgba[..., :3] * 255).round().to(torch.uint8) for rgba in truth)
    coverage = tuple((rgba[..., 3] * 255).round().to(torch.uint8) for rgba in truth)
    views = replace(subject().views, images_srgb=images, coverage=coverage)

    def error(rounds: int) -> float:
        found = bake_harmonics(views, rest, even_colors(rest), BakeSettings(rounds=rounds))
        again = [draw(rest, harmonic_colors(found, rest, camera, even_colors(rest)), camera) for camera in CAMERAS]
        return float(torch.stack([((a - b)[..., :3] * b[..., 3:]).abs().mean() for a, b in zip(again, truth, strict=True)]).mean())

    one, several = error(0), error(6)
    assert several < 0.6 * one and several < 0.01


def test_gaussians_that_no_photograph_shows_stay_as_shaded():
    rest = own_gaussians(subject()).splats
    views = replace(subject().views, coverage=tuple(torch.zeros_like(mask) for mask in subject().views.coverage))
    sh = bake_harmonics(views, rest, even_colors(rest), BakeSettings(rounds=1))
    assert not sh.any()


def test_the_shortest_axis_is_the_eigenvector_of_the_least_eigenvalue():
    moved = drive_particles(own_gaussians(subject()), field_of_map({"type": "bend", "curvature": 0.4}))
    least = torch.linalg.eigh(covariances(moved).double()).eigenvectors[..., 0].float()
    assert ((least * shortest_axes(moved)).sum(-1).abs() > 1 - 1e-5).all()


def one_triangle(offset: float = 0.0) -> Bound:
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0.2, 0.9, 0]])
    shape = trimesh.Trimesh(vertices.numpy(), [[0, 1, 2]], process=False)
    mesh = mesh_of(shape, 0.5, 0.5, 0.0)
    made = splats_on_faces(mesh, THIRDS)
    anchors = made.anchors
    assert anchors is not None
    lifted = replace(made.splats, centers=made.splats.centers + torch.tensor([0, 0, offset]))
    return Bound(lifted, FaceAnchors(anchors.vertices, anchors.faces, anchors.face, anchors.barycentric, torch.full((3,), offset)))


@pytest.mark.parametrize("drive", [drive_in_frames, drive_by_corners], ids=["mani_gs", "gaussian_mesh"])
def test_frames_scale_with_the_triangle_and_offsets_along_them(drive):
    rest = one_triangle(0.1)

    def doubled(points: Tensor) -> tuple[Tensor, Tensor]:
        return 2 * points, 2 * torch.eye(3).expand(len(points), 3, 3)

    moved = drive(rest, doubled)
    assert torch.allclose(moved.centers, 2 * rest.splats.centers, atol=1e-5)
    assert torch.allclose(covariances(moved), 4 * covariances(rest.splats), atol=1e-5)


def test_mani_gs_frames_know_along_which_edge_a_triangle_grew():
    rest = one_triangle()
    assert rest.anchors is not None

    def longer(points: Tensor) -> tuple[Tensor, Tensor]:
        stretch = torch.diag(torch.tensor([3.0, 1.0, 1.0]))
        return points @ stretch, stretch.expand(len(points), 3, 3)

    grown = frame_lengths(rest.anchors.corners(longer(rest.anchors.vertices)[0])) / frame_lengths(
        rest.anchors.corners(rest.anchors.vertices)
    )
    assert torch.allclose(grown[:, 0], torch.full((3,), 3.0)) and (grown[:, 1] < 2.5).all()
    moved = drive_in_frames(rest, longer)
    along = moved.tangents[:, 0].norm(dim=-1) / rest.splats.tangents[:, 0].norm(dim=-1)
    across = moved.tangents[:, 1].norm(dim=-1) / rest.splats.tangents[:, 1].norm(dim=-1)
    assert (along > across).all()


def test_sugars_gaussians_stay_in_their_faces_and_keep_their_share_of_them():
    rest = one_triangle()
    assert rest.anchors is not None
    field = field_of_map({"type": "bend", "curvature": 0.5})
    moved = drive_with_faces(rest, field)
    now = rest.anchors.corners(field(rest.anchors.vertices)[0])
    normal = edge_frames(now)[:, :, 2]
    assert ((moved.centers - now[:, 0]) * normal).sum(-1).abs().max() < 1e-6
    assert (normal[:, None] @ moved.tangents).abs().max() < 1e-6
    spans = [torch.linalg.cross(splats.tangents[..., 0], splats.tangents[..., 1]).norm(dim=-1) for splats in (rest.splats, moved)]
    assert torch.allclose(spans[1] / areas(now), spans[0] / areas(rest.anchors.corners(rest.anchors.vertices)), rtol=1e-4)


def test_a_split_face_has_four_gaussians_that_cover_as_much():
    rest = one_triangle(0.1)
    chosen = torch.tensor([True, False, False])
    after = split(rest, chosen)
    assert len(after.splats.centers) == 6 and after.anchors is not None
    assert torch.allclose(after.splats.centers[2:, 2], torch.full((4,), 0.1))
    assert torch.allclose(after.anchors.barycentric[2:].mean(0), torch.full((3,), 1 / 3))
    area = torch.linalg.cross(after.splats.tangents[..., 0], after.splats.tangents[..., 1]).norm(dim=-1)
    whole = torch.linalg.cross(rest.splats.tangents[..., 0], rest.splats.tangents[..., 1]).norm(dim=-1)
    assert torch.allclose(area[2:].sum(), whole[0])


@pytest.mark.parametrize("name", SPLAT_WAYS)
def test_what_a_file_keeps_is_all_that_posing_needs(name: str):
    kept = {key: value.clone() for key, value in bound(name).items()}
    again = bound_of_tensors(kept)
    assert torch.equal(again.splats.centers, kept["centers"]) and (again.anchors is None) == (name in ("physgaussian", "gsp"))
    assert len(kept["sh"]) == len(kept["centers"])


def test_only_ways_that_say_so_see_another_light():
    other = Environment(torch.full((64, 128, 3), 0.3))
    for name in SPLAT_WAYS:
        same, under_other = (pictures(name, at_rest, light, CAMERAS[:1])[0] for light in (None, other))
        assert torch.equal(same, under_other) != VARIANTS[name].relights


def test_directions_at_rest_undo_the_turn():
    turn = rotation_about((0, 1, 1), 33)
    rest = own_gaussians(subject()).splats
    moved = moved_splats(rest, rest.centers @ turn.T + SHIFT, turn.expand(len(rest.centers), 3, 3))
    before, after = directions_at_rest(rest, CAMERAS[1]), directions_at_rest(moved, turned_camera(CAMERAS[1], turn, SHIFT))
    assert torch.allclose(before, after, atol=1e-5)
