"""A clear day as an environment, computed: a sun of its true size and strength, the sky it makes, and the ground both light.

In: how high the sun stands. Out: a lat-long table of linear Rec.709 radiance. Source of sky and air: Preetham et al. 1999, equations 3 and 4
and appendices A.1 and A.2 (docs/sources.md: preetham1999). The sun is a uniform disc whose colour is evaluated at one wavelength a
channel; the paper integrates spectra. Of the ground it says nothing: ours is a grey diffuser without shadows.
"""

import numpy as np

from drgs.scene.lat_long import direction_of_degrees, texel_directions, texel_solid_angles

AZIMUTH_DEGREES = -100.0
"""Of the sun: to the left of a camera at the start view. An environment edit's rotation turns it."""
TURBIDITY = 3.0
"""Clear air."""
RADIUS_DEGREES = 0.2665
"""Of the sun, as seen from the earth."""
LOWEST, HIGHEST = 2.0, 85.0
"""Elevations that the sky model is good for [degrees]."""
USUAL_ELEVATION = 40.0
UNIT = 25.0
"""Luminance of radiance 1 [kcd/m2]: white paper in the sun of a summer's day. It keeps the sun's disc below 65504, the most that a half-float
texture of a graphics card holds."""

_SUN_ILLUMINANCE = 128.0
"""Outside the air, facing the sun [klx]."""
_SUN_COLOR = np.array([1.112, 0.976, 0.914])
"""Of a black body of 5778 K, luminance 1."""
_WAVELENGTHS = np.array([0.612, 0.549, 0.465])
"""At which air is seen by red, green, blue [micrometres]."""
_OZONE = np.array([0.120, 0.085, 0.008])
"""Absorption there [1 / cm]; the air holds 0.35 cm."""
_GROUND_ALBEDO = np.array([0.205, 0.21, 0.165])
_RGB_FROM_XYZ = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])
_PEREZ = {  # slope and offset in turbidity of the distribution coefficients A..E
    "Y": ((0.1787, -1.4630), (-0.3554, 0.4275), (-0.0227, 5.3251), (0.1206, -2.5771), (-0.0670, 0.3703)),
    "x": ((-0.0193, -0.2592), (-0.0665, 0.0008), (-0.0004, 0.2125), (-0.0641, -0.8989), (-0.0033, 0.0452)),
    "y": ((-0.0167, -0.2608), (-0.0950, 0.0092), (-0.0079, 0.2102), (-0.0441, -1.6537), (-0.0109, 0.0529)),
}
_ZENITH = {  # of turbidity squared, turbidity and 1: polynomials in the sun's angle from the zenith, highest power first
    "x": ((0.00166, -0.00375, 0.00209, 0.0), (-0.02903, 0.06377, -0.03202, 0.00394), (0.11693, -0.21196, 0.06052, 0.25886)),
    "y": ((0.00275, -0.00610, 0.00317, 0.0), (-0.04214, 0.08970, -0.04153, 0.00516), (0.15346, -0.26756, 0.06670, 0.26688)),
}
_SUN_POINTS = 4096


def paint_sun_and_sky(elevation_degrees: float = USUAL_ELEVATION, height: int = 256) -> np.ndarray:
    """(height, 2 height, 3) float32 radiance.

    Args:
        elevation_degrees: of the sun's middle, LOWEST to HIGHEST.

    Raises:
        ValueError: the sun stands lower or higher than that.
    """
    if not LOWEST <= elevation_degrees <= HIGHEST:
        raise ValueError(f"the sun stands {elevation_degrees:g} degrees high; expected {LOWEST:g} to {HIGHEST:g}")
    sun = direction_of_degrees(AZIMUTH_DEGREES, elevation_degrees)
    direction = texel_directions(height)
    radiance = sky_radiance(direction, sun)
    below = direction[..., 2] < 0
    weights = texel_solid_angles(height)[:, None, None]
    flux = sun_irradiance(elevation_degrees)
    on_ground = flux * sun[2] + (radiance * direction[..., 2:] * weights)[~below].sum(0)
    radiance[below] = _GROUND_ALBEDO / np.pi * on_ground
    return (radiance + sun_share(sun, height)[..., None] / weights * flux).astype(np.float32)


def sun_irradiance(elevation_degrees: float) -> np.ndarray:
    """(3,) of a surface that faces the sun, through the air."""
    zenith_angle = 90 - elevation_degrees
    mass = 1 / (np.cos(np.radians(zenith_angle)) + 0.15 * (93.885 - zenith_angle) ** -1.253)
    molecules = 0.008735 * _WAVELENGTHS**-4.08
    haze = (0.04608 * TURBIDITY - 0.04586) * _WAVELENGTHS**-1.3
    return _SUN_COLOR * _SUN_ILLUMINANCE / UNIT * np.exp(-mass * (molecules + haze + 0.35 * _OZONE))


def sun_share(sun: np.ndarray, height: int) -> np.ndarray:
    """(height, 2 height) share of the sun's disc that lies in each texel; 1 in all. The disc is smaller than a texel near the horizon."""
    index = np.arange(_SUN_POINTS)
    angle = np.radians(RADIUS_DEGREES) * np.sqrt((index + 0.5) / _SUN_POINTS)  # evenly over the disc, in a spiral
    turn = index * (np.pi * (3 - np.sqrt(5)))
    right = np.cross([0.0, 0.0, 1.0], sun)
    right = right / np.linalg.norm(right) if np.linalg.norm(right) > 1e-6 else np.array([1.0, 0.0, 0.0])
    offset = np.cos(turn)[:, None] * right + np.sin(turn)[:, None] * np.cross(sun, right)
    points = np.cos(angle)[:, None] * sun + np.sin(angle)[:, None] * offset
    row = np.floor(np.arccos(points[:, 2].clip(-1, 1)) / np.pi * height).astype(int).clip(0, height - 1)
    column = np.floor((0.5 - np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi)) * 2 * height).astype(int) % (2 * height)
    share = np.zeros((height, 2 * height))
    np.add.at(share, (row, column), 1 / _SUN_POINTS)
    return share


def sky_radiance(direction: np.ndarray, sun: np.ndarray) -> np.ndarray:
    """(..., 3) of unit directions without the sun's disc; below the horizon what stands at the horizon."""
    cos_zenith = direction[..., 2].clip(1e-3, 1)
    cos_sun = (direction @ sun).clip(-1, 1)
    zenith_angle = float(np.arccos(np.clip(sun[2], 0, 1)))
    chi = (4 / 9 - TURBIDITY / 120) * (np.pi - 2 * zenith_angle)
    at_zenith = {"Y": (4.0453 * TURBIDITY - 4.9710) * np.tan(chi) - 0.2155 * TURBIDITY + 2.4192}
    for name, rows in _ZENITH.items():
        at_zenith[name] = np.polyval([TURBIDITY**2, TURBIDITY, 1] @ np.array(rows), zenith_angle)
    found = {
        name: at_zenith[name] * _perez(name, cos_zenith, cos_sun) / _perez(name, np.ones(1), np.cos(np.full(1, zenith_angle)))
        for name in _PEREZ
    }
    scale = found["Y"] / UNIT / found["y"]
    xyz = np.stack([scale * found["x"], scale * found["y"], scale * (1 - found["x"] - found["y"])], -1)
    return np.maximum(xyz @ _RGB_FROM_XYZ.T, 0)


def _perez(name: str, cos_zenith: np.ndarray, cos_sun: np.ndarray) -> np.ndarray:
    a, b, c, d, e = (slope * TURBIDITY + offset for slope, offset in _PEREZ[name])
    return (1 + a * np.exp(b / cos_zenith)) * (1 + c * np.exp(d * np.arccos(cos_sun)) + e * cos_sun**2)
