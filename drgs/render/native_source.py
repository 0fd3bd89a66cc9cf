"""C++ bodies of native kernel functions (`wp.func_native`), read from the .h files that lie beside the steps.

A body is compiled inside a function of Warp's, so it can neither include files nor define functions: what several bodies share is put
before them as text, as lambdas. Constants are written once, in Python, and enter as `constexpr`.
"""

from collections.abc import Mapping
from pathlib import Path

SIMD_VECTOR = Path(__file__).parent / "simd_vector.h"
"""Vectors of sixteen numbers, and what every body does with them."""


def native_source(body: Path, *before: Path, constants: Mapping[str, int | float] | None = None) -> str:
    """A function's body with what it needs before it: constants, the vectors of sixteen, the files `before`.

    Args:
        constants: their names and values; an int becomes an int, a float a float.
    """
    return constexpr_lines(constants or {}) + "".join(path.read_text() for path in (SIMD_VECTOR, *before, body))


def constexpr_lines(constants: Mapping[str, int | float]) -> str:
    """Definitions of constants: the same float32 values as they have in Warp kernels."""
    return "".join(
        f"constexpr int {name} = {value};\n" if isinstance(value, int) else f"constexpr float {name} = {value}f;\n"
        for name, value in constants.items()
    )
