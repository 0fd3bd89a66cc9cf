"""Paint the environments of the examples: three for the viewer, and the sample capture's two.

Everything is procedural, so nothing here has an author other than this file. Mapping as in the rest of the project:
u = 0.5 - atan2(d_y, d_x) / 2 pi, v = acos(d_z) / pi, z up, linear Rec.709 radiance, half-float EXR.

    python examples/environments/make_environments.py
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenEXR

HERE = Path(__file__).parent
CAPTURE = HERE.parent / "sample_capture" / "env"
Paint = Callable[[np.ndarray], np.ndarray]
"""Unit directions (h, w, 3) → radiance (h, w, 3)."""


def directions(height: int) -> np.ndarray:
    """(height, 2 height, 3) unit directions of the texel centres."""
    u = (np.arange(2 * height) + 0.5) / (2 * height)
    v = (np.arange(height) + 0.5) / height
    azimuth, polar = np.meshgrid((0.5 - u) * 2 * np.pi, v * np.pi)
    return np.stack([np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)], -1)


def rgb(*values: float) -> np.ndarray:
    return np.array(values, dtype=np.float64)


def blend(a: np.ndarray, b: np.ndarray, share: np.ndarray) -> np.ndarray:
    return a + (b - a) * share[..., None]


def rise(x: np.ndarray, start: float, end: float) -> np.ndarray:
    """0 before `start`, 1 after `end`, smooth in between."""
    t = np.clip((x - start) / (end - start), 0, 1)
    return t * t * (3 - 2 * t)


def toward(azimuth: float, elevation: float) -> np.ndarray:
    """Unit direction, angles in degrees."""
    a, e = np.radians(azimuth), np.radians(elevation)
    return np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])


def disc(d: np.ndarray, azimuth: float, elevation: float, radius: float, softness: float) -> np.ndarray:
    """Mask (h, w) of a round lamp; radius and softness in degrees."""
    angle = np.degrees(np.arccos(np.clip(d @ toward(azimuth, elevation), -1, 1)))
    return 1 - rise(angle, radius - softness, radius + softness)


def panel(d: np.ndarray, azimuth: float, elevation: float, half_width: float, half_height: float, softness: float = 0.05) -> np.ndarray:
    """Mask (h, w) of a rectangular window or soft box; half sizes as tangents of angles."""
    axis = toward(azimuth, elevation)
    right = np.cross([0, 0, 1.0], axis)
    right /= np.linalg.norm(right)
    up = np.cross(axis, right)
    along = d @ axis
    safe = np.maximum(along, 1e-3)
    x, y = np.abs(d @ right) / safe, np.abs(d @ up) / safe
    mask = (1 - rise(x, half_width - softness, half_width + softness)) * (1 - rise(y, half_height - softness, half_height + softness))
    return np.where(along > 0, mask, 0)


def sky(d: np.ndarray, zenith: np.ndarray, horizon: np.ndarray, ground: np.ndarray, below: np.ndarray, edge: float = 0.03) -> np.ndarray:
    """Gradient from horizon to zenith above, from `ground` at the horizon to `below` at the nadir underneath."""
    z = d[..., 2]
    above = blend(horizon, zenith, np.sqrt(np.clip(z, 0, 1)))
    under = blend(ground, below, np.clip(-z, 0, 1))
    return blend(under, above, rise(z, -edge, edge))


def studio(d: np.ndarray) -> np.ndarray:
    light = sky(d, rgb(0.10, 0.10, 0.11), rgb(0.22, 0.22, 0.23), rgb(0.26, 0.25, 0.24), rgb(0.12, 0.12, 0.12), edge=0.15)
    light = light + panel(d, 35, 40, 0.55, 0.4)[..., None] * rgb(9.0, 8.7, 8.2)
    light = light + panel(d, 160, 15, 0.22, 0.8)[..., None] * rgb(3.2, 3.6, 4.2)
    return light + panel(d, -100, 25, 0.16, 0.6)[..., None] * rgb(6.0, 5.4, 4.6)


def sunset(d: np.ndarray) -> np.ndarray:
    light = sky(d, rgb(0.10, 0.15, 0.34), rgb(0.85, 0.42, 0.24), rgb(0.16, 0.10, 0.07), rgb(0.05, 0.04, 0.035))
    near_sun = np.clip(d @ toward(-60, 7), 0, 1)
    above = rise(d[..., 2], -0.03, 0.03)
    light = light + (above * near_sun**12)[..., None] * rgb(1.6, 0.75, 0.25) + (above * near_sun**80)[..., None] * rgb(5.0, 2.6, 0.9)
    return light + disc(d, -60, 7, 3.0, 1.0)[..., None] * rgb(130.0, 70.0, 26.0)


def overcast(d: np.ndarray) -> np.ndarray:
    # The CIE overcast sky: three times as bright above as at the horizon.
    z = np.clip(d[..., 2], 0, 1)
    clouds = (1 + 2 * z) / 3 * (1 + 0.10 * np.sin(5 * d[..., 0] + 2 * d[..., 1]) * np.sin(4 * d[..., 1] - 3 * d[..., 2]) * z)
    light = clouds[..., None] * rgb(1.12, 1.2, 1.3)
    ground = blend(rgb(0.20, 0.21, 0.15), rgb(0.13, 0.15, 0.09), np.clip(-d[..., 2], 0, 1))
    return blend(ground, light, rise(d[..., 2], -0.03, 0.03))


def daylight_room(d: np.ndarray) -> np.ndarray:
    """What the sample capture is photographed under: a window, a lamp, a strip light, a coloured floor."""
    light = sky(d, rgb(0.42, 0.45, 0.50), rgb(0.30, 0.29, 0.28), rgb(0.34, 0.24, 0.16), rgb(0.26, 0.17, 0.11), edge=0.06)
    bars = 1 - 0.9 * panel(d, 20, 32, 0.04, 0.7, 0.02) - 0.9 * panel(d, 20, 32, 0.7, 0.04, 0.02)
    light = light + (panel(d, 20, 32, 0.48, 0.42, 0.03) * np.clip(bars, 0.05, 1))[..., None] * rgb(5.2, 5.8, 6.6)
    light = light + disc(d, 150, 48, 13, 3)[..., None] * rgb(9.5, 7.4, 4.8)
    light = light + panel(d, -95, 12, 0.09, 0.55, 0.03)[..., None] * rgb(3.6, 3.9, 4.6)
    light = light + panel(d, -150, 3, 0.5, 0.25, 0.1)[..., None] * rgb(0.06, 0.32, 0.28)
    return 0.7 * light  # exposed so that few pixels of the photographs clip


def evening(d: np.ndarray) -> np.ndarray:
    """Another light for the sample capture: blue hour, one warm street lamp, a low red glow."""
    light = sky(d, rgb(0.12, 0.20, 0.46), rgb(0.42, 0.40, 0.52), rgb(0.08, 0.08, 0.09), rgb(0.05, 0.05, 0.05))
    light = light + disc(d, -30, 38, 9, 3)[..., None] * rgb(24.0, 15.0, 6.5)
    return light + (np.clip(d @ toward(120, 2), 0, 1) ** 10 * rise(d[..., 2], -0.03, 0.03))[..., None] * rgb(1.6, 0.55, 0.35)


def write_environment(path: Path, paint: Paint, height: int) -> None:
    """Average 4x4 samples a texel, write half-float EXR."""
    fine = paint(directions(4 * height))
    radiance = fine.reshape(height, 4, 2 * height, 4, 3).mean((1, 3)).astype(np.float16)
    path.parent.mkdir(parents=True, exist_ok=True)
    channels = {name: np.ascontiguousarray(radiance[..., index]) for index, name in enumerate("RGB")}
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, channels).write(str(path))
    print(f"{path.name}: {2 * height}x{height}, {path.stat().st_size / 1000:.0f} kB, brightest {float(radiance.max()):.1f}")


def main() -> None:
    for paint in (studio, sunset, overcast):
        write_environment(HERE / f"{paint.__name__}.exr", paint, 128)
    write_environment(CAPTURE / "daylight_room.exr", daylight_room, 128)
    write_environment(CAPTURE / "evening.exr", evening, 64)


if __name__ == "__main__":
    main()
