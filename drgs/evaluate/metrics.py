"""How good rendered pictures are: the figures of a folder of renders against a capture's truth.

In: a capture with test pictures, and a folder of renders beside it,

    RENDERS/test/<name>.png, .exr                  test cameras; the EXR holds the maps (channels of `drgs render --aov`)
    RENDERS/relight/<environment>/<name>.png       under another light
    RENDERS/deform/<map>/<environment>/<name>.png  deformed
    RENDERS/env.exr                                the recovered light

Out: plain numbers. Pictures are RGBA in [0, 1], straight alpha, sRGB, and are compared on white; a missing picture is an error, so
that a figure always covers all of them. Ground truth maps (`<name>_aov.npz`), other lights and deformations are scored where the
capture has them. Knows nothing of how the renders were made. Source: the definitions of the project's benchmark; SSIM after
Wang et al. 2004 (docs/sources.md: wang2004).
"""

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from drgs.exchange.exr import decode_exr
from drgs.maths.color_numpy import linear_from_srgb, srgb_from_linear

Array = NDArray[np.float64]


def score_renders(capture: Path, renders: Path) -> dict:
    """Every figure that the capture's truth and the renders allow.

    Returns:
        {"scene", "views", "maps", "relight": {environment: ...}, "deform": {"map/environment": ...}}, parts that were not rendered left out.

    Raises:
        ValueError: a picture is missing or has another size than its truth.
    """
    facts_path = capture / "scene.json"
    facts = json.loads(facts_path.read_text()) if facts_path.exists() else {}
    training_environment = facts.get("train_env")
    figures: dict = {"scene": facts.get("name", capture.name)}
    if (renders / "test").exists():
        names = test_names(capture)
        figures["views"] = picture_figures([_pair(renders / "test", capture / "test", f"{name}.png") for name in names])
        figures["maps"] = _map_figures(capture / "test", renders / "test", names)
        if training_environment and (renders / "env.exr").exists():
            recovered, true = (_environment_table(path) for path in (renders / "env.exr", capture / "env" / f"{training_environment}.exr"))
            figures["maps"]["env_psnr"] = environment_psnr(recovered, true)
    for truth in truth_folders(capture, "relight/*"):
        if (renders / "relight" / truth.name).exists():
            figures.setdefault("relight", {})[truth.name] = _folder_figures(capture, renders, truth, new_light=True)
    for truth in truth_folders(capture, "deform/*/*"):
        if (renders / truth.relative_to(capture)).exists():
            name = f"{truth.parent.name}/{truth.name}"
            figures.setdefault("deform", {})[name] = _folder_figures(capture, renders, truth, new_light=truth.name != training_environment)
    return figures


def test_names(capture: Path) -> list[str]:
    """Names of the test pictures, from transforms_test.json."""
    frames = json.loads((capture / "transforms_test.json").read_text())["frames"]
    return sorted(Path(frame["file_path"]).stem for frame in frames)


test_names.__test__ = False  # type: ignore[attr-defined]  # pytest collects by name


def truth_folders(capture: Path, pattern: str) -> list[Path]:
    """Sub-folders of the capture, in order."""
    return sorted(path for path in capture.glob(pattern) if path.is_dir())


def psnr(a: Array, b: Array) -> float:
    """Peak signal-to-noise ratio [dB] of values in [0, 1], one mean over everything; at most 120."""
    return float(-10 * np.log10(max(float(np.mean(np.square(a - b))), 1e-12)))


def ssim(a: Array, b: Array) -> float:
    """Structural similarity of (height, width, channel) pictures: Gaussian window of sigma 1.5, mean over the channels."""
    from skimage.metrics import structural_similarity

    window = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    return float(structural_similarity(a, b, data_range=1.0, channel_axis=-1, **window))


def picture_figures(pairs: list[tuple[Array, Array]], new_light: bool = False) -> dict:
    """Figures of (rendered, true) RGBA pictures.

    Args:
        new_light: also fit one factor a channel over all pictures before comparing, since no method can tell albedo from light scale.
    """
    white = [(on_white(rendered), on_white(true)) for rendered, true in pairs]
    figures: dict = {
        "images": len(pairs),
        "psnr": float(np.mean([psnr(*pair) for pair in white])),
        "ssim": float(np.mean([ssim(*pair) for pair in white])),
    }
    if new_light:
        scale = light_scale(pairs)
        scaled = [scale_light(rendered, scale) for rendered, _ in pairs]
        figures["psnr_scaled"] = float(np.mean([psnr(on_white(rendered), true) for rendered, (_, true) in zip(scaled, white, strict=True)]))
        figures["scale"] = [round(float(k), 4) for k in scale]
    return figures


def light_scale(pairs: list[tuple[Array, Array]]) -> Array:
    """(3,) least-squares factors from rendered to true linear colour, over pixels that both cover and the truth does not clip."""
    products, squares = np.zeros(3), np.zeros(3)
    for rendered, true in pairs:
        inside = (rendered[..., 3] > 0.5) & (true[..., 3] > 0.5) & (true[..., :3] < 1).all(-1)
        a, b = linear_from_srgb(rendered[inside, :3]), linear_from_srgb(true[inside, :3])
        products += np.sum(a * b, axis=0)
        squares += np.sum(a * a, axis=0)
    return products / np.maximum(squares, 1e-9)


def scale_light(rgba: Array, scale: Array) -> Array:
    """The (height, width, 4) sRGB picture with its linear colour times (3,) factors."""
    return np.concatenate([srgb_from_linear(np.clip(linear_from_srgb(rgba[..., :3]) * scale, 0, 1)), rgba[..., 3:]], -1)


def normal_error_degrees(rendered: Array, true: Array) -> Array:
    """Angle between (pixel, 3) normals; the rendered ones need not be of unit length."""
    length = np.linalg.norm(rendered, axis=1, keepdims=True)
    cosine = np.sum(rendered / np.maximum(length, 1e-9) * true, axis=1)
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def environment_psnr(recovered: Array, true: Array) -> float:
    """PSNR [dB] of log(1 + L) at 64 x 128, weighted by solid angle, after one least-squares factor a channel; the peak is the truth's."""
    a, b = _shrink(recovered, 64, 128), _shrink(true, 64, 128)
    scale = np.sum(a * b, axis=(0, 1)) / np.maximum(np.sum(a * a, axis=(0, 1)), 1e-9)
    log_a, log_b = np.log1p(np.maximum(a * scale, 0)), np.log1p(b)
    solid_angle = np.sin(np.pi * (np.arange(64) + 0.5) / 64)[:, None, None]
    error = np.sum(solid_angle * np.square(log_a - log_b)) / (np.sum(solid_angle) * 128 * 3)
    return float(10 * np.log10(np.max(log_b) ** 2 / max(error, 1e-12)))


def on_white(rgba: Array) -> Array:
    """(height, width, 3) straight-alpha picture over white."""
    alpha = rgba[..., 3:]
    return alpha * rgba[..., :3] + (1 - alpha)


def _folder_figures(capture: Path, renders: Path, truth: Path, new_light: bool) -> dict:
    rendered = renders / truth.relative_to(capture)
    return picture_figures([_pair(rendered, truth, path.name) for path in sorted(truth.glob("*.png"))], new_light)


def _pair(rendered_folder: Path, true_folder: Path, name: str) -> tuple[Array, Array]:
    rendered, true = _read_rgba(rendered_folder / name), _read_rgba(true_folder / name)
    if rendered.shape != true.shape:
        (h, w), (true_h, true_w) = rendered.shape[:2], true.shape[:2]
        raise ValueError(f"{rendered_folder / name} is {w}x{h}, but its truth is {true_w}x{true_h}")
    return rendered, true


def _read_rgba(path: Path) -> Array:
    if not path.exists():
        raise ValueError(f"{path} is missing; a figure is never computed over some of the pictures")
    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGBA"), dtype=np.float64) / 255


# Channels of a truth file <name>_aov.npz.
_TRUE_ALBEDO, _TRUE_NORMAL, _TRUE_DEPTH, _TRUE_ROUGHNESS, _TRUE_METALLIC, _TRUE_ALPHA = slice(0, 3), slice(3, 6), 6, 7, 8, 9


def _map_figures(true_folder: Path, rendered_folder: Path, names: list[str]) -> dict:
    """Figures of the maps inside the true mask, over all pictures at once; empty where a picture has no maps or no truth."""
    files = [(rendered_folder / f"{name}.exr", true_folder / f"{name}_aov.npz") for name in names]
    if not all(rendered.exists() and true.exists() for rendered, true in files):
        return {}
    samples: dict[str, list[Array]] = {}
    true_samples: list[Array] = []
    for rendered_path, true_path in files:
        with np.load(true_path, allow_pickle=False) as stored:
            true = stored["aov"].astype(np.float64)
        inside = true[..., _TRUE_ALPHA] > 0.5
        true_samples.append(true[inside])
        for name, channel in _read_channels(rendered_path).items():
            samples.setdefault(name, []).append(channel[inside])
    truth = np.concatenate(true_samples)
    complete = {name: np.concatenate(parts) for name, parts in samples.items() if len(parts) == len(files)}

    def rendered_map(*channels: str) -> Array | None:
        return np.stack([complete[c] for c in channels], -1) if all(c in complete for c in channels) else None

    figures: dict = {}
    if (normal := rendered_map("normal.X", "normal.Y", "normal.Z")) is not None:
        figures["normal_mae"] = float(np.mean(normal_error_degrees(normal, truth[:, _TRUE_NORMAL])))
    if (albedo := rendered_map("albedo.R", "albedo.G", "albedo.B")) is not None:
        scale = np.median(truth[:, _TRUE_ALBEDO] / np.maximum(albedo, 1e-6), axis=0)
        figures["albedo_psnr"] = psnr(np.clip(albedo * scale, 0, 1), truth[:, _TRUE_ALBEDO])
        figures["albedo_scale"] = [round(float(k), 4) for k in scale]
    for name, column in (("roughness", _TRUE_ROUGHNESS), ("metallic", _TRUE_METALLIC)):
        if (values := rendered_map(f"{name}.Y")) is not None:
            figures[f"{name}_rmse"] = float(np.sqrt(np.mean(np.square(values[:, 0] - truth[:, column]))))
    if (depth := rendered_map("depth.Z")) is not None:
        # A median: silhouette pixels, where depth jumps, would decide a mean.
        figures["depth_mae"] = float(np.median(np.abs(depth[:, 0] - truth[:, _TRUE_DEPTH])))
    return figures


def _read_channels(path: Path) -> dict[str, Array]:
    return {name: channel.astype(np.float64) for name, channel in decode_exr(path.read_bytes(), str(path)).items()}


def _environment_table(path: Path) -> Array:
    channels = _read_channels(path)
    return np.stack([channels[name] for name in "RGB"], -1)


def _shrink(table: Array, height: int, width: int) -> Array:
    """Mean of each of height x width blocks; a table smaller than that repeats texels."""
    for axis, count in ((0, height), (1, width)):
        starts = np.arange(count) * table.shape[axis] // count
        sizes = np.maximum(np.diff(starts, append=table.shape[axis]), 1)
        table = np.add.reduceat(table, starts, axis=axis) / np.expand_dims(sizes, tuple(k for k in range(3) if k != axis))
    return table
