"""Counter-based random numbers for kernels: the Warp restatement of drgs/maths/sampling.py (see there for sources)."""

import warp as wp

wp.set_module_options({"enable_backward": False})

# Typed constants: Warp reads a bare literal above 2^31 as a negative int and warns.
HASH_A = wp.constant(wp.uint32(0x7FEB352D))
HASH_B = wp.constant(wp.uint32(0x846CA68B))
GOLDEN = wp.constant(wp.uint32(0x9E3779B9))
ODD_1 = wp.constant(wp.uint32(0x55555555))
ODD_2 = wp.constant(wp.uint32(0x33333333))
ODD_4 = wp.constant(wp.uint32(0x0F0F0F0F))
ODD_8 = wp.constant(wp.uint32(0x00FF00FF))
MIX_A = wp.constant(wp.uint32(0x3D20ADEA))
MIX_B = wp.constant(wp.uint32(0x05526C56))
MIX_C = wp.constant(wp.uint32(0x53A22864))
SECOND = wp.constant(wp.uint32(0x68BC21EB))


@wp.func
def hash32(value: wp.uint32) -> wp.uint32:
    x = value
    x = (x ^ (x >> wp.uint32(16))) * HASH_A
    x = (x ^ (x >> wp.uint32(15))) * HASH_B
    return x ^ (x >> wp.uint32(16))


@wp.func
def hash_combine(seed: wp.uint32, value: wp.uint32) -> wp.uint32:
    return hash32(seed ^ hash32(value + GOLDEN))


@wp.func
def reverse_bits32(value: wp.uint32) -> wp.uint32:
    x = value
    x = ((x & ODD_1) << wp.uint32(1)) | ((x >> wp.uint32(1)) & ODD_1)
    x = ((x & ODD_2) << wp.uint32(2)) | ((x >> wp.uint32(2)) & ODD_2)
    x = ((x & ODD_4) << wp.uint32(4)) | ((x >> wp.uint32(4)) & ODD_4)
    x = ((x & ODD_8) << wp.uint32(8)) | ((x >> wp.uint32(8)) & ODD_8)
    return (x << wp.uint32(16)) | (x >> wp.uint32(16))


@wp.func
def scramble_reversed(value: wp.uint32, seed: wp.uint32) -> wp.uint32:
    x = value ^ (value * MIX_A)
    x = x + seed
    x = x * ((seed >> wp.uint32(16)) | wp.uint32(1))
    x = x ^ (x * MIX_B)
    return x ^ (x * MIX_C)


@wp.func
def sobol_second_reversed(index: wp.uint32) -> wp.uint32:
    result = wp.uint32(0)
    row = wp.uint32(1)
    rest = index
    while rest != wp.uint32(0):
        if (rest & wp.uint32(1)) != wp.uint32(0):
            result = result ^ row
        row = row ^ (row << wp.uint32(1))
        rest = rest >> wp.uint32(1)
    return result


@wp.func
def unit_float(x: wp.uint32) -> float:
    return float(x >> wp.uint32(8)) * 5.9604645e-08


@wp.func
def sobol_2d(index: wp.uint32, seed: wp.uint32) -> wp.vec2:
    x = reverse_bits32(scramble_reversed(index, hash32(seed)))
    y = reverse_bits32(scramble_reversed(sobol_second_reversed(index), hash32(seed ^ SECOND)))
    return wp.vec2(unit_float(x), unit_float(y))


@wp.func
def shuffle_index(index: wp.uint32, seed: wp.uint32) -> wp.uint32:
    return reverse_bits32(scramble_reversed(reverse_bits32(index), hash32(seed)))
