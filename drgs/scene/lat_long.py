"""The grid of a lat-long table in numpy, for painting and measuring light where torch is too slow to load. Mapping: scene/environment.py."""

import numpy as np


def texel_directions(height: int, samples: int = 1) -> np.ndarray:
    """(samples height, 2 samples height, 3) unit directions: the centres of a table's texels, each split into samples x samples."""
    rows = samples * height
    azimuth = (0.5 - (np.arange(2 * rows) + 0.5) / (2 * rows)) * (2 * np.pi)
    polar = (np.arange(rows) + 0.5)[:, None] * (np.pi / rows)
    level = np.broadcast_to(np.cos(polar), (rows, 2 * rows))
    return np.stack([np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), level], -1)


def texel_means(samples: np.ndarray, count: int) -> np.ndarray:
    """(height, width, 3) means of count x count samples a texel."""
    height, width = samples.shape[0] // count, samples.shape[1] // count
    return samples.reshape(height, count, width, count, -1).mean((1, 3))


def texel_solid_angles(height: int) -> np.ndarray:
    """(height,) what a texel of each row weighs in the integral over the sphere of the table as it is looked up [sr].

    Lookup is bilinear, so a texel counts by the integral of its tent; the first and the last row also fill their pole. The weights of
    all texels sum to 4 pi.
    """
    step = np.pi / height
    polar = (np.arange(height) + 0.5) * step
    tents = np.sin(polar) * (2 * (1 - np.cos(step)) / step)
    first = polar[0]  # flat up to the pole, then half a tent
    tents[0] = tents[-1] = (1 - np.cos(first)) + np.cos(first) - (np.sin(first + step) - np.sin(first)) / step
    return tents * (np.pi / height)


def direction_of_degrees(azimuth: float, elevation: float) -> np.ndarray:
    """(3,) unit vector; azimuth counter-clockwise from +x seen from above, elevation above the horizon [degrees]."""
    a, e = np.radians(azimuth), np.radians(elevation)
    return np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
