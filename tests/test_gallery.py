"""The gallery is what its script makes of assets, and small enough to be kept with the code."""

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from PIL import Image

from drgs.scene.asset import save_asset
from tests.scene.grey_cube import grey_cube

DOCS = Path(__file__).parent.parent / "docs"


@pytest.fixture(scope="module")
def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("make_gallery", DOCS / "make_gallery.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_gallery_is_small_and_its_page_is_the_scripts(script: ModuleType):
    script.refuse_too_much(DOCS / "images" / "gallery")
    page = (DOCS / "gallery.md").read_text()
    assert page.startswith(script.introduction()) and script.THREE_SECTION in page


@pytest.mark.slow
def test_a_gallery_shows_an_asset_in_every_look(script: ModuleType, tmp_path: Path):
    save_asset(grey_cube(), tmp_path / "asset")
    row = Image.new("RGBA", (5 * 8, 8), (10, 200, 30, 255))
    for light in ("overcast", "studio"):
        row.save(tmp_path / f"{light}-0.png")
    command = [f"grey_cube={tmp_path / 'asset'}", "--side", "48", "--spp", "8", "--three", str(tmp_path), "--docs", str(tmp_path / "docs")]
    script.main(command)
    page = (tmp_path / "docs" / "gallery.md").read_text()
    assert "## Grey cube\nImported; 48 faces." in page
    strip = np.asarray(Image.open(tmp_path / "docs" / "images" / "gallery" / "grey_cube.jpg"), float)
    assert strip.shape == (48, 4 * 48, 3)
    captured, sunset, gold, _ = np.split(strip, 4, 1)
    assert np.abs(captured - sunset).mean() > 3 and (gold[24, 24, 0] - gold[24, 24, 2]) > 40, "gold is no blue"
    assert Image.open(tmp_path / "docs" / "images" / "gallery" / "in_three.jpg").size == (4 * 8, 8)


def test_pictures_that_are_too_large_are_refused(script: ModuleType, tmp_path: Path):
    (tmp_path / "a.jpg").write_bytes(bytes(script.MOST_BYTES + 1))
    with pytest.raises(ValueError, match="pictures of 2000001 bytes, expected at most 2000000: choose a smaller --side"):
        script.refuse_too_much(tmp_path)
