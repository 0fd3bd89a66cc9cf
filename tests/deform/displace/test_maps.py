import math

import pytest
import torch

from drgs.deform.displace.maps import check_map, evaluate_map
from drgs.scene.edits import BendMap, LatticeMap, StretchMap, TwistMap


def lattice(shape, move=lambda p: p, low=(-1.0, -1.0, -1.0), high=(1.0, 1.0, 1.5)):
    def at(index, count, axis):
        return low[axis] + (high[axis] - low[axis]) * index / (count - 1)

    points = [[[tuple(move([at(i, shape[0], 0), at(j, shape[1], 1), at(k, shape[2], 2)])) for k in range(shape[2])] for j in range(shape[1])]
              for i in range(shape[0])]  # fmt: skip
    return LatticeMap(type="lattice", minimum=low, maximum=high, control_points=points)


def wobble(p):
    return [p[0] + 0.3 * math.sin(3 * p[2]), p[1] * (1 + 0.2 * p[0]), p[2] + 0.4 * p[0] * p[1]]


MAPS = {
    "twist": TwistMap(type="twist", rate=0.6),
    "bend": BendMap(type="bend", curvature=0.5),
    "bend back": BendMap(type="bend", curvature=-0.7),
    "barely bend": BendMap(type="bend", curvature=1e-9),
    "stretch": StretchMap(type="stretch", factor=1.7),
    "lattice": lattice((3, 2, 4), wobble),
}


def points(count=40, dtype=torch.float64):
    return torch.rand(count, 3, dtype=dtype, generator=torch.Generator().manual_seed(0)) * 1.6 - 0.8


@pytest.mark.parametrize("name", MAPS)
def test_the_gradient_is_the_derivative_of_the_map(name):
    x, step = points(), 1e-6
    _, gradient = evaluate_map(MAPS[name], x)
    for axis in range(3):
        shift = torch.zeros(3, dtype=torch.float64)
        shift[axis] = step
        difference = (evaluate_map(MAPS[name], x + shift)[0] - evaluate_map(MAPS[name], x - shift)[0]) / (2 * step)
        assert torch.allclose(gradient[..., axis], difference, atol=1e-8)


def test_twist_turns_about_z_by_rate_times_height():
    moved, gradient = evaluate_map(TwistMap(type="twist", rate=2.0), torch.tensor([[1.0, 0.0, math.pi / 4]], dtype=torch.float64))
    assert torch.allclose(moved, torch.tensor([[0.0, 1.0, math.pi / 4]], dtype=torch.float64))
    assert torch.allclose(torch.linalg.det(gradient), torch.ones(1, dtype=torch.float64))


def test_bend_follows_the_published_formula_and_its_volume_ratio():
    x, k = points(), 0.5
    moved, gradient = evaluate_map(BendMap(type="bend", curvature=k), x)
    radius, phi = 1 / k - x[:, 0], k * x[:, 2]
    expected = torch.stack([1 / k - radius * torch.cos(phi), x[:, 1], radius * torch.sin(phi)], -1)
    assert torch.allclose(moved, expected, atol=1e-14)
    assert torch.allclose(torch.linalg.det(gradient), 1 - k * x[:, 0])


@pytest.mark.parametrize("curvature", [0.0, 1e-30, -1e-12, 1e-7])
def test_a_vanishing_bend_is_the_identity(curvature):
    moved, gradient = evaluate_map(BendMap(type="bend", curvature=curvature), points())
    assert torch.allclose(moved, points(), atol=1e-6) and torch.allclose(gradient, torch.eye(3, dtype=torch.float64), atol=1e-6)


def test_stretch_keeps_the_volume():
    moved, gradient = evaluate_map(StretchMap(type="stretch", factor=4.0), points())
    assert torch.allclose(moved, points() * torch.tensor([0.5, 0.5, 4.0], dtype=torch.float64))
    assert torch.allclose(torch.linalg.det(gradient), torch.ones(40, dtype=torch.float64))


def test_a_lattice_at_rest_moves_nothing_and_an_affine_one_is_affine_even_outside_its_box():
    x = 3 * points()
    moved, gradient = evaluate_map(lattice((4, 3, 2)), x)
    assert torch.allclose(moved, x, atol=1e-12) and torch.allclose(gradient, torch.eye(3, dtype=torch.float64), atol=1e-12)
    matrix = torch.tensor([[1.0, 0.2, 0.1], [-0.3, 0.9, 0.0], [0.1, 0.4, 1.2]], dtype=torch.float64)
    moved, gradient = evaluate_map(lattice((3, 3, 3), lambda p: (matrix @ torch.tensor(p, dtype=torch.float64)).tolist()), x)
    assert torch.allclose(moved, x @ matrix.T, atol=1e-12) and torch.allclose(gradient, matrix.expand(40, 3, 3), atol=1e-12)


def test_a_lattice_corner_goes_to_its_control_point():
    moved, _ = evaluate_map(MAPS["lattice"], torch.tensor([[1.0, -1.0, 1.5]], dtype=torch.float64))
    assert torch.allclose(moved[0], torch.tensor(wobble([1.0, -1.0, 1.5]), dtype=torch.float64))


def test_the_points_type_is_kept(device):
    moved, gradient = evaluate_map(MAPS["twist"], points(dtype=torch.float32).to(device))
    assert moved.dtype == gradient.dtype == torch.float32 and moved.device.type == device


def test_impossible_maps_are_refused_with_a_sentence():
    with pytest.raises(ValueError, match=r"must stay below 0\.5"):
        check_map(BendMap(type="bend", curvature=0.6), torch.tensor([[2.0, 0, 0]]))
    check_map(BendMap(type="bend", curvature=-0.6), torch.tensor([[2.0, 0, 0]]))
    ragged = LatticeMap(type="lattice", minimum=(0, 0, 0), maximum=(1, 1, 1), control_points=[[[(0, 0, 0)] * 2] * 2, [[(0, 0, 0)] * 2]])
    flat = lattice((2, 2, 2), low=(0.0, 0.0, 0.0), high=(1.0, 1.0, 0.0))
    for bad, sentence in [(ragged, "in full rows"), (flat, "must exceed its minimum")]:
        with pytest.raises(ValueError, match=sentence):
            evaluate_map(bad, points())
