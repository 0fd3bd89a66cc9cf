"""Arrays of whole numbers as bytes that zlib packs well, and that web/src/page/unpack_arrays.ts reads back.

Rows that follow one another are near one another, so their differences are small. A difference d is written as 2 d or -2 d - 1, column after
column, first the low bytes of all numbers, then the next ones.
"""

import json
import struct
import zlib

import numpy as np
import torch
from jaxtyping import Float, Int, UInt32
from numpy import ndarray

from drgs.maths.z_order import z_order

RGBE_OFFSET = 128
"""Of exponents, as in Radiance's files (docs/sources.md: ward1991)."""


def pack_arrays(arrays: dict[str, ndarray], about: dict) -> bytes:
    """zlib of a JSON header's length (uint32), the header, and the arrays.

    Args:
        arrays: uint8, uint16 or uint32, (row,) or (row, column); those of 32 bits are written as they are, the others as differences.
        about: plain JSON that the header holds beside the arrays' places.
    """
    listed, chunks = [], []
    for name, values in arrays.items():
        table = values.reshape(len(values), -1)
        listed.append({"name": name, "bytes": table.dtype.itemsize, "rows": table.shape[0], "columns": table.shape[1]})
        chunks.append(_planes(table if table.dtype.itemsize == 4 else _differences(table)))
    header = json.dumps(about | {"arrays": listed}, allow_nan=False, separators=(",", ":")).encode()
    return zlib.compress(b"".join([struct.pack("<I", len(header)), header, *chunks]), 9)


def _differences(table: ndarray) -> ndarray:
    bits = 8 * table.dtype.itemsize
    full = 1 << bits
    rows = table.astype(np.int64)
    step = rows - np.concatenate([np.zeros_like(rows[:1]), rows[:-1]])
    step = (step + full // 2) % full - full // 2  # the short way round
    return np.where(step >= 0, 2 * step, -2 * step - 1).astype(table.dtype)


def _planes(table: ndarray) -> bytes:
    little = np.ascontiguousarray(table.T).astype(table.dtype.newbyteorder("<")).reshape(-1)
    return little.view(np.uint8).reshape(len(little), -1).T.tobytes()


def in_order_of_use(faces: Int[ndarray, "face 3"], vertices: Float[ndarray, "vertex 3"]) -> tuple[ndarray, ndarray]:
    """Faces along a curve through space, and vertices in the order in which these use them: neighbours are near in memory.

    Returns:
        (face, 3) int64 into the new order, and (vertex,) which vertex stands at each place of it.
    """
    centers = torch.from_numpy(vertices[faces].mean(1))
    along = faces[z_order(centers).numpy()].reshape(-1)
    used, first = np.unique(along, return_index=True)
    order = used[np.argsort(first)]
    place = np.zeros(len(vertices), np.int64)
    place[order] = np.arange(len(order))
    return place[along].reshape(-1, 3), order


def steps_from_newest(faces: Int[ndarray, "face 3"]) -> UInt32[ndarray, "corner"]:
    """(3 face,) uint32: how far each corner lies behind the first vertex that no corner before it used; for faces `in_order_of_use`."""
    corners = faces.reshape(-1)
    newest = np.concatenate([[0], np.maximum.accumulate(corners)[:-1] + 1])
    return (newest - corners).astype(np.uint32)


def rgbe(radiance: Float[ndarray, "rows columns 3"]) -> ndarray:
    """(texel, 4) uint8: red, green and blue as shares of 256 of a power of two, whose exponent is the fourth; each within a 256th of the largest."""
    texels = radiance.reshape(-1, 3).astype(np.float64)
    largest = texels.max(1)
    exponent = np.frexp(np.maximum(largest, 2.0 ** (1 - RGBE_OFFSET)))[1]
    shares = np.floor(np.ldexp(texels, 8 - exponent[:, None])).clip(0, 255)
    return np.concatenate([shares, (exponent + RGBE_OFFSET)[:, None].clip(0, 255)], -1).astype(np.uint8)
