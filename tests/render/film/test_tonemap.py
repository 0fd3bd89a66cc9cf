"""Tone curves: the kernel against its float64 twin, and what each curve is chosen for."""

import pytest
import torch

from drgs.maths.color import srgb_from_linear
from drgs.reference.tonemap import apply_tone_curve
from drgs.render.film.tonemap import CURVES, tonemap
from drgs.scene.tone_curve import ToneCurve


def shown(radiance: torch.Tensor, curve: ToneCurve, exposure: float = 0.0) -> torch.Tensor:
    """(color, 3) sRGB of colours (color, 3)."""
    return tonemap(radiance.float().contiguous()[None], torch.ones(1, len(radiance)), exposure, curve=curve)[0, :, :3]


@pytest.mark.parametrize("curve", CURVES)
def test_each_curve_is_its_float64_twin_after_the_exposure(curve: ToneCurve, device: str) -> None:
    generator = torch.Generator().manual_seed(1)
    radiance = torch.cat([4 * torch.rand(400, 3, generator=generator) ** 3, torch.zeros(1, 3), torch.full((1, 3), 1e4)])
    exact = srgb_from_linear(apply_tone_curve(radiance.double() * 2, curve).clamp(0, 1))
    found = tonemap(radiance[None].to(device), torch.ones(1, len(radiance), device=device), 1.0, curve=curve)[0, :, :3].cpu()
    torch.testing.assert_close(found.double(), exact, atol=2e-4, rtol=0)


def test_standard_is_no_curve_and_what_tonemap_does_by_itself() -> None:
    radiance, coverage = 2 * torch.rand(5, 4, 3), torch.rand(5, 4)
    assert torch.equal(tonemap(radiance, coverage), tonemap(radiance, coverage, curve="standard"))
    torch.testing.assert_close(shown(radiance[0], "standard"), srgb_from_linear(radiance[0]).clamp(0, 1), atol=1e-5, rtol=0)


@pytest.mark.parametrize("curve", ["filmic", "agx", "neutral"])
def test_grey_stays_grey_rises_and_keeps_detail_above_white(curve: ToneCurve) -> None:
    level = torch.logspace(-3, 1.5, 60)
    grey = shown(level[:, None].expand(-1, 3), curve)
    assert float((grey - grey.mean(-1, keepdim=True)).abs().max()) < 2e-2
    assert bool((grey.mean(-1).diff() > -1e-4).all()) and float(grey[0].max()) < 0.06
    two, eight = shown(torch.tensor([[2.0] * 3, [8.0] * 3]), curve)
    assert float(two.max()) < 0.995 and float((eight - two).min()) > 0.003


def test_neutral_shows_base_colours_as_they_are_and_bleaches_only_highlights() -> None:
    # Under full light a surface reflects its base colour and 4 % as a mirror, which the curve takes off again.
    base = torch.tensor([[0.7, 0.2, 0.05], [0.3, 0.3, 0.6], [0.1, 0.5, 0.1]])
    torch.testing.assert_close(shown(base + 0.04, "neutral"), srgb_from_linear(base), atol=2e-4, rtol=0)
    bright = shown(torch.tensor([[40.0, 2.0, 2.0]]), "neutral")
    assert float(bright.min()) > 0.9


def test_the_colour_of_a_screen_stays_behind_every_exposure_and_curve() -> None:
    color = torch.tensor([0.2, 0.5, 0.1])
    for curve in CURVES:
        behind = tonemap(torch.ones(2, 2, 3), torch.zeros(2, 2), 1.5, color, curve)
        torch.testing.assert_close(behind[..., :3], srgb_from_linear(color).expand(2, 2, 3), atol=1e-5, rtol=0)
    # An environment behind the object is light like the object's own.
    behind = tonemap(torch.ones(2, 2, 3), torch.zeros(2, 2), 1.0, color.expand(2, 2, 3), "filmic")
    torch.testing.assert_close(behind[0, 0, :3], shown(2 * color[None], "filmic")[0])
