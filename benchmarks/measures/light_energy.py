"""How the recovered light differs from the true one: colour, strength, and lamps.

Both tables are box-averaged to the coarser one's size; energies are sums of radiance times solid angle.

    energy                    recovered over true, red, green, blue: what no method can know when albedo is unknown as well
    brightest_energy          energy of the brightest 1 % of directions (each table's own), recovered over true
    brightest_energy_scaled   the same after the whole energies are made equal, which takes out what cannot be known
    lamp_energy               energy in the truth's brightest 1 % of directions, recovered over true: lamps at their places
    tone_psnr                 of the tables clipped and sRGB-coded, weighted by solid angle, after the one factor that makes it best [dB]
    tone_scale                that factor
"""

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from benchmarks.scenes.bench_scene import Array
from drgs.maths.color import luminance, srgb_from_linear
from drgs.scene.environment import Environment

BRIGHTEST_SHARE = 0.01
"""Of all directions."""


def light_figures(recovered: Environment, true: Environment) -> dict:
    """The figures above."""
    height = min(len(recovered.radiance), len(true.radiance))
    found, truth = (_shrunk(light.radiance.double().numpy(), height) for light in (recovered, true))
    weight = np.repeat(np.sin(np.pi * (np.arange(height) + 0.5) / height), 2 * height)
    weight /= weight.sum()
    found, truth = found.reshape(-1, 3), truth.reshape(-1, 3)
    energy, true_energy = weight @ found, weight @ truth
    own, lamps = (_brightest(table, weight) for table in (found, truth))
    true_bright = float(_luminance(truth[lamps]) @ weight[lamps])
    bright = float(_luminance(found[own]) @ weight[own]) / true_bright
    tone_psnr, tone_scale = _best_tone_psnr(found, truth, weight)
    return {
        "energy": [float(value) for value in energy / true_energy],
        "brightest_energy": bright,
        "brightest_energy_scaled": bright / float(_luminance(energy) / _luminance(true_energy)),
        "lamp_energy": float(_luminance(found[lamps]) @ weight[lamps]) / true_bright,
        "tone_psnr": tone_psnr,
        "tone_scale": tone_scale,
    }


def _brightest(table: Array, weight: Array) -> NDArray[np.intp]:
    """Indices of the brightest texels that make up BRIGHTEST_SHARE of all directions."""
    order = np.argsort(-_luminance(table), kind="stable")
    return order[np.cumsum(weight[order]) <= BRIGHTEST_SHARE]


def _best_tone_psnr(found: Array, truth: Array, weight: Array) -> tuple[float, float]:
    shown_truth = _shown(truth)

    def error(log_scale: float) -> float:
        return float(weight @ np.square(_shown(np.exp(log_scale) * found) - shown_truth).mean(1))

    start = float(np.log(max(float(weight @ _luminance(truth)), 1e-12) / max(float(weight @ _luminance(found)), 1e-12)))
    best = minimize_scalar(error, bounds=(start - 3, start + 3), method="bounded")
    return float(-10 * np.log10(max(best.fun, 1e-12))), float(np.exp(best.x))


def _shown(linear: Array) -> Array:
    return srgb_from_linear(torch.from_numpy(linear).clamp(0, 1)).numpy()


def _luminance(linear: Array) -> Array:
    return luminance(torch.from_numpy(linear)).numpy()


def _shrunk(table: Array, height: int) -> Array:
    """(height, 2 height, 3) means of blocks.

    Raises:
        ValueError: the table's size is no whole multiple.
    """
    factor, left = divmod(len(table), height)
    if left:
        raise ValueError(f"a light of {len(table)} rows cannot be averaged to {height}; expected a whole multiple")
    return table.reshape(height, factor, 2 * height, factor, 3).mean((1, 3))
