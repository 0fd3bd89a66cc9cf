"""Colours of places of a mesh, and their gradients, against the float64 twin: corners blended, split sum, the display's curve."""

import pytest
import torch

from drgs.maths.brdf import f0_from_base
from drgs.reconstruct.fit.light.mesh_light import MeshLight
from drgs.reconstruct.fit.light.split_sum import ENVIRONMENT_SIZE, brdf_table, filter_environment
from drgs.reconstruct.fit.surface.surface_color import surface_color
from drgs.reference import split_sum as reference
from drgs.reference.image_terms import display_image

VERTICES, PLACES, CEILING = 60, 500, 0.6
TURN = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(5)))[0]


@pytest.fixture(scope="module")
def seen() -> dict[str, torch.Tensor]:
    """Places that look at their camera from a bumpy floor, a fifth of them saturated in the photograph."""
    generator = torch.Generator().manual_seed(2)
    rand = lambda *shape: torch.rand(*shape, generator=generator, dtype=torch.float64)  # noqa: E731
    normals = torch.nn.functional.normalize(rand(VERTICES, 3) - 0.5 + torch.tensor([0, 0, 1.0]), dim=-1)
    weights = rand(PLACES, 3) + 0.01
    return {
        "surface": torch.cat([normals, rand(VERTICES, 3), 0.1 + 0.8 * rand(VERTICES, 1), rand(VERTICES, 1)], 1),
        "tables": filter_environment(torch.rand(*ENVIRONMENT_SIZE, 3, generator=generator) + 0.1).double(),
        "open_share": rand(VERTICES, 3),
        "corners": torch.randint(VERTICES, (PLACES, 3), generator=generator),
        "weights": weights / weights.sum(1, keepdim=True),
        "wo": torch.nn.functional.normalize(rand(PLACES, 3) - 0.5 + torch.tensor([0, 0, 1.5]), dim=-1),
        "transmittance": (rand(PLACES) < 0.8).double(),
        "met": 0.3 * rand(PLACES, 3),
        "photo": torch.where(rand(PLACES, 3) < 0.2, CEILING, 0.7 * rand(PLACES, 3)),
    }


def twin(
    seen: dict[str, torch.Tensor], surface: torch.Tensor, tables: torch.Tensor, open_share: torch.Tensor, turn: torch.Tensor | None
) -> torch.Tensor:
    """As surface_color, operation by operation."""
    at = lambda values: (values[seen["corners"]] * seen["weights"][..., None]).sum(1)  # noqa: E731
    normal, albedo, roughness, metallic = at(surface).split([3, 3, 1, 1], 1)
    normal, wo = torch.nn.functional.normalize(normal, dim=-1), seen["wo"]
    if turn is not None:
        normal, wo = normal @ turn.T.to(normal), wo @ turn.T.to(wo)
    radiance = reference.shade_split_sum(
        albedo * (1 - metallic), torch.zeros_like(albedo), f0_from_base(albedo, metallic[:, 0]), roughness[:, 0], normal, wo, tables,
        brdf_table(32), seen["transmittance"], seen["met"], at(open_share),
    )  # fmt: skip
    return display_image(radiance, torch.ones_like(radiance[:, 0]), seen["photo"], CEILING)


@pytest.mark.parametrize("turn", [None, TURN], ids=["still", "turned"])
def test_colours_and_gradients_equal_the_twin(seen: dict[str, torch.Tensor], device: str, turn: torch.Tensor | None):
    pull = torch.rand(PLACES, 3, generator=torch.Generator().manual_seed(7), dtype=torch.float64) - 0.4
    leaves = [seen[name].clone().requires_grad_(True) for name in ("surface", "tables", "open_share")]
    expected = twin(seen, *leaves, turn)
    expected_gradients = torch.autograd.grad((expected * pull).sum(), leaves)
    assert 0.02 < float(((expected == CEILING) & (seen["photo"] == CEILING)).double().mean()) < 0.2  # some are cut

    own = {name: (value if name == "corners" else value.float()).to(device) for name, value in seen.items()}
    surface, tables, share = (own[name].requires_grad_(True) for name in ("surface", "tables", "open_share"))
    light = MeshLight(tables, share, None if turn is None else turn.to(device))
    given = (own[name] for name in ("corners", "weights", "wo", "transmittance", "met", "photo"))
    color = surface_color(*given, CEILING, surface, light)
    gradients = torch.autograd.grad((color * pull.float().to(device)).sum(), [surface, tables, share])

    assert float((color.detach().cpu().double() - expected.detach()).abs().max()) < 1e-4
    for found, wanted in zip(gradients, expected_gradients, strict=True):
        error = (found.cpu().double() - wanted).abs() / (wanted.abs() + 1e-2 * wanted.abs().max())
        assert float(error.quantile(0.99) if error.numel() < 1e5 else error.max()) < 1e-2
        assert float(error.median()) < 1e-4


def test_no_places_have_no_colour_and_no_gradient(seen: dict[str, torch.Tensor]):
    surface, tables = (seen[name].float().requires_grad_(True) for name in ("surface", "tables"))
    none, light = torch.zeros(0, 3), MeshLight(tables, seen["open_share"].float())
    color = surface_color(torch.zeros(0, 3, dtype=torch.long), none, none, torch.zeros(0), none, none, 1.0, surface, light)
    color.sum().backward()
    assert color.shape == (0, 3)
    assert float(surface.grad.abs().max()) == 0 and float(tables.grad.abs().max()) == 0
