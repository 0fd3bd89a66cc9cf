"""The table of export formats is whole, and a suffix says which of them is meant."""

from pathlib import Path
from typing import get_args

import pytest

from drgs.exchange.export_formats import (
    EXPORT_FORMATS,
    FILE_KINDS,
    SPLAT_KINDS,
    DownloadFormat,
    ExportFormat,
    SplatFormat,
    command_format_of,
    export_format_of,
)


def test_the_table_holds_every_format_once():
    assert set(FILE_KINDS) == set(get_args(DownloadFormat))
    assert set(EXPORT_FORMATS) == set(get_args(ExportFormat))
    assert set(SPLAT_KINDS) == set(get_args(SplatFormat))


@pytest.mark.parametrize(("name", "expected"), [("a.sog", "sog"), ("A.compressed.PLY", "compressed"), ("a.b.ply", "ply"), ("a.glb", "glb")])
def test_the_command_knows_two_endings_more(name: str, expected: str):
    assert command_format_of(Path(name)) == expected


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("a.glb", "glb"),
        ("a.html", "html"),
        ("a.PLY", "ply"),
        ("a.spz", "spz"),
        ("a.usdz", "usdz"),
        ("a.usda", "usd"),
        ("a.usdc", "usd"),
        ("a.usd", "usd"),
        ("light.exr", "env"),
    ],
)
def test_a_suffix_stands_for_a_format(name: str, expected: str):
    assert export_format_of(Path(name)) == expected


@pytest.mark.parametrize("name", ["a", "a.fbx", "a.zip", "glb"])
def test_a_suffix_that_stands_for_no_format_is_refused(name: str):
    with pytest.raises(ValueError, match=r"expected \.glb, \.html, \.ply, \.spz, \.usdz, \.exr, or give --format"):
        export_format_of(Path(name))
