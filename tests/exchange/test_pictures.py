"""16-bit grey keeps its shades."""

import io

import numpy as np
import pytest
from PIL import Image

from drgs.exchange.pictures import as_eight_bits


def stored(image: Image.Image, **options: object) -> Image.Image:
    """As Pillow reads it back from a PNG."""
    stream = io.BytesIO()
    image.save(stream, "PNG", **options)
    return Image.open(io.BytesIO(stream.getvalue()))


def test_sixteen_bit_grey_is_scaled_and_not_cut_off() -> None:
    shades = np.array([[0, 128, 129, 257, 1000, 32768, 65406, 65535]], np.uint16)
    small = as_eight_bits(stored(Image.fromarray(shades)))
    assert small.mode == "L"
    np.testing.assert_array_equal(np.asarray(small), np.round(shades / 257))


def test_the_transparent_shade_of_sixteen_bit_grey_becomes_alpha() -> None:
    shades = np.array([[0, 300, 65535]], np.uint16)
    small = as_eight_bits(stored(Image.fromarray(shades), transparency=300))
    assert small.mode == "LA"
    np.testing.assert_array_equal(np.asarray(small)[..., 1], [[255, 0, 255]])


@pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "RGB", "RGBA"])
def test_other_pictures_are_left_alone(mode: str) -> None:
    picture = stored(Image.new("RGB", (3, 2), (10, 200, 30)).convert(mode))
    assert as_eight_bits(picture) is picture


def test_whole_numbers_beyond_sixteen_bits_are_refused() -> None:
    with pytest.raises(ValueError, match="0 to 70000, expected 0 to 65535"):
        as_eight_bits(Image.fromarray(np.array([[0, 70000]], np.int32)))
