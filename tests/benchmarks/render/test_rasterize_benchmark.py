"""The rasteriser's benchmark measures what it says and prints one document."""

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.__main__ import main


@pytest.fixture
def workload(tmp_path: Path) -> Path:
    """One opaque surfel of standard deviation 0.5 before a camera at distance 4."""
    path = tmp_path / "one.npz"
    np.savez(
        path,
        centers=np.zeros((1, 3), np.float32),
        tangents_u=np.array([[1, 0, 0]], np.float32),
        tangents_v=np.array([[0, 1, 0]], np.float32),
        scales=np.full((1, 2), 0.5, np.float32),
        opacities=np.full(1, 0.9, np.float32),
        features=np.array([[1, 2, 3, 4]], np.float32),
        K=np.array([[40, 0, 24], [0, 40, 16], [0, 0, 1]], np.float32),
        camera_from_world=np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]], np.float32),
        size=np.array([48, 32]),
    )
    return path


@pytest.mark.slow
def test_it_prints_one_document_and_dumps_the_image(workload: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    main(["rasterize", "--scene", str(workload), "--json", "--dump", str(tmp_path / "image.npy"), "--repeats", "7"])
    result = json.loads(capsys.readouterr().out)
    assert result["surfels"] == 1 and result["channels"] == 4 and result["size"] == [48, 32] and result["threads"] >= 1
    assert 0 < result["forward_ms"] <= result["forward_backward_ms"]
    image = np.load(tmp_path / "image.npy")
    assert image.shape == (32, 48, 4)
    # Half a pixel (0.05 world units, 0.1 standard deviations) off the centre in x and y.
    np.testing.assert_allclose(image[16, 24], 0.9 * np.exp(-0.5 * 2 * 0.1**2) * np.arange(1, 5), rtol=1e-3)


def test_a_median_of_few_repeats_is_refused(workload: Path):
    with pytest.raises(ValueError, match="fewer than 7"):
        main(["rasterize", "--scene", str(workload), "--repeats", "3"])


def test_an_unknown_benchmark_is_refused_with_those_there_are():
    with pytest.raises(ValueError, match=r"build, .*rasterize"):
        main(["nonsense"])
