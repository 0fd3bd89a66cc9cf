"""SOG and compressed PLY, which another program writes: what is said where it is missing, fails, or has nothing to write."""

import os
from dataclasses import replace
from pathlib import Path

import pytest

from drgs.convert import transform_splats as module
from drgs.convert.transform_splats import transform_splats
from drgs.exchange.gaussian_ply import decode_gaussian_ply
from tests.convert.test_export_asset import ball_asset


def stand_in(folder: Path, script: str) -> None:
    """A program called splat-transform: options, what is read and what is written."""
    program = folder / "splat-transform"
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(0o755)


@pytest.fixture
def path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The only folder of programs of our own, first on the path."""
    folder = tmp_path / "programs"
    folder.mkdir()
    monkeypatch.setenv("PATH", f"{folder}{os.pathsep}/usr/bin{os.pathsep}/bin")
    monkeypatch.setattr(module, "CHECKOUT_SCRIPT", tmp_path / "none.mjs")
    return folder


def test_the_program_gets_flat_gaussians_and_its_file_takes_the_place_of_an_old_one(path: Path, tmp_path: Path):
    stand_in(path, 'cp "$3" "$4"')
    asset, out = ball_asset(), tmp_path / "new" / "a.compressed.ply"
    out.parent.mkdir()
    out.write_text("old")
    assert transform_splats(asset, out, "compressed") == "materials left out"
    assert asset.gaussians is not None
    assert len(decode_gaussian_ply(out.read_bytes())["centers"]) == len(asset.gaussians.centers)
    assert list(out.parent.iterdir()) == [out]


def test_where_the_program_is_missing_a_sentence_says_how_to_get_it(path: Path, tmp_path: Path):
    with pytest.raises(
        ValueError, match=r"a\.sog: needs splat-transform, which is not installed; with Node 22 or newer: npm install -g @playcanvas"
    ):
        transform_splats(ball_asset(), tmp_path / "a.sog", "sog")
    assert not (tmp_path / "a.sog").exists()


def test_what_the_program_says_when_it_fails_is_passed_on_and_nothing_is_left(path: Path, tmp_path: Path):
    stand_in(path, "echo 'first line' >&2; echo '  no memory is left' >&2; echo 'failed in 0.4s' >&2; exit 3")
    with pytest.raises(ValueError, match=r"a\.sog: splat-transform ended with 3 and said: no memory is left"):
        transform_splats(ball_asset(), tmp_path / "a.sog", "sog")
    assert [entry.name for entry in tmp_path.iterdir()] == ["programs"]


def test_without_a_gpu_a_sog_is_made_on_the_cpu(path: Path, tmp_path: Path):
    stand_in(path, 'test "$1 $2" = "--gpu cpu" && cp "$5" "$6"')
    transform_splats(ball_asset(), tmp_path / "a.sog", "sog")
    assert len(decode_gaussian_ply((tmp_path / "a.sog").read_bytes())["centers"]) == 30
    with pytest.raises(ValueError, match=r"splat-transform ended with 1 and said: nothing"):
        transform_splats(ball_asset(), tmp_path / "a.compressed.ply", "compressed")


def test_an_asset_without_gaussians_is_refused(path: Path, tmp_path: Path):
    with pytest.raises(ValueError, match="format 'sog' needs Gaussians, and this asset has only a mesh; export it as glb"):
        transform_splats(replace(ball_asset(), gaussians=None), tmp_path / "a.sog", "sog")
