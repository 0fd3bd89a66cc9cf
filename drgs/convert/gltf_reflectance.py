"""Base colours for the BRDFs of glTF and USD: a file shall send back as much light as the object does.

Of one albedo, glTF's BRDF makes less than ours (drgs/maths/brdf.py): light gets into a dielectric only where its surface did not reflect it. And of
a rough metal more: three.js, Filament and Blender add the light that meets the surface twice. So a file gets the base colour that sends back as
much of an even light as our albedo does, in the mean over views; one that we wrote is marked, and read back the other way round.
UsdPreviewSurface names no formula. That of OpenUSD's own renderer (Storm, previewSurface.glslfx) takes from a dielectric's inside what its surface reflects,
as glTF does, and adds nothing twice; so dielectrics are made lighter for it, and metals keep their albedo.
Source: glTF 2.0, appendix B; Fdez-Aguera 2019 (docs/sources.md: fdezaguera2019), as three.js' standard material has it.
"""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from drgs.maths.constants import F0

BASE_COLOR_MARK = {"drgs": {"base_color_for": "gltf"}}
"""`extras` of the `pbrMetallicRoughness` whose base colour was made here."""
MEAN_FRESNEL = 1 / 21
"""Mean of (1 - cosine)^5 over cosine-weighted directions: what F0 lacks to its mean over directions, of what it lacks to 1."""
MEAN_HALF_FRESNEL = 0.00369
"""The same of (1 - cosine)^5 between a view and the half vector, over views and lights."""
HALVINGS = 20
"""Of the interval that a colour is looked for in: to a millionth."""


def gltf_base_color(
    albedo: Float[Tensor, "point 3"], roughness: Float[Tensor, "point"], metallic: Float[Tensor, "point"]
) -> Float[Tensor, "point 3"]:
    """Linear; 1 where no base colour sends back as much as the albedo."""
    factors, metal = mean_factors(roughness), metallic[:, None]
    return _solved(our_share(albedo, factors, metal), lambda base: gltf_share(base, factors, metal))


def usd_base_color(albedo: Float[Tensor, "point 3"], metallic: Float[Tensor, "point"]) -> Float[Tensor, "point 3"]:
    """Linear; 1 where no base colour sends back as much as the albedo."""
    inside = (1 - F0) * (1 - MEAN_HALF_FRESNEL)
    return (albedo / (inside + (1 - inside) * metallic[:, None])).clamp(max=1)


def albedo_from_gltf(
    base_color: Float[Tensor, "point 3"], roughness: Float[Tensor, "point"], metallic: Float[Tensor, "point"]
) -> Float[Tensor, "point 3"]:
    """The albedo that gltf_base_color was given; the least one where it found 1."""
    factors, metal = mean_factors(roughness), metallic[:, None]
    return _solved(gltf_share(base_color, factors, metal), lambda albedo: our_share(albedo, factors, metal))


def our_share(
    albedo: Float[Tensor, "point 3"], factors: Float[Tensor, "point 2"], metallic: Float[Tensor, "point 1"]
) -> Float[Tensor, "point 3"]:
    """Of an even light, what comes back."""
    once, _ = scattered(F0 * (1 - metallic) + albedo * metallic, factors)
    return (1 - metallic) * albedo + once


def gltf_share(
    base_color: Float[Tensor, "point 3"], factors: Float[Tensor, "point 2"], metallic: Float[Tensor, "point 1"]
) -> Float[Tensor, "point 3"]:
    """The same by glTF's BRDF."""
    once, _ = scattered(F0 * (1 - metallic) + base_color * metallic, factors)
    return once + gltf_even_share(base_color, factors, metallic)


def gltf_even_share(
    base_color: Float[Tensor, "point 3"], factors: Float[Tensor, "point 2"], metallic: Float[Tensor, "point 1"]
) -> Float[Tensor, "point 3"]:
    """Of glTF's BRDF what has no direction: light from inside, and light that met the surface more than once."""
    once, again = scattered(torch.full_like(base_color, F0), factors)
    _, again_of_metal = scattered(base_color, factors)
    return base_color * (1 - metallic) * (1 - once - again) + again * (1 - metallic) + again_of_metal * metallic


def scattered(f0: Float[Tensor, "point 3"], factors: Float[Tensor, "point 2"]) -> tuple[Float[Tensor, "point 3"], Float[Tensor, "point 3"]]:
    """Shares of an even light that leave a surface of reflectance f0 after one meeting, and after several."""
    once = f0 * factors[:, :1] + factors[:, 1:]
    missing = 1 - factors.sum(-1, keepdim=True)
    mean = f0 + (1 - f0) * MEAN_FRESNEL
    return once, once * mean / (1 - missing * mean) * missing


def brdf_factors(n_dot_v: Float[Tensor, "point"], roughness: Float[Tensor, "point"]) -> Float[Tensor, "point 2"]:
    """F1 and F2 of split_sum.brdf_table, linear between its texels."""
    return _looked_up(_table(roughness), n_dot_v, roughness)


def mean_factors(roughness: Float[Tensor, "point"]) -> Float[Tensor, "point 2"]:
    """The same, their mean over cosine-weighted views."""
    table = _table(roughness)
    n_dot_v = (torch.arange(table.shape[2], device=table.device) + 0.5) / table.shape[2]
    mean = (table * n_dot_v).sum(-1, keepdim=True) / n_dot_v.sum()
    return _looked_up(mean, torch.full_like(roughness, 0.5), roughness)


def _table(like: Float[Tensor, "point"]) -> Float[Tensor, "2 rows columns"]:
    from drgs.reconstruct.fit.light.split_sum import brdf_table  # here, with its kernels: few meshes that are read need it

    return brdf_table().to(like)


def _looked_up(
    table: Float[Tensor, "2 rows columns"], across: Float[Tensor, "point"], down: Float[Tensor, "point"]
) -> Float[Tensor, "point 2"]:
    places = torch.stack([across, down], -1).clamp(0, 1) * 2 - 1
    return torch.nn.functional.grid_sample(table[None], places[None, None], padding_mode="border", align_corners=False)[0, :, 0].T


def _solved(wanted: Float[Tensor, "point 3"], share: Callable[[Tensor], Tensor]) -> Float[Tensor, "point 3"]:
    """The colour in 0..1 whose share, which grows with it, is nearest to what is wanted; NaN stays, for others to refuse."""
    low, high = torch.zeros_like(wanted), torch.ones_like(wanted)
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        enough = share(middle) >= wanted
        low, high = torch.where(enough, low, middle), torch.where(enough, middle, high)
    return torch.where(wanted.isnan(), wanted, (low + high) / 2)
