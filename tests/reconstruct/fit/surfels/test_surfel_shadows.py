"""Where light turns with the camera, surfels cast shadows in stage 1: those of the mesh around them, at the vertex nearest to each."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from drgs.reconstruct.capture.initial_points import InitialPoints, initial_points
from drgs.reconstruct.capture.load_views import load_views
from drgs.reconstruct.capture.turning_light import with_light_of_camera
from drgs.reconstruct.checkpoints import fit_tensors, read_tensors, restore_fit, write_tensors
from drgs.reconstruct.fit.densify import DensifySettings
from drgs.reconstruct.fit.fit_loop import FitState
from drgs.reconstruct.fit.light.split_sum import ENVIRONMENT_SIZE, filter_environment, texel_directions
from drgs.reconstruct.fit.light.turned_light import arriving_share, seen_sky
from drgs.reconstruct.fit.surfels.fit_gaussians import FitSettings, fit_gaussians, start_fit
from drgs.reconstruct.fit.surfels.render_stage_one import render_stage_one
from drgs.reconstruct.fit.surfels.surfel_shadows import UNPAINTED, SurfelShadows, shadows_of_surfels
from drgs.scene.camera import Camera
from drgs.scene.views import Views
from tests.one_torch_thread import one_torch_thread  # noqa: F401
from tests.reconstruct.capture.test_find_hollows import paint, photographed, tracer_of
from tests.reconstruct.fit.light.test_turned_light import TURN, smooth_sky
from tests.reconstruct.tiny_capture import write_nerf_synthetic

CPU = torch.device("cpu")
SHORT = FitSettings(iterations=24, densify=DensifySettings(every=5, growth=0.2, budget=420), seed=3)
CENTER, RADIUS = torch.zeros(3), 1.0
PLATE_HEIGHT, BALL_RADIUS = -0.3, 0.3


def ball_over_plate() -> trimesh.Trimesh:
    plate = trimesh.creation.cylinder(radius=0.8, height=0.2)
    plate.apply_translation((0, 0, PLATE_HEIGHT - 0.1))
    ball = trimesh.creation.icosphere(3, radius=BALL_RADIUS)
    ball.apply_translation((0, 0, 0.15))
    return trimesh.util.concatenate([plate, ball])


@pytest.fixture(scope="module")
def over_plate() -> tuple[dict[str, Tensor], tuple[Camera, ...]]:
    """Surfels on it, and cameras around."""
    shape = ball_over_plate()
    places, face = trimesh.sample.sample_surface(shape, 6000, seed=0)
    points, normals = (torch.from_numpy(np.asarray(x, np.float32)) for x in (places, shape.face_normals[face]))
    grey = torch.full_like(points, 0.5)
    initial = InitialPoints(points, normals, grey, CENTER, RADIUS, "hull", None, None)
    cameras = photographed(tracer_of(shape), paint, count=32, side=144).cameras
    return start_fit(initial, FitSettings(), CPU).parameters, cameras


def lamp_above() -> Tensor:
    """Tables of a broad one."""
    upward = texel_directions(ENVIRONMENT_SIZE[0])[..., 2:]
    return filter_environment((upward.clamp(min=0) ** 8 * 10 + 0.01).expand(-1, -1, 3).contiguous())


def test_the_plate_under_the_ball_lies_in_its_shadow_which_wanders_with_the_light(
    over_plate: tuple[dict[str, Tensor], tuple[Camera, ...]],
) -> None:
    parameters, cameras = over_plate
    shadows = shadows_of_surfels(parameters, cameras, CENTER, RADIUS)
    assert shadows is not None and len(shadows.nearest) == 6000
    centers, albedo = parameters["centers"].detach(), torch.sigmoid(parameters["albedo_logits"].detach())
    on_plate = (centers[:, 2] - PLATE_HEIGHT).abs() < 1e-3
    out = centers[:, :2].norm(dim=1)
    tilt = math.radians(40)
    tilted = torch.tensor([[math.cos(tilt), 0, -math.sin(tilt)], [0, 1, 0], [math.sin(tilt), 0, math.cos(tilt)]])
    still, turned = (shadows.share(albedo, lamp_above(), turn)[:, 0] for turn in (torch.eye(3), tilted))
    under, open_ = on_plate & (out < 0.15), on_plate & (out > 0.6)
    assert float(still[under].mean()) < 0.45 and float(still[open_].mean()) > 0.85
    # The lamp that light_from_world turns upright stands towards +x: the shadow falls to -x.
    assert float(turned[under].mean()) > float(still[under].mean()) + 0.1
    beside = on_plate & (centers[:, 0] < -0.3) & (centers[:, 0] > -0.5) & (centers[:, 1].abs() < 0.15)
    assert float(turned[beside].mean()) < float(still[beside].mean()) - 0.1


def test_shares_are_those_of_the_nearest_vertices_painted_as_surfels_are() -> None:
    tracer = tracer_of(ball_over_plate())
    random = torch.Generator().manual_seed(0)
    vertices, count = tracer.mesh.vertices, 400
    chosen = torch.randint(len(vertices), (count,), generator=random)
    centers, albedo = vertices[chosen] + 1e-4 * torch.randn(count, 3, generator=random), torch.rand(count, 3, generator=random)
    shadows = SurfelShadows(vertices, tracer.mesh.faces, torch.zeros(1, dtype=torch.long)).of_surfels(centers)
    assert torch.equal(vertices[shadows.nearest], vertices[chosen]), "vertices that coincide may stand for each other"
    painted = torch.full_like(vertices, UNPAINTED)
    for vertex in shadows.nearest.unique():
        painted[vertex] = albedo[shadows.nearest == vertex].mean(0)
    tables = filter_environment(smooth_sky().radiance)
    expected = arriving_share(seen_sky(tracer), painted, tables, TURN)[shadows.nearest]
    torch.testing.assert_close(shadows.share(albedo, tables, TURN), expected, atol=1e-5, rtol=0)


def test_what_is_in_the_shade_is_drawn_darker_and_the_rest_to_the_bit(over_plate: tuple[dict[str, Tensor], tuple[Camera, ...]]) -> None:
    parameters, cameras = over_plate
    tables = lamp_above()
    share = torch.ones(6000, 3)
    shaded = parameters["centers"].detach()[:, 2] > 0
    share[shaded] = 0.5
    plain, unshaded, half = (
        render_stage_one(parameters, tables, cameras[4], 0.01, 0, torch.eye(3), given).radiance_linear.detach()
        for given in (None, torch.ones(6000, 3), share)
    )
    assert torch.equal(plain, unshaded)
    darker = (half < 0.9 * plain).any(-1)
    assert 0.02 < float(darker.float().mean()) < 0.5
    assert bool((half <= plain + 1e-6).all())


@pytest.fixture(scope="module")
def turning(tmp_path_factory: pytest.TempPathFactory) -> Views:
    views = load_views(write_nerf_synthetic(tmp_path_factory.mktemp("capture")))
    views = dataclasses.replace(views, cameras=views.cameras[::2], images_srgb=views.images_srgb[::2], coverage=views.coverage[::2])
    return with_light_of_camera(views)


@pytest.fixture(scope="module")
def points(turning: Views) -> InitialPoints:
    return initial_points(turning, 300, seed=0)


def fitted(views: Views, points: InitialPoints, stop_at: int | None = None, state: FitState | None = None) -> FitState:
    state = start_fit(points, SHORT, CPU) if state is None else state
    stops = lambda: stop_at is not None and state.iteration >= stop_at  # noqa: E731
    return fit_gaussians(views, state, SHORT, points.bounds_radius, None, stops, points.bounds_center)


@pytest.fixture(scope="module")
def through(turning: Views, points: InitialPoints) -> FitState:
    """A fit that never stopped."""
    return fitted(turning, points)


@pytest.mark.slow
def test_shadows_are_looked_at_where_light_turns_and_follow_the_surfels(turning: Views, points: InitialPoints, through: FitState) -> None:
    assert through.shadows is not None and len(through.shadows.nearest) == len(through.parameters["centers"])
    early = fitted(turning, points, stop_at=5)
    assert early.shadows is None
    first = fitted(turning, points, stop_at=7)
    assert first.shadows is not None and not torch.equal(first.shadows.vertices[:50], through.shadows.vertices[:50])
    still = fitted(dataclasses.replace(turning, light_from_world=None), points)
    assert still.shadows is None


@pytest.mark.slow
@pytest.mark.parametrize("stop_at", [8, 13])
def test_a_fit_that_goes_on_has_the_same_shadows(
    turning: Views, points: InitialPoints, through: FitState, stop_at: int, tmp_path: Path
) -> None:
    write_tensors(tmp_path / "x", fit_tensors(fitted(turning, points, stop_at)), {})
    resumed = start_fit(points, SHORT, CPU)
    restore_fit(read_tensors(tmp_path / "x", CPU)[0], resumed)
    assert resumed.iteration == stop_at and resumed.shadows is not None
    fitted(turning, points, state=resumed)
    assert resumed.shadows is not None and through.shadows is not None
    assert torch.equal(resumed.shadows.vertices, through.shadows.vertices)
    for name, value in through.parameters.items():
        assert torch.equal(value, resumed.parameters[name]), name
