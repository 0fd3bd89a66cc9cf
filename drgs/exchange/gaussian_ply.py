"""2D Gaussians as PLY: the fields that splatting programs read, plus base colour, roughness and metallic.

Columns: x y z nx ny nz f_dc_0..2 f_rest_0..44 (channel-major) opacity (logit) scale_0 scale_1 (log) rot_0..3 (wxyz)
base_color_0..2 metallic roughness (activated, 0..1). With `third_scale` a flat scale_2 is added for 3DGS viewers.
Plain numpy arrays under the field names of scene.gaussians; float32 survives bit for bit.
Source: the files of Kerbl et al. 2023 and Huang et al. 2024 (docs/sources.md), `SplatRenderMode` as Brush spells it.
"""

import math

import numpy as np

from drgs.exchange.ply import encode_ply, parse_ply

FLATNESS = 1e-6
"""Third scale in a file of 3D Gaussians, as a part of the object's extent, and at most THINNEST of the surfel's own smaller scale."""
THINNEST = 1e-3
FLAT_ENOUGH = 1e-2
"""Of three scales the third, as a part of the smaller other, up to which a Gaussian is read as a surfel."""


def encode_gaussian_ply(
    arrays: dict[str, np.ndarray], normals: np.ndarray, third_scale: bool = False, comments: tuple[str, ...] = ()
) -> bytes:
    """Bytes of a PLY file.

    Args:
        arrays: centers (n, 3), log_scales (n, 2), quats_wxyz (n, 4), opacity_logits (n), sh (n, 16, 3), albedo (n, 3),
            roughness (n), metallic (n); float32.
        normals: (n, 3) third axis of the rotations, for viewers that show points.
    """
    columns = dict(zip("xyz", arrays["centers"].T, strict=True))
    columns |= _numbered("n", normals, ("nx", "ny", "nz"))
    columns |= _numbered("f_dc_", arrays["sh"][:, 0])
    columns |= _numbered("f_rest_", arrays["sh"][:, 1:].transpose(0, 2, 1).reshape(-1, 45))
    columns["opacity"] = arrays["opacity_logits"]
    columns |= _numbered("scale_", arrays["log_scales"])
    if third_scale:
        columns["scale_2"] = log_thickness(arrays["centers"], arrays["log_scales"])
    columns |= _numbered("rot_", arrays["quats_wxyz"])
    columns |= _numbered("base_color_", arrays["albedo"])
    columns |= {"metallic": arrays["metallic"], "roughness": arrays["roughness"]}
    mode = () if third_scale else ("SplatRenderMode: 2dgs",)
    said = "base_color, metallic, roughness: activated values in 0..1, base_color linear; opacity: logit; scale: natural log; rot: wxyz"
    return encode_ply(
        {"vertex": {key: np.asarray(values, np.float32) for key, values in columns.items()}}, comments=(*mode, said, *comments)
    )


def log_thickness(centers: np.ndarray, log_scales: np.ndarray) -> np.ndarray:
    """(n,) log of a third scale for surfels with these centers (n, 3) and log_scales (n, 2), where a format has no flat Gaussians."""
    extent = float(np.ptp(centers, axis=0).max(initial=0.0)) if len(centers) else 1.0
    return np.minimum(math.log(FLATNESS * max(extent, 1e-12)), log_scales.min(1) + math.log(THINNEST))


def decode_gaussian_ply(data: bytes, name: str = "PLY") -> dict[str, np.ndarray]:
    """The arrays of `encode_gaussian_ply`. Missing SH bands are 0; missing materials are 0.5, 0.5 and 0.

    Raises:
        ValueError: a required column is missing, a value is not finite, or the file holds 3D (not flat) Gaussians.
    """
    vertex = parse_ply(data, name).elements.get("vertex")
    found = vertex.scalars if vertex else {}
    required = ["x", "y", "z", "opacity", "scale_0", "scale_1", *(f"rot_{k}" for k in range(4)), *(f"f_dc_{k}" for k in range(3))]
    missing = [column for column in required if column not in found]
    if vertex is None or missing:
        raise ValueError(f"{name}: is not a Gaussian PLY; it lacks the columns {', '.join(missing)}")
    count = vertex.rows
    for column, values in found.items():
        if not np.isfinite(values).all():
            raise ValueError(f"{name}: column '{column}' holds {int((~np.isfinite(values)).sum())} values that are not finite")
    if "scale_2" in found and (found["scale_2"] > np.minimum(found["scale_0"], found["scale_1"]) + math.log(FLAT_ENOUGH)).any():
        raise ValueError(f"{name}: holds 3D Gaussians (scale_2 is not flat); expected 2D Gaussians")

    def stack(columns: list[str]) -> np.ndarray:
        return np.stack([found[column].astype(np.float32) for column in columns], -1)

    rest = 0
    while f"f_rest_{rest}" in found:
        rest += 1
    if rest not in (0, 9, 24, 45):
        raise ValueError(f"{name}: has {rest} f_rest columns; expected 0, 9, 24 or 45 (spherical harmonics to degree 0..3)")
    sh = np.zeros((count, 16, 3), np.float32)
    sh[:, 0] = stack([f"f_dc_{k}" for k in range(3)])
    if rest:
        sh[:, 1 : 1 + rest // 3] = stack([f"f_rest_{k}" for k in range(rest)]).reshape(count, 3, rest // 3).transpose(0, 2, 1)

    def material(column: str, default: float) -> np.ndarray:
        return found[column].astype(np.float32) if column in found else np.full(count, default, np.float32)

    return {
        "centers": stack(["x", "y", "z"]),
        "log_scales": stack(["scale_0", "scale_1"]),
        "quats_wxyz": stack([f"rot_{k}" for k in range(4)]),
        "opacity_logits": found["opacity"].astype(np.float32),
        "sh": sh,
        "albedo": np.stack([material(f"base_color_{k}", 0.5) for k in range(3)], -1),
        "roughness": material("roughness", 0.5),
        "metallic": material("metallic", 0.0),
    }


def _numbered(prefix: str, values: np.ndarray, names: tuple[str, ...] | None = None) -> dict[str, np.ndarray]:
    """Columns of a (n, k) array under prefix0..k-1, or under the given names."""
    return dict(zip(names or [f"{prefix}{k}" for k in range(values.shape[1])], values.T, strict=True))
