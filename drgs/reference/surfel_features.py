"""Slow torch twin of drgs/reconstruct/fit/surfels/surfel_features.py, at the precision of its inputs; the specification of the kernels."""

import torch
from torch import Tensor

from drgs.maths.brdf import f0_from_base
from drgs.maths.frames import rotation_from_quat_wxyz
from drgs.maths.spherical_harmonics import evaluate_sh
from drgs.render.visible.rasterize.gbuffer import SEEN_FROM_BEHIND


def surfel_features(
    parameters: dict[str, Tensor], camera_center: Tensor, sh_degree: int, open_share: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Tangents (surfel, 3, 2) and features (surfel, 13): normal, diffuse albedo, F0, roughness and what harmonics add."""
    rotation = rotation_from_quat_wxyz(parameters["quats"])
    tangents = rotation[:, :, :2] * parameters["log_scales"].exp()[:, None, :]
    to_surfel = torch.nn.functional.normalize(parameters["centers"].detach() - camera_center, dim=-1)
    normal = rotation[:, :, 2]
    side = torch.where((normal.detach() * to_surfel).sum(-1, keepdim=True) > SEEN_FROM_BEHIND, -1.0, 1.0).to(normal)
    metallic, albedo = torch.sigmoid(parameters["metallic_logits"]), torch.sigmoid(parameters["albedo_logits"])
    lit = albedo if open_share is None else albedo * open_share
    sh = torch.cat([parameters["sh_dc"], parameters["sh_rest"]], 1)
    surface = [lit * (1 - metallic)[:, None], f0_from_base(albedo, metallic), torch.sigmoid(parameters["roughness_logits"])[:, None]]
    return tangents, torch.cat([normal * side, *surface, evaluate_sh(sh, to_surfel, sh_degree)], 1)
