"""Interpolation from particles: what must be reproduced exactly, and what must not break."""

import math

import pytest
import torch

from drgs.deform.carry.gmls import GmlsSettings, build_weights, interpolate
from drgs.maths.frames import rotation_from_quat_wxyz
from drgs.reference import gmls as reference

SPACING = 0.1


def cloud(offset=0.0, seed=0):
    """Jittered lattice of particles in [-0.5, 0.5]^3 and points well among them, both moved by `offset` along (1, -1, 1)."""
    random = torch.Generator().manual_seed(seed)
    steps = torch.arange(-5, 6) * SPACING
    lattice = torch.stack(torch.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3)
    particles = lattice + 0.2 * SPACING * (2 * torch.rand(lattice.shape, generator=random) - 1)
    points = 0.7 * (torch.rand(200, 3, generator=random) - 0.5)
    shift = offset * torch.tensor([1.0, -1.0, 1.0])
    return particles + shift, points + shift


def quadratic(points, center):
    """A quadratic map about `center`, and its gradient, in float64."""
    d = points.double() - center
    x, y, z = d.unbind(-1)
    moved = torch.stack([x + 0.3 * x * y - 0.2 * z * z, 0.9 * y + 0.2 * x * x + 0.1 * y * z, 1.1 * z - 0.3 * x * z + 0.2 * y * y], -1)
    one = torch.ones_like(x)
    rows = [
        [1 + 0.3 * y, 0.3 * x, -0.4 * z],
        [0.4 * x, 0.9 + 0.1 * z, 0.1 * y],
        [-0.3 * z, 0.4 * y, 1.1 - 0.3 * x],
    ]
    return moved + center, torch.stack([torch.stack([one * v for v in row], -1) for row in rows], -2)


def carried(particles, points, transform, **settings):
    moved, gradient = transform(particles)
    return interpolate(build_weights(particles, points, GmlsSettings(**settings)), moved.float(), gradient.float())


def rigid(center):
    turn = rotation_from_quat_wxyz(torch.tensor([0.3, -0.5, 0.2, 0.8])).double()
    return lambda p: ((p.double() - center) @ turn.T + center + torch.tensor([0.4, 0.2, -0.3]), turn.expand(len(p), 3, 3))


def affine(center):
    matrix = torch.tensor([[1.2, 0.3, -0.1], [0.1, 0.8, 0.2], [-0.2, 0.1, 1.1]], dtype=torch.float64)
    return lambda p: ((p.double() - center) @ matrix.T + center, matrix.expand(len(p), 3, 3))


@pytest.mark.parametrize("offset", [0.0, 1.28, 12.8, 100.0])
@pytest.mark.parametrize("kind", ["rigid", "affine", "quadratic"])
def test_rigid_affine_and_quadratic_motions_are_reproduced_far_from_the_origin_too(kind, offset):
    particles, points = cloud(offset)
    center = offset * torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)
    transform = {"rigid": rigid(center), "affine": affine(center), "quadratic": lambda p: quadratic(p, center)}[kind]
    position, gradient = carried(particles, points, transform)
    expected, expected_gradient = transform(points)
    h = 1.5 * SPACING
    assert float((position.double() - expected).norm(dim=-1).max()) < 5e-7 * (1 + math.sqrt(3) * offset) + 5e-6 * h
    assert float((gradient.double() - expected_gradient).abs().max()) < 1e-5


def test_the_kernel_agrees_with_the_float64_twin_on_a_map_that_no_polynomial_gives():
    particles, points = cloud()

    def wave(p):
        x, y, z = p.double().unbind(-1)
        moved = torch.stack([x + 0.1 * torch.sin(4 * z), y + 0.1 * torch.cos(3 * x), z + 0.05 * torch.sin(5 * y)], -1)
        zero, one = torch.zeros_like(x), torch.ones_like(x)
        rows = [[one, zero, 0.4 * torch.cos(4 * z)], [-0.3 * torch.sin(3 * x), one, zero], [zero, 0.25 * torch.cos(5 * y), one]]
        return moved, torch.stack([torch.stack(row, -1) for row in rows], -2)

    position, gradient = carried(particles, points, wave)
    moved, gradients = wave(particles)
    twin = reference.interpolate(particles.double(), points.double(), moved, gradients)
    assert torch.allclose(position.double(), twin[0], atol=2e-7) and torch.allclose(gradient.double(), twin[1], atol=2e-6)


def test_the_error_on_a_bend_is_of_third_order_and_below_that_of_plain_averages():
    def bend(p):
        k, (x, y, z) = 0.8, p.double().unbind(-1)
        a, r = k * z, 1 / k - x
        zero, one = torch.zeros_like(x), torch.ones_like(x)
        gradient = [[torch.cos(a), zero, k * r * torch.sin(a)], [zero, one, zero], [-torch.sin(a), zero, k * r * torch.cos(a)]]
        return torch.stack([1 / k - r * torch.cos(a), y, r * torch.sin(a)], -1), torch.stack([torch.stack(g, -1) for g in gradient], -2)

    errors = []
    for size in (1.0, 0.5):
        particles, points = (size * values for values in cloud())
        moved, gradients = bend(particles)
        found, _ = reference.interpolate(particles.double(), points.double(), moved, gradients)
        errors.append(float((found - bend(points)[0]).norm(dim=-1).max()))
    assert errors[0] / errors[1] > 6  # 8 at third order, 4 at second
    paper, _ = carried(*cloud(), bend, variant="paper_centred")
    assert float((paper.double() - bend(cloud()[1])[0]).norm(dim=-1).max()) > 5 * errors[0]


@pytest.mark.parametrize("shape", ["coplanar", "collinear", "single", "pair"])
@pytest.mark.parametrize("offset", [0.0, 1000.0])
def test_degenerate_neighbourhoods_still_carry_affine_motions_exactly(shape, offset):
    steps = torch.linspace(-0.5, 0.5, 8)
    flat = torch.stack(torch.meshgrid(steps, steps, torch.zeros(1), indexing="ij"), -1).reshape(-1, 3)
    line = torch.stack([steps, 0.5 * steps, torch.zeros(8)], -1)
    particles = {"coplanar": flat, "collinear": line, "single": torch.zeros(1, 3), "pair": line[:2]}[shape] + offset * SPACING
    points = torch.tensor([[0.1, 0.05, 0.0], [0.2, -0.1, 0.08], [-0.3, 0.2, -0.2], [0.0, 0.0, 0.0]]) + offset * SPACING
    center = torch.full((3,), offset * SPACING, dtype=torch.float64)
    for transform in (affine(center), rigid(center)):
        position, gradient = carried(particles, points, transform)
        expected, expected_gradient = transform(points)
        assert float((position.double() - expected).abs().max()) < 2e-6 + 3e-7 * offset * SPACING
        assert torch.allclose(gradient.double(), expected_gradient, atol=1e-5)


def test_coincident_particles_and_points_on_particles_are_carried():
    particles = torch.cat([cloud()[0], cloud()[0][:50]])
    transform = affine(torch.zeros(3, dtype=torch.float64))
    position, _ = carried(particles, particles[:60].clone(), transform)
    assert torch.allclose(position.double(), transform(particles[:60])[0], atol=2e-6)
    same = torch.zeros(20, 3)
    position, gradient = carried(same, torch.zeros(2, 3), transform)
    assert torch.isfinite(position).all() and torch.allclose(gradient.double(), transform(same)[1][:2], atol=1e-5)


def test_the_weights_sum_to_one_and_do_not_depend_on_order_or_batch():
    particles, points = cloud()
    weights = build_weights(particles, points)
    assert torch.allclose(weights.psi.double().sum(1), torch.ones(len(points), dtype=torch.float64), atol=1e-6)
    moved, gradient = quadratic(particles, torch.zeros(3, dtype=torch.float64))
    whole = interpolate(weights, moved.float(), gradient.float())[0]
    part = interpolate(build_weights(particles, points[50:60]), moved.float(), gradient.float())[0]
    assert torch.equal(part, whole[50:60])
    order = torch.randperm(len(particles), generator=torch.Generator().manual_seed(2))
    shuffled = interpolate(build_weights(particles[order], points), moved[order].float(), gradient[order].float())[0]
    assert torch.allclose(shuffled, whole, atol=3e-7)


def test_points_far_from_all_particles_turn_rigidly_with_the_nearest():
    particles, points = cloud()
    far = torch.tensor([[2.0, 0.0, 0.0]])
    moved, gradient = affine(torch.zeros(3, dtype=torch.float64))(particles)
    weights = build_weights(particles, torch.cat([points, far]), GmlsSettings(isolated=3 * SPACING))
    assert weights.rigid.tolist() == [False] * len(points) + [True]
    position, found = interpolate(weights, moved.float(), gradient.float())
    assert torch.allclose(found[-1] @ found[-1].T, torch.eye(3), atol=1e-5)
    nearest = int((particles - far).norm(dim=-1).argmin())
    assert math.isclose(float((position[-1] - moved[nearest].float()).norm()), float((far - particles[nearest]).norm()), rel_tol=1e-5)


def test_points_a_little_outside_a_thin_plate_get_tame_weights():
    steps = torch.arange(-5, 6) * SPACING
    plate = torch.stack(torch.meshgrid(steps, steps, torch.tensor([0.0, 1e-3]), indexing="ij"), -1).reshape(-1, 3)
    above = torch.tensor([[0.03, 0.02, 0.12], [0.5, 0.5, 0.05]])
    weights = build_weights(plate, above)
    assert float(weights.psi.abs().sum(1).max()) <= 4.0
    moved, gradient = affine(torch.zeros(3, dtype=torch.float64))(plate)
    assert torch.allclose(interpolate(weights, moved.float(), gradient.float())[0].double(), affine(0)(above)[0], atol=2e-6)


def test_gradients_that_would_fold_a_point_fall_back_to_a_rotation():
    particles, points = cloud()
    mirror = torch.diag(torch.tensor([1.0, 1.0, -1.0])).expand(len(particles), 3, 3).clone()
    position, gradient = interpolate(build_weights(particles, points), particles * torch.tensor([1.0, 1, -1]), mirror)
    assert torch.isfinite(position).all() and torch.allclose(torch.linalg.det(gradient), torch.ones(len(points)), atol=1e-4)


def test_motion_does_not_leak_across_a_gap_between_two_parts():
    import trimesh

    left, right = (trimesh.creation.box((0.4, 1.0, 1.0), trimesh.transformations.translation_matrix([x, 0, 0])) for x in (-0.21, 0.21))
    both = trimesh.util.concatenate([left, right])
    solid = torch.tensor(both.vertices, dtype=torch.float32), torch.tensor(both.faces, dtype=torch.int32)
    steps = torch.arange(0.05, 1.0, 0.1) - 0.5
    inner = torch.stack(torch.meshgrid(torch.tensor([0.05, 0.15, 0.25, 0.35]), steps, steps, indexing="ij"), -1).reshape(-1, 3)
    inner[:, 0] += 0.01
    particles = torch.cat([inner, inner * torch.tensor([-1.0, 1, 1])])
    points = torch.tensor([[0.0101, 0.0, 0.0], [-0.0099, 0.1, 0.2], [0.005, 0.0, 0.3]])
    moved = particles + torch.where(particles[:, :1] > 0, 1.0, -1.0) * torch.tensor([0.5, 0, 0])
    gradient = torch.eye(3).expand(len(particles), 3, 3)
    guarded = interpolate(build_weights(particles, points, solid=solid), moved, gradient)[0]
    assert torch.allclose(guarded - points, torch.tensor([[0.5, 0, 0], [-0.5, 0, 0], [0.5, 0, 0]]), atol=1e-5)
    loose = interpolate(build_weights(particles, points), moved, gradient)[0]
    assert float(((loose - points)[:, 0].abs() - 0.5).abs().max()) > 0.1


def test_the_papers_interpolation_fails_away_from_the_origin_where_ours_does_not():
    for offset, bound in ((1.28, 1.0), (12.8, 10.0)):
        particles, points = cloud(offset)
        center = offset * torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)
        expected = rigid(center)(points)[0]
        error = {
            variant: float((carried(particles, points, rigid(center), variant=variant)[0].double() - expected).norm(dim=-1).max())
            for variant in ("taylor", "paper_centred", "paper")
        }
        assert max(error["taylor"], error["paper_centred"]) < 2e-5 and error["paper"] > bound, (offset, error)


def test_no_particles_are_refused():
    with pytest.raises(ValueError, match="no particles"):
        build_weights(torch.zeros(0, 3), torch.zeros(1, 3))
