"""What the lambdas of simd_vector.h say of their errors, on this processor and as others do it."""

import torch
import warp as wp

from drgs.render.native_source import SIMD_VECTOR
from drgs.warp_torch import warp_array

COUNT = 1 << 14


def of_sixteen(name: str) -> str:
    return SIMD_VECTOR.read_text() + f"store16(result.data + at, {name}(load16(given.data + at)));"


@wp.func_native(of_sixteen("exp_negative_roughly"))
def exp_negative_roughly(at: int, given: wp.array[float], result: wp.array[float]): ...


@wp.func_native(of_sixteen("inverse_sqrt_roughly"))
def inverse_sqrt_roughly(at: int, given: wp.array[float], result: wp.array[float]): ...


# What a processor without AVX-512 compiles, whatever this one has.
@wp.func_native(
    '#pragma push_macro("__AVX512F__")\n#undef __AVX512F__\n' + of_sixteen("inverse_sqrt_roughly") + '\n#pragma pop_macro("__AVX512F__")\n'
)
def inverse_sqrt_elsewhere(at: int, given: wp.array[float], result: wp.array[float]): ...


@wp.kernel(enable_backward=False, module="unique")
def apply_all(
    given: wp.array[float], exponent: wp.array[float], exponential: wp.array[float], ready: wp.array[float], steps: wp.array[float]
):
    at = 16 * wp.tid()
    exp_negative_roughly(at, exponent, exponential)
    inverse_sqrt_roughly(at, given, ready)
    inverse_sqrt_elsewhere(at, given, steps)


def test_rough_functions_err_as_little_as_they_say() -> None:
    given = 10 ** torch.linspace(-37, 37, COUNT)
    exponent = torch.linspace(0, 87, COUNT)
    found = [torch.empty(COUNT) for _ in range(3)]
    wp.launch(apply_all, COUNT // 16, [warp_array(given), warp_array(exponent), *map(warp_array, found)], device="cpu")
    exact = torch.exp(-exponent.double()), given.double().rsqrt(), given.double().rsqrt()
    for values, true, most in zip(found, exact, (6e-5, 1e-4, 5e-6), strict=True):
        assert float((values.double() / true - 1).abs().max()) < most
