"""Captures without masks: the object is found before its surroundings, and a build of one goes through and resumes."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from drgs.reconstruct.build_asset import BuildSettings, BuildStopped, Progress, build_asset
from drgs.reconstruct.capture import find_masks as find_masks_module
from drgs.reconstruct.capture.find_masks import find_masks, smaller_views
from drgs.reconstruct.capture.initial_points import initial_points
from drgs.reconstruct.capture.load_views import load_views
from drgs.reconstruct.fit.densify import DensifySettings
from drgs.reconstruct.fit.light.environment_pyramid import background_image
from drgs.reconstruct.fit.surfel_parameters import LearningRates
from drgs.reconstruct.fit.surfels.fit_gaussians import FitSettings
from drgs.reconstruct.presets import PRESETS
from drgs.scene.camera import pixel_rays_world
from drgs.scene.environment import uv_from_direction
from drgs.scene.views import Views
from tests.one_torch_thread import one_torch_thread  # noqa: F401
from tests.reconstruct.test_build_asset import WITHOUT_HOLLOWS, asset_tensors
from tests.reconstruct.tiny_capture import FEW_VIEWS, HEIGHT, WIDTH, TinyView, sphere_views, write_nerf_synthetic

CPU = torch.device("cpu")
VIEWS = 16


def before_surroundings(view: TinyView) -> TinyView:
    """The view with stripes behind the object that turn with the direction; no alpha."""
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([(x - WIDTH / 2) / 90.0, (y - HEIGHT / 2) / 90.0, np.ones_like(x)], -1) @ view.camera_from_world[:3, :3]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    behind = 127 + 100 * np.sin(rays @ np.array([[9.0, 2, 0], [0, 8, 3], [5, 0, 7]]))
    alpha = view.rgba[..., 3:] / 255
    picture = view.rgba[..., :3] * alpha + behind * (1 - alpha)
    return TinyView(view.name, np.round(picture).astype(np.uint8), view.camera_from_world)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    views = [before_surroundings(view) for view in sphere_views(VIEWS, square=True)]
    return write_nerf_synthetic(tmp_path_factory.mktemp("unmasked"), views)


@pytest.fixture(scope="module")
def unmasked(folder: Path) -> Views:
    return load_views(folder)


@pytest.mark.slow
def test_the_object_is_found_before_its_surroundings(unmasked: Views, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(find_masks_module, "ITERATIONS", 100)
    assert not unmasked.has_masks
    # In a quarter of the iterations, surfels before the background have to fade the faster.
    settings = FitSettings(rates=LearningRates(opacity_logits=0.2), densify=DensifySettings(every=20))
    found = find_masks(unmasked, initial_points(unmasked, 600, seed=0), settings, CPU)
    assert found is not None and found.has_masks
    truth = torch.from_numpy(np.stack([view.rgba[..., 3] for view in sphere_views(VIEWS, square=True)])) > 127
    masks = torch.stack(found.coverage) > 127
    assert float((masks & truth).sum() / (masks | truth).sum()) > 0.8


def test_the_background_is_looked_up_by_direction(unmasked: Views) -> None:
    logits = torch.randn(1, 3, 8, 16, generator=torch.Generator().manual_seed(0))
    camera = unmasked.cameras[3]
    seen = background_image(logits, camera)
    uv = uv_from_direction(pixel_rays_world(camera)[1])[20, 30]
    x, y = float(uv[0]) * 16 - 0.5, min(max(float(uv[1]) * 8 - 0.5, 0.0), 7.0)
    c, r = int(np.floor(x)), min(int(np.floor(y)), 6)
    fx, fy = x - c, y - r
    table = logits[0]
    top = table[:, r, c % 16] * (1 - fx) + table[:, r, (c + 1) % 16] * fx
    bottom = table[:, r + 1, c % 16] * (1 - fx) + table[:, r + 1, (c + 1) % 16] * fx
    torch.testing.assert_close(seen[20, 30], torch.sigmoid(top * (1 - fy) + bottom * fy), rtol=1e-4, atol=1e-5)


def test_smaller_views_keep_the_mean_and_the_rays(unmasked: Views) -> None:
    small = smaller_views(unmasked, 36)
    assert all(image.shape == (28, 36, 3) for image in small.images_srgb)
    for image, same in zip(unmasked.images_srgb, smaller_views(unmasked, 500).images_srgb, strict=True):
        assert torch.equal(image, same)
    means = [torch.stack(views.images_srgb).float().mean() for views in (small, unmasked)]
    assert abs(float(means[0] - means[1])) < 0.5
    rays = [pixel_rays_world(views.cameras[0])[1].mean((0, 1)) for views in (small, unmasked)]
    torch.testing.assert_close(*rays, rtol=0, atol=1e-3)


@pytest.mark.slow
def test_a_build_without_masks_stops_while_it_looks_and_resumes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = write_nerf_synthetic(tmp_path / "unmasked", [before_surroundings(view) for view in sphere_views(FEW_VIEWS, square=True)])
    monkeypatch.setitem(PRESETS, "tiny", WITHOUT_HOLLOWS)
    monkeypatch.setattr(find_masks_module, "ITERATIONS", 20)
    settings, heard = BuildSettings(preset="tiny", device="cpu"), []
    built = build_asset(folder, tmp_path / "whole", settings, heard.append)
    assert built.provenance["object_found_by"] == "surroundings"
    whole = asset_tensors(built)
    assert any(isinstance(line, Progress) and "looking for the object" in line.message for line in heard)
    with pytest.raises(BuildStopped):
        build_asset(folder, tmp_path / "stopped", settings, should_stop=lambda: True)
    asked = iter(range(10**6))
    with pytest.raises(BuildStopped):  # between two steps of stage 1, after the search
        build_asset(folder, tmp_path / "stopped", settings, should_stop=lambda: next(asked) > 26)
    resumed = asset_tensors(build_asset(folder, tmp_path / "stopped", dataclasses.replace(settings, resume=True)))
    assert whole.keys() == resumed.keys()
    exact = [name for name, value in whole.items() if torch.equal(value, resumed[name])]
    assert any("centers" in name for name in exact)
