"""Stills through Open Image Denoise: what goes in, what comes out, and what happens without it."""

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from drgs.render.film.denoise.oidn import denoise_oidn
from drgs.render.records import Frame, RenderSettings
from drgs.render.render_cameras import render_cameras
from drgs.render.render_frame import render_frame
from drgs.scene.posed_scene import PosedScene
from tests.render.closed_form_scenes import constant_sky, front_camera, sphere_mesh, sunny_sky, two_spheres


def noisy_frame(samples: int = 16) -> Frame:
    scene = PosedScene(None, sphere_mesh(roughness=0.4, metallic=0.5), sunny_sky(sun=20.0))
    return render_frame(scene, front_camera(32), RenderSettings(samples_per_pixel=samples))


def test_pictures_and_guides_go_in_multiplied_by_coverage_and_come_out_divided(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []

    def remember(color: np.ndarray, hdr: bool, **guides: np.ndarray) -> np.ndarray:
        calls.append((color.copy(), hdr, guides))
        return color.copy()

    monkeypatch.setitem(sys.modules, "pyoidn", SimpleNamespace(denoise=remember))
    frame = noisy_frame()
    edge = (frame.gbuffer.coverage > 0) & (frame.gbuffer.coverage < 1)
    assert bool(edge.any())
    shown = denoise_oidn(frame.radiance, frame.gbuffer)
    covered = frame.gbuffer.coverage > 0
    for name, (color, hdr, guides) in zip(("diffuse", "specular"), calls, strict=True):
        given = getattr(frame.radiance, name)
        assert hdr and sorted(guides) == ["albedo", "normal"]
        np.testing.assert_allclose(color, (given * frame.gbuffer.coverage[..., None]).numpy(), rtol=1e-6)
        torch.testing.assert_close(getattr(shown, name)[covered], given[covered])
        assert float(getattr(shown, name)[~covered].abs().max()) == 0.0


def test_a_part_without_light_is_not_filtered(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []
    monkeypatch.setitem(sys.modules, "pyoidn", SimpleNamespace(denoise=lambda color, **_: calls.append(color) or color))
    frame = noisy_frame()
    denoise_oidn(replace(frame.radiance, diffuse=torch.zeros_like(frame.radiance.diffuse)), frame.gbuffer)
    assert len(calls) == 1


def test_without_the_package_the_sentence_names_the_extra_before_any_ray(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "pyoidn", None)  # what an import then says
    scene = PosedScene(None, sphere_mesh(1), constant_sky())
    with pytest.raises(ValueError, match=r"needs the package pyoidn; install it with: .*\[oidn\]"):
        render_cameras(scene, [front_camera(8)], tmp_path / "out", RenderSettings(denoise="oidn"))
    assert not (tmp_path / "out").exists()


def test_a_failing_library_ends_in_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> np.ndarray:
        raise RuntimeError("OIDN filter execution failed (error 5)")

    monkeypatch.setitem(sys.modules, "pyoidn", SimpleNamespace(denoise=fail))
    frame = noisy_frame()
    with pytest.raises(ValueError, match=r"oidn failed: .*error 5"):
        denoise_oidn(frame.radiance, frame.gbuffer)


def test_a_still_comes_nearer_to_the_truth() -> None:
    pytest.importorskip("pyoidn", reason="the extra oidn is not installed")
    scene = PosedScene(None, two_spheres(roughness=0.5, metallic=0.5), sunny_sky(sun=200.0))
    noisy, truth = (render_frame(scene, front_camera(64, 8.0), RenderSettings(samples, seed=samples)) for samples in (8, 1024))
    shown = denoise_oidn(noisy.radiance, noisy.gbuffer)
    inside = (truth.gbuffer.coverage == 1) & (noisy.gbuffer.coverage == 1)
    before, after = (
        (linear - truth.radiance_linear)[inside].square().mean() for linear in (noisy.radiance_linear, shown.diffuse + shown.specular)
    )
    assert float(after) < 0.7 * float(before)
