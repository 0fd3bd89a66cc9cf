"""The BRDF itself: light may travel a path either way, and the kernels' copy says the same."""

import torch
import warp as wp
from torch import Tensor

from drgs.maths.brdf import evaluate_brdf
from drgs.render.integrate.brdf_warp import alpha_of, specular_brdf
from drgs.warp_torch import warp_array

COUNT = 4000


def random_surfaces(dtype: torch.dtype) -> tuple[Tensor, ...]:
    """wi, wo above the surface, down to 89.9 degrees; normal, albedo, roughness from 0 to 1, metallic."""
    numbers = torch.Generator().manual_seed(5)

    def unit(*shape: int) -> Tensor:
        return torch.nn.functional.normalize(torch.randn(*shape, 3, generator=numbers, dtype=torch.float64), dim=-1)

    normal = unit(COUNT)
    directions = []
    for _ in range(2):
        across = torch.nn.functional.normalize(torch.linalg.cross(normal, unit(COUNT)), dim=-1)
        height = 0.00175 + (1 - 0.00175) * torch.rand(COUNT, 1, generator=numbers, dtype=torch.float64)
        directions.append(height * normal + torch.sqrt(1 - height**2) * across)
    albedo = torch.rand(COUNT, 3, generator=numbers, dtype=torch.float64)
    roughness, metallic = torch.rand(2, COUNT, generator=numbers, dtype=torch.float64)
    return tuple(values.to(dtype) for values in (*directions, normal, albedo, roughness, metallic))


def test_the_brdf_is_reciprocal() -> None:
    wi, wo, *surface = random_surfaces(torch.float64)
    forth, back = evaluate_brdf(wi, wo, *surface), evaluate_brdf(wo, wi, *surface)
    assert float(forth[1].min()) > 0
    for a, b in zip(forth, back, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=0)


@wp.kernel
def specular_both_ways(
    wi: wp.array[wp.vec3],
    wo: wp.array[wp.vec3],
    normal: wp.array[wp.vec3],
    albedo: wp.array[wp.vec3],
    roughness: wp.array[float],
    metallic: wp.array[float],
    # outputs
    forth: wp.array[wp.vec3],
    back: wp.array[wp.vec3],
):
    i = wp.tid()
    alpha = alpha_of(roughness[i])
    forth[i] = specular_brdf(wi[i], wo[i], normal[i], alpha, albedo[i], metallic[i])
    back[i] = specular_brdf(wo[i], wi[i], normal[i], alpha, albedo[i], metallic[i])


def test_the_kernels_brdf_is_reciprocal_and_the_same(device: str) -> None:
    surfaces = [values.to(device).contiguous() for values in random_surfaces(torch.float32)]
    out = [torch.empty(COUNT, 3, device=device) for _ in range(2)]
    arrays = [warp_array(values, wp.vec3 if values.dim() == 2 else None) for values in surfaces]
    wp.launch(specular_both_ways, dim=COUNT, inputs=arrays, outputs=[warp_array(values, wp.vec3) for values in out], device=device)
    forth, back = (values.cpu() for values in out)
    torch.testing.assert_close(forth, back, rtol=2e-5, atol=1e-7)
    exact = evaluate_brdf(*(values.cpu().double() for values in surfaces))[1]
    error = (forth.double() - exact).abs() / (exact + 1e-4)
    assert float(error.quantile(0.99)) < 1e-3 and float(error.median()) < 1e-5
