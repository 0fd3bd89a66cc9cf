"""Base colours for glTF's BRDF send back what our albedo does."""

import math

import pytest
import torch

from drgs.convert.gltf_reflectance import (
    albedo_from_gltf,
    brdf_factors,
    gltf_base_color,
    gltf_even_share,
    mean_factors,
    scattered,
    usd_base_color,
)
from drgs.maths.brdf import evaluate_brdf
from drgs.maths.constants import F0
from drgs.maths.sampling import sphere_lattice


def colours(count: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    random = torch.Generator().manual_seed(0)
    return torch.rand(count, 3, generator=random), torch.rand(count, generator=random), torch.rand(count, generator=random)


def test_a_white_dielectric_of_gltf_sends_back_all_of_an_even_light_from_any_side():
    """What its surface does not reflect comes from inside, and what met the surface twice is not lost."""
    n_dot_v, roughness = torch.linspace(0.05, 1, 20), torch.linspace(0.1, 1, 20)
    factors = brdf_factors(n_dot_v, roughness)
    once, _ = scattered(torch.full((20, 3), F0), factors)
    whole = once + gltf_even_share(torch.ones(20, 3), factors, torch.zeros(20, 1))
    assert (whole - 1).abs().max() < 1e-5


@pytest.mark.parametrize(("albedo", "roughness", "metallic"), [(0.5, 0.6, 0.0), (0.2, 0.3, 0.0), (0.8, 0.7, 1.0), (0.6, 0.5, 0.4)])
def test_the_base_color_sends_back_as_much_of_an_even_light_as_our_brdf(albedo, roughness, metallic):
    """Ours by quadrature over directions and views."""
    light = sphere_lattice(20_000).double()
    light = light[light[:, 2] > 0]
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand_as(light)
    cosines = (torch.arange(24, dtype=torch.float64) + 0.5) / 24
    total = 0.0
    for cosine in cosines.tolist():
        view = torch.tensor([math.sqrt(1 - cosine * cosine), 0.0, cosine], dtype=torch.float64).expand_as(light)
        colour = torch.full_like(light, albedo)
        rough, metal = torch.full_like(light[:, 0], roughness), torch.full_like(light[:, 0], metallic)
        diffuse, specular = evaluate_brdf(light, view, up, colour, rough, metal)
        sent = ((diffuse + specular)[:, 0] * light[:, 2]).sum() * 2 * math.pi / len(light)
        total += float(sent) * cosine / float(cosines.sum())
    given = torch.full((1, 3), albedo), torch.tensor([roughness]), torch.tensor([metallic])
    base, factors = gltf_base_color(*given), mean_factors(given[1])
    once, _ = scattered(F0 * (1 - metallic) + base * metallic, factors)
    found = once + gltf_even_share(base, factors, given[2][:, None])
    assert abs(float(found[0, 0]) - total) < 0.01 * total


@pytest.mark.parametrize(("albedo", "roughness"), [(0.5, 0.6), (0.2, 0.3), (0.9, 0.9)])
def test_the_base_color_of_usd_sends_back_what_our_albedo_does_by_the_formula_of_its_own_renderer(albedo, roughness):
    """By quadrature over lights and views, with our distribution and shadowing of facets for both."""
    light = sphere_lattice(20_000).double()
    light = light[light[:, 2] > 0]
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand_as(light)
    cosines = (torch.arange(24, dtype=torch.float64) + 0.5) / 24
    base = float(usd_base_color(torch.full((1, 3), albedo), torch.zeros(1))[0, 0])
    ours = theirs = 0.0
    for cosine in cosines.tolist():
        view = torch.tensor([math.sqrt(1 - cosine * cosine), 0.0, cosine], dtype=torch.float64).expand_as(light)
        met = (1 - (view * torch.nn.functional.normalize(view + light, dim=-1)).sum(-1)) ** 5
        rough = torch.full_like(light[:, 0], roughness)
        diffuse, specular = evaluate_brdf(light, view, up, torch.full_like(light, albedo), rough, torch.zeros_like(rough))
        inside = base * (1 - (F0 + (1 - F0) * met)) / math.pi
        share = 2 * math.pi / len(light) * cosine / float(cosines.sum())
        ours += float(((diffuse + specular)[:, 0] * light[:, 2]).sum()) * share
        theirs += float(((inside + specular[:, 0]) * light[:, 2]).sum()) * share
    assert theirs == pytest.approx(ours, rel=0.003) and base > 1.04 * albedo


def test_metals_keep_their_albedo_in_usd_and_no_base_color_is_above_one():
    albedo, _, metallic = colours(1000)
    assert torch.allclose(usd_base_color(albedo, torch.ones(1000)), albedo)
    base = usd_base_color(albedo, metallic)
    assert (base >= albedo - 1e-6).all() and base.max() <= 1


def test_what_is_read_back_is_the_albedo_where_a_base_color_reached_it():
    albedo, roughness, metallic = colours(1000)
    base = gltf_base_color(albedo, roughness, metallic)
    back = albedo_from_gltf(base, roughness, metallic)
    reached = (base > 1e-5) & (base < 1 - 1e-5)
    assert reached.float().mean() > 0.9
    assert (back - albedo)[reached].abs().max() < 1e-4
    assert (back <= albedo + 1e-3).all() and (albedo - back).max() < 0.1


def test_dielectrics_get_lighter_base_colors_and_rough_metals_darker_ones():
    albedo = torch.full((2, 3), 0.5)
    base = gltf_base_color(albedo, torch.tensor([0.5, 0.8]), torch.tensor([0.0, 1.0]))
    assert 0.52 < float(base[0, 0]) < 0.54 and float(base[1, 0]) < 0.45


def test_what_is_no_number_stays_none():
    found = gltf_base_color(torch.tensor([[math.nan, 0.5, 0.5]]), torch.tensor([0.5]), torch.tensor([0.0]))
    assert found[0, 0].isnan() and not found[0, 1:].isnan().any()
