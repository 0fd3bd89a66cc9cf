"""16-bit grey keeps its shades, and EXIF is read as far as it goes."""

import io
import random

import numpy as np
import pytest
from PIL import ExifTags, Image, ImageOps

from drgs.exchange.pictures import as_eight_bits, exif_number, orientation_of, read_exif, upright


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


@pytest.mark.parametrize("orientation", range(10))
def test_a_picture_is_turned_as_pillow_turns_it(orientation: int) -> None:
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    image = stored(Image.fromarray(np.arange(6, dtype=np.uint8).reshape(2, 3)), exif=exif)
    assert orientation_of(image) == (orientation if 1 <= orientation <= 8 else 1)
    np.testing.assert_array_equal(np.asarray(upright(image)), np.asarray(ImageOps.exif_transpose(image)))


@pytest.mark.filterwarnings("ignore:::PIL.TiffImagePlugin")
def test_damaged_exif_is_none_and_no_error() -> None:
    exif = Image.Exif()
    exif[ExifTags.Base.ImageDescription] = "x"
    exif[ExifTags.Base.Orientation] = 6
    exif[ExifTags.IFD.Exif] = {ExifTags.Base.ExposureTime: (1, 50), ExifTags.Base.ISOSpeedRatings: 100}
    whole = exif.tobytes()
    draw, kinds = random.Random(0), set()
    for _ in range(500):
        damaged = bytearray(whole)
        for _ in range(draw.randint(1, 12)):
            damaged[draw.randrange(6, len(damaged))] = draw.randrange(256)
        image = stored(Image.new("L", (2, 3)), exif=bytes(damaged[: draw.randrange(6, 3 * len(damaged))]))
        try:
            image.getexif().get_ifd(ExifTags.IFD.Exif)
        except Exception as error:
            kinds.add(type(error).__name__)
        told = read_exif(image, ExifTags.IFD.Exif)
        time = exif_number(told, ExifTags.Base.ExposureTime)
        assert (time is None or time > 0) and orientation_of(image) in range(1, 9) and upright(image).size in ((2, 3), (3, 2))
    assert kinds, "none of these does harm, so that nothing was tested"


@pytest.mark.parametrize("value", [0, -1, float("nan"), float("inf"), "x", (1, 2), None, 10**400])
def test_what_is_no_number_above_nothing_is_none(value: object) -> None:
    assert exif_number({7: value}, 7) is None and exif_number({7: 3}, 7) == 3.0 and exif_number({}, 7) is None
