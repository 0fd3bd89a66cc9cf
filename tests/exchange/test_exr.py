import io
import tracemalloc

import numpy as np
import OpenEXR
import pytest

from drgs.exchange.exr import decode_environment, decode_exr, decode_hdr, encode_environment, encode_exr, encode_maps, picture_claim


def sky(height: int = 4) -> np.ndarray:
    return np.random.default_rng(0).gamma(0.5, 4, (height, 2 * height, 3)).astype(np.float32)


def write_with_openexr(path, channels, compression=OpenEXR.ZIP_COMPRESSION):
    OpenEXR.File({"compression": compression, "type": OpenEXR.scanlineimage}, channels).write(str(path))
    return path.read_bytes()


def rgbe_from_linear(linear: np.ndarray) -> np.ndarray:
    exponent = np.frexp(linear.max(-1))[1]
    return np.concatenate([np.floor(linear * np.ldexp(1.0, 8 - exponent)[..., None]), (exponent + 128)[..., None]], -1).astype(np.uint8)


def hdr_bytes(rgbe: np.ndarray, encoding: str) -> bytes:
    height, width, _ = rgbe.shape
    data = f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {height} +X {width}\n".encode()
    for row in rgbe:
        if encoding == "flat":
            data += row.tobytes()
        elif encoding == "old":
            data += row[0].tobytes() + bytes([1, 1, 1, (width - 1) & 255]) + (bytes([1, 1, 1, (width - 1) >> 8]) if width > 256 else b"")
        else:
            data += bytes([2, 2, width >> 8, width & 255])
            for component in range(4):
                values, filled = row[:, component], 0
                while filled < width:  # alternate runs, where values repeat, with literals
                    run = 1
                    while filled + run < width and run < 127 and values[filled + run] == values[filled]:
                        run += 1
                    data += bytes([128 + run, values[filled]]) if run > 2 else bytes([run]) + values[filled : filled + run].tobytes()
                    filled += run
    return data


def test_an_environment_survives_writing_and_reading_bit_for_bit():
    assert decode_environment(encode_environment(sky())).tobytes() == sky().tobytes()


def test_half_floats_and_other_compressions_are_read(tmp_path):
    channels = {key: sky()[..., k].astype(np.float16) for k, key in enumerate("RGB")} | {"A": np.ones((4, 8), np.float16)}
    read = decode_environment(write_with_openexr(tmp_path / "a.exr", channels, OpenEXR.PIZ_COMPRESSION))
    assert np.array_equal(read, sky().astype(np.float16).astype(np.float32))


def test_rendered_maps_have_exactly_the_contract_channels_and_nothing_where_nothing_is_seen():
    random = np.random.default_rng(0)
    color, plane = (lambda: random.random((3, 2, 3), np.float32)), (lambda: random.random((3, 2), np.float32))
    albedo, depth, coverage = color(), plane(), np.array([[1, 0.5], [0, 1], [1, 1]], np.float32)
    maps = decode_exr(encode_maps(color(), coverage, albedo, color(), depth, plane(), plane(), plane()))
    expected = {"R", "G", "B", "A", "albedo.R", "albedo.G", "albedo.B", "normal.X", "normal.Y", "normal.Z"}
    assert set(maps) == expected | {"depth.Z", "roughness.Y", "metallic.Y", "visibility.Y"}
    assert maps["albedo.G"][0, 1] == albedo[0, 1, 1] and maps["depth.Z"][2, 0] == depth[2, 0]
    assert np.isinf(maps["depth.Z"][1, 0]) and maps["normal.X"][1, 0] == 0 and maps["R"][1, 0] == 0


@pytest.mark.parametrize("encoding", ["flat", "runs"])
def test_radiance_hdr_is_read_within_its_own_precision(encoding):
    linear = np.repeat(sky(8), 2, axis=1)[:, :16]  # repeats make runs
    linear[2, 3:9] = linear[2, 3]
    read = decode_hdr(hdr_bytes(rgbe_from_linear(linear), encoding))
    assert read.shape == linear.shape
    assert (np.abs(read - linear) <= linear.max(-1, keepdims=True) / 128).all()


def test_old_radiance_runs_longer_than_a_byte_are_read():
    rgbe = np.tile(np.array([100, 50, 25, 129], np.uint8), (2, 300, 1))
    read = decode_hdr(hdr_bytes(rgbe, "old"))
    assert np.allclose(read, np.array([100, 50, 25]) / 128) and read.shape == (2, 300, 3)


def test_negative_values_are_set_to_zero_and_said_so():
    ringing = sky()
    ringing[0, 0, 0] = -0.25
    with pytest.warns(UserWarning, match="studio.exr: 1 negative values"):
        assert decode_environment(encode_environment(ringing), "studio.exr")[0, 0, 0] == 0
    assert decode_environment(encode_environment(ringing), clamp_negative=False)[0, 0, 0] == np.float32(-0.25)


def test_wrong_or_damaged_pictures_are_refused_with_a_sentence():
    good, gray = encode_environment(sky()), encode_exr({"Y": np.ones((4, 8))})
    broken = sky()
    broken[1, 1, 1] = np.inf
    hdr = hdr_bytes(rgbe_from_linear(sky(8)), "runs")
    cases = [
        (encode_environment(sky()[:, :7]), "7x4; expected"),
        (encode_environment(broken), "1 values that are not finite"),
        (gray, "channels Y; expected R, G, B"),
        (good[:200], "OpenEXR file"),
        (good[:-20], "OpenEXR file"),
        (b"GIF89a", "neither an OpenEXR nor"),
        (hdr[:-5], "damaged Radiance HDR file .row 7"),
        (hdr.replace(b"-Y 8", b"+Y 8"), "expected '-Y height"),
        (hdr.replace(b"+X 16", b"+X 99999"), "limit"),
        (hdr.replace(b"rgbe", b"xyze"), "XYZE"),
    ]
    for data, sentence in cases:
        with pytest.raises(ValueError, match=f"^sky: .*{sentence}"):
            decode_environment(data, "sky")


def test_a_damaged_file_prints_nothing_on_stdout(capsys):
    with pytest.raises(ValueError, match="OpenEXR"):
        decode_environment(encode_environment(sky(32))[:-200])
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("value", [1.1e12, -1e13, 3e38])
def test_texels_beyond_any_light_are_refused_with_how_bright_they_are(value):
    picture = sky()
    picture[1, 2, 0] = value
    with pytest.raises(ValueError, match=r"sun\.exr: holds 1 values up to .*; expected at most 1e\+12"):
        decode_environment(encode_environment(picture), "sun.exr")


def test_the_brightest_light_is_taken():
    picture = np.full((2, 4, 3), 1e12, np.float32)
    np.testing.assert_array_equal(decode_environment(encode_environment(picture)), picture)


def old_runs(width: int, height: int) -> bytes:
    """A Radiance file of one colour in the oldest run lengths: twelve bytes a row, however long."""
    row = bytes([10, 20, 30, 128, 1, 1, 1, (width - 1) & 255, 1, 1, 1, (width - 1) >> 8])
    return b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y %d +X %d\n" % (height, width) + row * height


def test_a_picture_that_claims_more_than_its_file_can_hold_is_refused_before_it_is_read() -> None:
    data = old_runs(16384, 8192)
    assert len(data) < 110_000
    tracemalloc.start()
    with pytest.raises(ValueError, match=r"16384x8192 take 1610612736 bytes in memory, more than 1100 times the file's"):
        decode_environment(data, "sky.hdr")
    assert tracemalloc.get_traced_memory()[1] < 10 << 20
    tracemalloc.stop()
    small = decode_environment(old_runs(512, 256), "sky.hdr")
    assert small.shape == (256, 512, 3) and np.ptp(small, axis=(0, 1)).max() == 0, "small ones may be packed as well as they like"


def test_rows_that_are_turned_into_floats_a_few_at_a_time_are_the_same() -> None:
    random = np.random.default_rng(0)
    pixels = random.integers(0, 256, (150, 20, 4), np.uint8)
    pixels[..., 0] = 9  # no run, and no new run length
    found = decode_hdr(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 150 +X 20\n" + pixels.tobytes())
    exact = np.where(pixels[..., 3:] > 0, pixels[..., :3] * np.ldexp(np.float32(1), pixels[..., 3:].astype(np.int32) - 136), 0)
    np.testing.assert_array_equal(found, exact.astype(np.float32))


def claim_of(data: bytes) -> tuple[int, int, int] | None:
    claim = picture_claim(io.BytesIO(data))
    return None if claim is None else (claim.width, claim.height, claim.channels)


def test_a_size_is_read_from_the_head_of_either_format() -> None:
    assert claim_of(old_runs(512, 32)) == (512, 32, 3)
    assert claim_of(encode_environment(np.ones((8, 16, 3), np.float32))) == (16, 8, 3)
    assert claim_of(b"nonsense") is None and claim_of(b"#?RADIANCE\n\n") is None and claim_of(b"") is None


def test_a_size_is_found_behind_whatever_a_header_holds(tmp_path) -> None:
    """What the decoder would read counts, not what looks like it."""
    channels = {key: np.ones((8, 16), np.float32) for key in "RGBA"}
    for comment in ("x" * 100_000, "dataWindow\0box2i\0\x10\0\0\0" + "\0" * 16):
        OpenEXR.File({"type": OpenEXR.scanlineimage, "a comment": comment}, channels).write(str(tmp_path / "a.exr"))
        data = (tmp_path / "a.exr").read_bytes()
        assert claim_of(data) == (16, 8, 4) and decode_exr(data)["R"].shape == (8, 16)
    spaced = old_runs(512, 256).replace(b"-Y 256 +X 512\n", b"-Y  256 +X 512 \n")
    assert claim_of(spaced) == (512, 256, 3) and decode_hdr(spaced).shape == (256, 512, 3)
    assert claim_of(data[:60]) is None
