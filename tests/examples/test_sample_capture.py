"""What the repository brings along is complete, small, and readable by the project's own doors."""

import json
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import torch

from drgs.reconstruct.capture.load_views import load_cameras, load_views

EXAMPLES = Path(__file__).parents[2] / "examples"
CAPTURE = EXAMPLES / "sample_capture"


def test_the_sample_capture_has_enough_masked_views() -> None:
    views = load_views(CAPTURE)
    assert views.has_masks and views.source == "nerf-synthetic"
    assert len(views.cameras) >= 48
    assert all(image.shape == (256, 256, 3) for image in views.images_srgb)
    coverage = torch.stack(views.coverage)
    share = (coverage > 127).float().mean((1, 2))
    assert float(share.min()) > 0.05
    # Nothing is cut off by the picture's border.
    assert int(coverage[:, [0, -1]].max()) == 0 and int(coverage[:, :, [0, -1]].max()) == 0


def test_the_sample_capture_holds_test_views_that_training_does_not_name() -> None:
    test = load_cameras(CAPTURE / "transforms_test.json")
    train = load_cameras(CAPTURE / "transforms_train.json")
    assert len(test) >= 5
    nearest = [min(float((a.center_world - b.center_world).norm()) for b in train) for a in test]
    assert min(nearest) > 0.05
    frames = json.loads((CAPTURE / "transforms_train.json").read_text())["frames"]
    assert all(frame["file_path"].startswith("./train/") for frame in frames)


def test_the_sample_capture_is_small() -> None:
    assert sum(path.stat().st_size for path in CAPTURE.rglob("*") if path.is_file()) <= 4_000_000


@pytest.mark.parametrize(
    "path", sorted([*(EXAMPLES / "environments").glob("*.exr"), *(CAPTURE / "env").glob("*.exr")]), ids=lambda path: path.stem
)
def test_an_environment_is_a_small_hdr_map_twice_as_wide_as_high(path: Path) -> None:
    assert path.stat().st_size <= 150_000
    radiance = OpenEXR.File(str(path)).channels()["RGB"].pixels.astype(np.float32)
    height, width, _ = radiance.shape
    assert width == 2 * height
    assert np.isfinite(radiance).all() and radiance.min() >= 0
    assert radiance.max() > 1, "not high dynamic range"


def test_three_environments_come_with_the_viewer() -> None:
    assert len(list((EXAMPLES / "environments").glob("*.exr"))) >= 3
