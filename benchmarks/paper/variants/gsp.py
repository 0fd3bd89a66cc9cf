"""Gaussian Splashing's way: particles as PhysGaussian's, shaded by split sum under a learned environment with normals along the shortest axis.

Source: Feng et al. 2025, whose appearance is Jiang et al. 2024 (docs/sources.md: feng2025, jiang2024); split sum: karis2013. What split sum
leaves of the photographs is a rest of harmonics, as there.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.paper.harmonics import ShadedColors
from benchmarks.paper.splats import Splats
from benchmarks.paper.variant import SplatVariant, Subject, own_gaussians
from benchmarks.paper.variants.physgaussian import drive_particles
from drgs.maths.brdf import f0_from_base
from drgs.maths.color import srgb_from_linear
from drgs.reconstruct.fit.light.split_sum import ENVIRONMENT_SIZE, filter_environment, shade_split_sum
from drgs.scene.camera import Camera
from drgs.scene.environment import Environment


def shortest_axes(splats: Splats) -> Float[Tensor, "splat 3"]:
    """Unit eigenvectors of the covariances' least eigenvalue; of a flat Gaussian that is across both tangents. Their sign means nothing."""
    return torch.nn.functional.normalize(torch.linalg.cross(splats.tangents[..., 0], splats.tangents[..., 1]), dim=-1, eps=1e-30)


def small_table(environment: Environment) -> Float[Tensor, "128 256 3"]:
    """The environment in the size that split sum is filtered in."""
    table = environment.radiance.permute(2, 0, 1)[None]
    return torch.nn.functional.interpolate(table, ENVIRONMENT_SIZE, mode="area")[0].permute(1, 2, 0).contiguous()


def split_sum_colors(subject: Subject, splats: Splats, light: Environment | None) -> ShadedColors:
    """Appearance: every Gaussian by itself under the whole environment, which nothing occludes."""
    gaussians = subject.asset.gaussians
    assert gaussians is not None
    tables = filter_environment(small_table(light or subject.asset.environment))
    diffuse = gaussians.albedo * (1 - gaussians.metallic)[:, None]
    f0, axes = f0_from_base(gaussians.albedo, gaussians.metallic), shortest_axes(splats)

    def shaded(camera: Camera) -> Tensor:
        wo = torch.nn.functional.normalize(camera.center_world - splats.centers, dim=-1)
        normals = torch.where((axes * wo).sum(-1, keepdim=True) < 0, -axes, axes)
        radiance = shade_split_sum(diffuse, torch.zeros_like(f0), f0, gaussians.roughness, normals, wo, tables)
        return srgb_from_linear(radiance.clamp(min=0)).clamp(max=1)

    return shaded


GSP = SplatVariant(
    "gsp",
    "GSP",
    own_gaussians,
    drive_particles,
    split_sum_colors,
    relights=True,
    simplified="a known deformation moves the particles where the paper has position-based dynamics; materials and environment are those that we recover, "
    "not learned through split sum; the paper's diffuse colour is baked, here the light reaches it too; the rest of harmonics stays what it "
    "was under another light; no water",
)
