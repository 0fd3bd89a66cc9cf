"""An urn whose wall carries scrolls and beads: relief a few pixels wide, all over, as on chased gold.

In: how finely it is cut. Out: a closed triangle mesh in the unit ball, z up.
"""

import numpy as np
import trimesh

SCROLL, BEAD = 0.010, 0.014
"""Heights of the relief; the urn is 1.5 high."""
CLOSING = 24
"""Power by which the wall closes at top and bottom: the higher, the flatter they are."""


def embossed_urn(around: int = 1400, up: int = 700) -> trimesh.Trimesh:
    """Args:
    around, up: vertices along a ring, and rings.
    """
    angle, height = np.meshgrid(np.linspace(0, 2 * np.pi, around, endpoint=False), np.linspace(0, 1, up), indexing="ij")
    wall = 0.42 + 0.16 * np.sin(np.pi * (1.25 * height + 0.05)) + 0.02 * np.cos(2 * np.pi * height)
    scrolls = SCROLL * np.sin(12 * angle + 6 * np.sin(6 * np.pi * height)) * np.sin(12 * np.pi * height)
    beads = BEAD * np.clip((np.cos(36 * angle) + np.cos(40 * np.pi * height)) / 2, 0, None) ** 2
    relief = np.where(np.abs(height % 0.25 - 0.125) < 0.04, beads, scrolls) * np.clip(8 * np.sin(np.pi * height), 0, 1)
    radius = (wall + relief) * np.sqrt(np.clip(1 - np.abs(2 * height - 1) ** CLOSING, 0, None))
    vertices = np.stack([radius * np.cos(angle), radius * np.sin(angle), 1.5 * height - 0.75], -1).reshape(-1, 3)
    ring, step = np.arange(around)[:, None], np.arange(up - 1)[None]
    here, beside = ring * up + step, (ring + 1) % around * up + step
    lower, upper = np.stack([here, beside, beside + 1], -1), np.stack([here, beside + 1, here + 1], -1)
    urn = trimesh.Trimesh(vertices, np.concatenate([lower.reshape(-1, 3), upper.reshape(-1, 3)]), process=False)
    urn.merge_vertices()
    urn.update_faces(urn.nondegenerate_faces())
    urn.remove_unreferenced_vertices()
    return urn
