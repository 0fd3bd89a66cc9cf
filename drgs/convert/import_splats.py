"""Splats of a GLB (KHR_gaussian_splatting) become Gaussians: z up, flat, with the linear radiance that renderers here reckon with.

In: a .glb of any program. Out: what `export_asset` wrote into it, up to rounding; colours up to what sixteen harmonics hold of a curve.
What a file does not say of materials is that of scene/materials.py.
"""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from drgs.exchange.gaussian_ply import FLAT_ENOUGH
from drgs.exchange.gltf_splats import GltfSplats, PlacedSplats, read_gltf_splats
from drgs.maths.color import linear_from_srgb
from drgs.maths.constants import UNBOUNDED
from drgs.maths.frames import quat_wxyz_from_rotation, rotation_from_quat_wxyz
from drgs.maths.spherical_harmonics import map_radiance, rotate_sh
from drgs.scene.gaussians import Gaussians
from drgs.scene.materials import DEFAULT_ALBEDO, DEFAULT_METALLIC, DEFAULT_ROUGHNESS

WORLD_FROM_GLTF = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""y up to z up."""
LOGIT_MARGIN = 1e-7
"""Opacities this close to 0 and 1 get finite logits: float32 tells nothing closer to 1 apart."""
SHEAR_TOLERANCE = 1e-4
"""By which a node's matrix may differ from a turn and one scale, as a part of that scale squared."""
MATERIAL_MARGIN = 1e-4
"""By which materials may leave 0..1; they are clipped."""


def import_splats(path: Path) -> Gaussians | None:
    """Gaussians of a .glb; None where it holds none.

    Raises:
        ValueError: one sentence: as `read_gltf_splats`, or the splats are not flat, have no width, or their node stretches or mirrors them.
    """
    parts = [_gaussians(part, str(path)) for part in read_gltf_splats(path) if len(part.splats.centers)]
    if not parts:
        return None
    return Gaussians(**{key: torch.cat([getattr(part, key) for part in parts]).contiguous() for key in vars(parts[0])})


def _gaussians(part: PlacedSplats, name: str) -> Gaussians:
    splats, world_from_splats = part.splats, WORLD_FROM_GLTF @ part.gltf_from_splats
    scale, rotation = _turn_and_scale(world_from_splats[:3, :3], name)
    with np.errstate(over="ignore", invalid="ignore"):
        centers = splats.centers @ world_from_splats[:3, :3].T + world_from_splats[:3, 3]
        scales = scale * splats.scales.astype(np.float64)
    farthest = max(np.abs(centers).max(), scales.max())
    if not farthest < UNBOUNDED:
        raise ValueError(f"{name}: its splats reach {farthest:g} m; expected an object")
    _refuse_thick(scales, name)
    world_from_splat = torch.from_numpy(rotation) @ rotation_from_quat_wxyz(torch.from_numpy(splats.quats_xyzw[:, [3, 0, 1, 2]]).double())
    sh = rotate_sh(torch.from_numpy(splats.sh).double(), torch.from_numpy(rotation))
    if splats.color_space == "srgb_rec709_display":
        sh = map_radiance(sh, lambda shown: linear_from_srgb(shown.clamp(min=0)))
    materials = _materials(splats, name)
    return Gaussians(
        torch.from_numpy(centers).float(),
        torch.from_numpy(np.log(scales[:, :2])).float(),
        quat_wxyz_from_rotation(world_from_splat).float(),
        torch.logit(torch.from_numpy(splats.opacities).double(), eps=LOGIT_MARGIN).float(),
        sh.float(),
        *(torch.from_numpy(materials[key]) for key in ("_ALBEDO", "_ROUGHNESS", "_METALLIC")),
    )


def _turn_and_scale(linear: Float[ndarray, "3 3"], name: str) -> tuple[float, Float[ndarray, "3 3"]]:
    """The scale and the rotation that a matrix is the product of."""
    with np.errstate(over="ignore", invalid="ignore"):
        determinant = float(np.linalg.det(linear))
        scale = float(np.cbrt(determinant))
        uneven = np.abs(linear.T @ linear - scale**2 * np.eye(3)).max()
    if not (determinant > 0 and uneven <= SHEAR_TOLERANCE * scale**2):
        raise ValueError(f"{name}: a node mirrors its splats or stretches them unevenly; apply its transform to them before exporting")
    return scale, linear / scale


def _refuse_thick(scales: Float[ndarray, "splat 3"], name: str) -> None:
    width = scales[:, :2].min(1)
    if (width <= 0).any():
        raise ValueError(f"{name}: {int((width <= 0).sum())} of its {len(width)} splats have no width; expected two scales above 0")
    thick = scales[:, 2] > FLAT_ENOUGH * width
    if thick.any():
        raise ValueError(
            f"{name}: holds 3D Gaussians: the third scale of {int(thick.sum())} of {len(thick)} splats is above {FLAT_ENOUGH:g} of the others; "
            "expected flat ones, as `drgs export` writes them: export the mesh without splats"
        )


def _materials(splats: GltfSplats, name: str) -> dict[str, ndarray]:
    count = len(splats.centers)
    defaults = {"_ALBEDO": (count, 3), "_ROUGHNESS": (count,), "_METALLIC": (count,)}
    values = zip(defaults.items(), (DEFAULT_ALBEDO, DEFAULT_ROUGHNESS, DEFAULT_METALLIC), strict=True)
    found = {key: splats.materials.get(key, np.full(shape, value, np.float32)) for (key, shape), value in values}
    for key, numbers in found.items():
        if not (numbers.min() >= -MATERIAL_MARGIN and numbers.max() <= 1 + MATERIAL_MARGIN):
            raise ValueError(f"{name}: {key} of its splats spans {numbers.min():g} to {numbers.max():g}; expected 0 to 1")
    return {key: numbers.clip(0, 1) for key, numbers in found.items()}
