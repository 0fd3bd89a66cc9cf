"""An SPZ says of splats what they are, to the last bit of its bytes."""

import gzip
import math

import numpy as np
import pytest

from drgs.exchange.spz import SMALLEST_SCALE, encode_spz
from tests.exchange.read_spz import read_spz


def splats(count: int = 200, seed: int = 0, reach: float = 1.0) -> dict[str, np.ndarray]:
    random = np.random.default_rng(seed)
    quats = random.normal(size=(count, 4))
    sh = 0.2 * random.normal(size=(count, 16, 3))
    return {
        "centers": (reach * random.uniform(-1, 1, (count, 3))).astype(np.float32),
        "scales": np.exp(random.uniform(-7, -2, (count, 3))).astype(np.float32),
        "quats_wxyz": (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        "opacities": random.random(count).astype(np.float32),
        "sh": sh.clip(-0.9, 0.9).astype(np.float32),
    }


@pytest.mark.parametrize("reach", [1e-3, 0.1, 1.0, 3.7, 1024.0, 8e6])
def test_places_are_exact_to_a_small_part_of_the_object_whatever_its_size(reach: float):
    given = splats(reach=reach)
    found = read_spz(encode_spz(given))
    assert np.abs(found.centers - given["centers"]).max() <= max(0.5, np.abs(given["centers"]).max() / 2**15)
    assert found.fraction_bits <= 24


def test_everything_else_is_exact_to_half_a_step_of_its_byte():
    given, found = splats(), read_spz(encode_spz(splats()))
    assert (found.version, found.degree, found.flags) == (3, 3, 0)
    assert np.abs(found.opacities - given["opacities"]).max() <= 0.5 / 255 + 1e-6
    assert np.abs(found.log_scales - np.log(given["scales"])).max() <= 0.5 / 16 + 1e-6
    assert np.abs(found.sh[:, 0] - given["sh"][:, 0]).max() <= 0.5 / 255 / 0.15 + 1e-6
    assert np.abs(found.sh[:, 1:] - given["sh"][:, 1:]).max() <= 0.5 / 128 + 1e-6
    alike = np.abs((found.quats_xyzw[:, [3, 0, 1, 2]] * given["quats_wxyz"]).sum(1))
    assert np.degrees(2 * np.arccos(alike.clip(0, 1))).max() < 0.3


@pytest.mark.parametrize("largest", range(4))
@pytest.mark.parametrize("sign", [1, -1])
def test_rotations_are_told_by_their_largest_component_whichever_it_is(largest: int, sign: int):
    quat = np.array([0.1, -0.2, 0.3, -0.05])
    quat[largest] = 0.0
    quat[largest] = sign * math.sqrt(1 - (quat**2).sum())
    given = splats(1) | {"quats_wxyz": quat[None].astype(np.float32)}
    found = read_spz(encode_spz(given)).quats_xyzw[0, [3, 0, 1, 2]]
    assert np.allclose(found * sign, quat, atol=2e-3)


def test_no_harmonic_stays_none_and_what_is_out_of_range_is_the_nearest():
    given = splats(3)
    given["sh"][:] = 0
    given["scales"][0], given["scales"][1] = 0, 1e4
    given["sh"][2, 1:] = 5.0
    found = read_spz(encode_spz(given))
    assert not found.sh[0, 1:].any() and np.abs(found.sh[0, 0]).max() <= 0.5 / 255 / 0.15 + 1e-6
    assert found.log_scales[0].tolist() == [-10] * 3 == [math.log(SMALLEST_SCALE)] * 3
    assert found.log_scales[1].min() > 5.9 and (found.sh[2, 1:] == 127 / 128).all()


def test_the_same_splats_give_the_same_bytes_and_none_give_a_file():
    assert encode_spz(splats()) == encode_spz(splats())
    assert len(read_spz(encode_spz(splats(0))).centers) == 0
    assert len(gzip.decompress(encode_spz(splats()))) == 16 + 200 * 65


def test_what_is_too_far_away_is_refused():
    with pytest.raises(ValueError, match="a splat is at 9e\\+06; SPZ reaches 8388608"):
        encode_spz(splats(1) | {"centers": np.float32([[9e6, 0, 0]])})
