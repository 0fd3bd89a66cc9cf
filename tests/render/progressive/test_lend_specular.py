"""Rough paint borrows what it mirrors: who borrows, from whom and what; and pictures with it err no more than all these rays would."""

import dataclasses
from typing import Any

import pytest
import torch

from drgs.render.film.resolve_frame import resolve_frame
from drgs.render.integrate.plan import LENT_SPECULAR
from drgs.render.intersect.trace_rays import build_tracer
from drgs.render.progressive.kept_light import shade_moving
from drgs.render.progressive.kept_light.lend_specular import ROUGH_ENOUGH, Lenders, find_lenders, lend_specular
from drgs.render.progressive.kept_light.read_light import READ, TRACED
from drgs.render.progressive.neighbours import LEAST_COSINE, MOST_OFF_PLANE, MOST_UNLIKE, neighbourhood
from drgs.render.progressive.refine import refine_frame
from drgs.render.progressive.see_middles import Middles, see_middles
from drgs.render.progressive.start_frame import start_frame
from drgs.render.records import PrimaryPoints, RenderSettings, ShadedPoints
from drgs.render.visible.image_tiles import tiles_of_mesh
from drgs.warp_torch import warp_array
from tests.render.closed_form_scenes import front_camera, on_device
from tests.render.progressive.test_kept_light import SETTINGS, cameras, fine_spheres, moved_through, scene_of

SIZE = 48


def seen(roughness: torch.Tensor | float = 0.6, metallic: float = 0.0) -> tuple[Middles, float]:
    mesh = fine_spheres()
    mesh = dataclasses.replace(
        mesh, roughness=torch.zeros(len(mesh.vertices)) + roughness, metallic=torch.full_like(mesh.metallic, metallic)
    )
    camera = front_camera(SIZE, distance=8)
    return see_middles(build_tracer(mesh), camera, tiles_of_mesh(mesh, camera)), 1 / float(camera.intrinsics[0, 0])


def made_light(count: int) -> ShadedPoints:
    random = torch.Generator().manual_seed(0)
    diffuse, specular, variance = (torch.rand(count, 3, generator=random) + 0.1 for _ in range(3))
    return ShadedPoints(diffuse, specular, variance, torch.rand(count, generator=random))


def test_three_in_four_borrow_the_mean_of_their_like_and_the_others_keep_their_own() -> None:
    """Against a loop over pixels; a seam of another roughness, a smooth sphere's edge, points that are not read."""
    x = fine_spheres().vertices[:, 0]
    middles, footprint = seen(torch.where(x > 1.2, 0.8, torch.where(x < -1.2, 0.2, 0.5)), 0.1)
    primary, points = middles.primary, middles.primary.points
    count = len(points.pixel)
    verdict = torch.where(torch.rand(count, generator=torch.Generator().manual_seed(1)) < 0.9, int(READ), int(TRACED)).int()
    lenders = find_lenders(primary, verdict, neighbourhood(middles.window, footprint, middles.place))
    light, before = made_light(count), made_light(count)
    lend_specular(lenders, primary, light)
    number = {(int(p) // SIZE, int(p) % SIZE): i for i, p in enumerate(points.pixel)}
    with_rays, borrowers = set(lenders.with_rays.tolist()), set(lenders.borrowers.tolist())
    reflected = points.metallic[:, None] * points.albedo + 0.04 * (1 - points.metallic[:, None])
    assert len(borrowers) > 0.3 * count and not with_rays & borrowers
    for (row, column), i in number.items():
        read = int(verdict[i]) == int(READ)

        def has_rays(j: int) -> bool:
            even = int(points.pixel[j]) // SIZE % 2 == 0 and int(points.pixel[j]) % SIZE % 2 == 0
            return float(points.roughness[j]) < float(ROUGH_ENOUGH) or even

        def alike(j: int, i: int = i) -> bool:
            off = abs(float(points.normal_world[i] @ (points.position_world[j] - points.position_world[i])))
            unlike = max(abs(float(values[i] - values[j])) for values in (points.roughness, points.metallic))
            turned = float(points.normal_world[i] @ points.normal_world[j])
            return (
                off <= float(MOST_OFF_PLANE) * footprint * float(primary.depth[i])
                and unlike <= float(MOST_UNLIKE)
                and turned >= float(LEAST_COSINE)
            )

        beside = [number.get((row + down, column + right)) for down in (-1, 0, 1) for right in (-1, 0, 1) if down or right]
        lent = [j for j in beside if j is not None and int(verdict[j]) == int(READ) and has_rays(j) and alike(j)]
        assert (i in borrowers) == (read and not has_rays(i) and bool(lent))
        assert (i in with_rays) == (read and i not in borrowers)
        if i not in borrowers:
            assert torch.equal(light.specular[i], before.specular[i]) and torch.equal(light.variance[i], before.variance[i])
            continue
        plain = (before.specular[lent] / reflected[lent]).mean(0)
        torch.testing.assert_close(light.specular[i], reflected[i] * plain)
        variance = (before.variance[lent, 2] / reflected[lent].square().mean(-1)).sum() / len(lent) ** 2
        torch.testing.assert_close(light.variance[i, 2], reflected[i].square().mean() * variance)


def test_smooth_paint_has_rays_of_its_own() -> None:
    middles, footprint = seen(0.29)
    verdict = torch.full((len(middles.primary.depth),), int(READ), dtype=torch.int32)
    assert len(find_lenders(middles.primary, verdict, neighbourhood(middles.window, footprint, middles.place)).borrowers) == 0


@pytest.mark.slow
def test_a_moving_picture_errs_no_more_and_names_it(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Within a twentieth of what rays of all points leave."""
    scene, path = scene_of(on_device(fine_spheres(), device)), cameras(24, device)
    lent = moved_through(scene, path, SETTINGS)

    def nobody_lends(primary: PrimaryPoints, verdict: torch.Tensor, there: Any) -> Lenders:
        there.place = warp_array(torch.zeros(1, 1, dtype=torch.int32, device=verdict.device))
        return find_lenders(primary, verdict, there)

    monkeypatch.setattr(shade_moving, "find_lenders", nobody_lends)
    own = moved_through(scene, path, SETTINGS)
    truth = resolve_frame(refine_frame(start_frame(scene, path[-1], RenderSettings(samples_per_pass=16, seed=5)), 64))
    inside = truth.gbuffer.coverage == 1
    errors = []
    for state in (lent, own):
        frame = resolve_frame(state)
        covered = inside & (frame.gbuffer.coverage == 1)
        difference = (frame.radiance_linear - truth.radiance_linear)[covered].square().mean(-1)
        errors.append(float((difference / (truth.radiance_linear[covered].square().mean(-1) + 1e-2)).mean()))
    assert errors[0] < 1.05 * errors[1]
    assert LENT_SPECULAR in lent.plan.skips and LENT_SPECULAR not in refine_frame(lent, 2).plan.skips
