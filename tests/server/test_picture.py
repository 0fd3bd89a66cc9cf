"""A notebook shows a picture of the service by what its file is, and takes bytes for bytes."""

import io

import pytest
from PIL import Image

from drgs_server.picture import Picture


@pytest.mark.parametrize(("format", "method"), [("PNG", "_repr_png_"), ("JPEG", "_repr_jpeg_")])
def test_a_picture_is_shown_as_what_its_file_is(format: str, method: str) -> None:
    stream = io.BytesIO()
    Image.new("RGB", (4, 3), "red").save(stream, format)
    picture = Picture(stream.getvalue())
    offered = {name: getattr(picture, name)() for name in ("_repr_png_", "_repr_jpeg_")}
    assert offered.pop(method) == stream.getvalue() and list(offered.values()) == [None]
    assert picture == stream.getvalue() and repr(picture) == f"Picture of {len(picture)} bytes"


def test_an_exr_is_not_shown() -> None:
    picture = Picture(b"\x76\x2f\x31\x01")
    assert picture._repr_png_() is None and picture._repr_jpeg_() is None
