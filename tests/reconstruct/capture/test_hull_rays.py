"""What other views see at a place is the mean of their rays that end there, and of nothing else."""

import torch

from drgs.reconstruct.capture.hull_rays import seen_from_elsewhere


def test_a_ray_is_compared_with_other_views_rays_in_its_cell() -> None:
    random = torch.Generator().manual_seed(0)
    count, cell = 400, 0.25
    places = 2 * torch.rand(count, 3, generator=random) - 1
    ended = torch.rand(count, generator=random) < 0.8
    colors, view = torch.rand(count, 3, generator=random), torch.randint(0, 5, (count,), generator=random)
    mean, seen = seen_from_elsewhere(places, ended, colors, view, cell)
    corner = torch.floor(places / cell)
    for ray in range(count):
        others = (corner == corner[ray]).all(1) & (view != view[ray]) & ended
        assert bool(seen[ray]) == bool(others.any())
        torch.testing.assert_close(mean[ray], colors[others].mean(0) if bool(others.any()) else torch.zeros(3), atol=1e-5, rtol=1e-5)
    assert 0.1 < float(seen.float().mean()) < 0.9
