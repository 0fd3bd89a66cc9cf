"""Hostile archives are refused with a sentence, and nothing of them stays on disk."""

import io
import stat
import zipfile
from pathlib import Path

import pytest

from drgs_server.api.door.zip_guard import ZipLimits, single_folder, unpack_zip

SMALL = ZipLimits(entries=10, total_bytes=3_000_000, ratio=200, ratio_from_bytes=100_000)


def archive(entries: dict[str, bytes], mode: int | None = None) -> io.BytesIO:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as out:
        for name, data in entries.items():
            info = zipfile.ZipInfo(name)
            info.compress_type = zipfile.ZIP_DEFLATED
            if mode is not None:
                info.external_attr = mode << 16
            out.writestr(info, data)
    stream.seek(0)
    return stream


def test_an_honest_archive_is_unpacked(tmp_path: Path) -> None:
    unpack_zip(archive({"capture/transforms.json": b"{}", "capture/images/a.png": b"png"}), tmp_path / "out", SMALL)
    assert single_folder(tmp_path / "out") == tmp_path / "out" / "capture"
    assert (tmp_path / "out/capture/images/a.png").read_bytes() == b"png"


@pytest.mark.parametrize(
    "name",
    ["../evil", "a/../../evil", "/etc/evil", "C:/evil", "a\\..\\evil", "a/./b", "a//b", "a\nb", "x" * 500, "nul:stream", "a/" + "ä" * 150],
)
def test_names_that_lead_elsewhere_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(ValueError, match="does not name a place inside"):
        unpack_zip(archive({"good": b"1", name: b"2"}), tmp_path / "in" / "out", SMALL)
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []
    assert list((tmp_path / "in").iterdir()) == []


@pytest.mark.parametrize("kind", [stat.S_IFLNK, stat.S_IFCHR, stat.S_IFIFO, stat.S_IFSOCK])
def test_links_and_devices_are_refused(tmp_path: Path, kind: int) -> None:
    with pytest.raises(ValueError, match="link or a device"):
        unpack_zip(archive({"link": b"/etc/passwd"}, kind | 0o777), tmp_path / "out", SMALL)


def test_a_bomb_is_refused_by_its_ratio(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="200 times"):
        unpack_zip(archive({"bomb": bytes(2_500_000)}), tmp_path / "out", SMALL)
    assert not (tmp_path / "out").exists() and list(tmp_path.iterdir()) == []


def test_bytes_are_counted_and_not_believed(tmp_path: Path) -> None:
    import os

    with pytest.raises(ValueError, match="more than 3000000 bytes"):
        unpack_zip(archive({f"{k}": os.urandom(1_000_001) for k in range(3)}), tmp_path / "out", SMALL)


def test_too_many_entries_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="11 entries"):
        unpack_zip(archive({f"{k}": b"" for k in range(11)}), tmp_path / "out", SMALL)


def test_two_entries_of_one_name_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="two entries"):
        unpack_zip(archive({"A.png": b"1", "a.png": b"2"}), tmp_path / "out", SMALL)


@pytest.mark.parametrize("names", [("a", "a/b"), ("a/b", "a"), ("a", "a/"), ("a/", "a"), ("A", "a/b/c")])
def test_a_name_that_is_file_and_folder_is_refused(tmp_path: Path, names: tuple[str, str]) -> None:
    with pytest.raises(ValueError, match="both a file and a folder"):
        unpack_zip(archive(dict.fromkeys(names, b"")), tmp_path / "out", SMALL)


def test_folders_may_be_named_twice(tmp_path: Path) -> None:
    unpack_zip(archive({"a/": b"", "a/b": b"1", "A/": b"", "a/c/d": b"2"}), tmp_path / "out", SMALL)
    assert (tmp_path / "out/a/c/d").read_bytes() == b"2"


@pytest.mark.parametrize("data", [b"", b"PK", b"not a zip", b"\x80\x04\x95pickle"])
def test_what_is_no_archive_is_refused(tmp_path: Path, data: bytes) -> None:
    with pytest.raises(ValueError, match="What was sent is no zip"):
        unpack_zip(io.BytesIO(data), tmp_path / "out", SMALL)


def test_a_truncated_archive_is_refused(tmp_path: Path) -> None:
    whole = archive({"a": b"hello" * 1000}).getvalue()
    for length in range(0, len(whole) - 1, 7):
        with pytest.raises(ValueError):
            unpack_zip(io.BytesIO(whole[:length]), tmp_path / "out", SMALL)
    assert list(tmp_path.iterdir()) == []


def test_a_flipped_bit_is_noticed(tmp_path: Path) -> None:
    data = bytearray(archive({"a": bytes(range(256)) * 20}).getvalue())
    data[60] ^= 0xFF
    with pytest.raises(ValueError, match="damaged"):
        unpack_zip(io.BytesIO(bytes(data)), tmp_path / "out", SMALL)
