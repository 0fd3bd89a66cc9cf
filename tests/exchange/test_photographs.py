"""photographs.zip: what is kept, and what is refused of a file that anybody may have made."""

import io
import zipfile

import numpy as np
import pytest
from PIL import Image

from drgs.exchange.photographs import LONGEST_SIDE, check_photographs, encode_photographs, read_photograph


def gradient(height: int, width: int, channels: int) -> np.ndarray:
    ramp = np.linspace(0, 255, width)[None, :, None] * np.linspace(0.5, 1, height)[:, None, None]
    return np.repeat(ramp, channels, -1).astype(np.uint8)


def zipped(entries: dict[str, bytes], method: int = zipfile.ZIP_STORED) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as archive:
        for name, data in entries.items():
            archive.writestr(name, data)
    return stream.getvalue()


def test_pictures_come_back_small_in_order_and_with_their_alpha(tmp_path):
    pictures = [gradient(40, 60, 3), gradient(1000, 1600, 4)]
    packed = encode_photographs(pictures)
    check_photographs(packed, 2, "the file")
    (tmp_path / "p.zip").write_bytes(packed)
    first, second = (Image.open(io.BytesIO(read_photograph(tmp_path / "p.zip", number))) for number in range(2))
    assert first.size == (60, 40) and first.mode == "RGB"
    assert np.abs(np.asarray(first, float) - pictures[0]).mean() < 4
    assert second.size == (LONGEST_SIDE, LONGEST_SIDE * 1000 // 1600) and second.mode == "RGBA"
    assert read_photograph(tmp_path / "p.zip", 2) is None and read_photograph(tmp_path / "none.zip", 0) is None


def test_the_same_pictures_give_the_same_file():
    assert encode_photographs([gradient(8, 8, 3)]) == encode_photographs([gradient(8, 8, 3)])


def picture(side: int = 8, kind: str = "WEBP") -> bytes:
    stream = io.BytesIO()
    Image.fromarray(gradient(side, side, 3)).save(stream, kind)
    return stream.getvalue()


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"PK nothing", "no zip"),
        (zipped({}), "expected 1 pictures"),
        (zipped({"../0000.webp": picture()}), "expected 1 pictures"),
        (zipped({"0000.webp": picture(), "evil.html": b"<script>"}), "expected 1 pictures"),
        (zipped({"0000.webp": b"<script>alert(1)</script>"}), "no WebP picture"),
        (zipped({"0000.webp": picture(kind="PNG")}), "no WebP picture"),
        (zipped({"0000.webp": picture(LONGEST_SIDE + 1)}), "at most 800 a side"),
        (zipped({"0000.webp": picture()[:60]}), "no WebP picture"),
        (zipped({"0000.webp": bytes(10_000_000)}, zipfile.ZIP_DEFLATED), "too large"),
    ],
)
def test_anything_but_small_pictures_is_refused_with_a_sentence(data, words):
    with pytest.raises(ValueError, match=words):
        check_photographs(data, 1, "photographs.zip")
