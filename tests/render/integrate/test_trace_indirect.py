"""Where paths go on from a hit: the kernel against its float64 twin, path by path."""

import pytest
import torch
import warp as wp

from drgs.maths.constants import VOID_BEYOND
from drgs.reference.mesh_surface import mesh_in, surfaces_at
from drgs.reference.sample_rays import split_at, strategy_of, strategy_seed
from drgs.reference.scatter_hits import PathSamples
from drgs.reference.scatter_hits import scatter_hits as twin
from drgs.render.integrate.environment_table import build_environment_table, environment_light
from drgs.render.integrate.path_arrays import PathArrays
from drgs.render.integrate.ray_scene import ray_scene
from drgs.render.integrate.sample_arrays import point_arrays, sample_set
from drgs.render.integrate.trace_indirect import ScatteredRays, scatter_hits
from drgs.render.intersect.trace_rays import build_tracer
from drgs.render.records import SampleCounts, ShadingPoints
from drgs.scene.environment import Environment
from drgs.warp_torch import warp_array
from tests.render.closed_form_scenes import constant_sky, crumpled_mesh, on_device, points_seen_at, sunny_sky

PATHS, FIRST_POINT, COUNTS, SEED, ROUND = 635, 3, SampleCounts(7, 3, 5), 11, 3


def some_paths(point_count: int) -> tuple[torch.Tensor, ...]:
    """First rays, faces, barycentric weights, directions of arrival, from behind too, and throughputs."""
    mesh, numbers = crumpled_mesh(), torch.Generator().manual_seed(4)
    face = torch.randint(len(mesh.faces), (PATHS,), generator=numbers, dtype=torch.int32)
    normal = torch.nn.functional.normalize(mesh.vertices[mesh.faces[face.long()].long()].mean(1), dim=-1)
    arriving = torch.nn.functional.normalize(-normal + 1.2 * torch.randn(PATHS, 3, generator=numbers), dim=-1)
    ray = torch.sort(torch.randint((point_count - FIRST_POINT) * COUNTS.total, (PATHS,), generator=numbers)).values
    return ray, face, 0.5 * torch.rand(PATHS, 2, generator=numbers), arriving, torch.rand(PATHS, 3, generator=numbers)


def scattered_by_kernel(
    paths: tuple[torch.Tensor, ...], points: ShadingPoints, sky: Environment, horizon: torch.Tensor | None, depth: int, device: str
) -> list[torch.Tensor]:
    """Origins, directions and contributions (2 path, 3), and throughputs (path, 3)."""
    arrays, scattered = PathArrays(), ScatteredRays()
    for name, values in zip(("ray", "face", "barycentric", "arriving", "throughput"), paths, strict=True):
        kind = {1: None, 2: wp.vec2 if values.shape[-1] == 2 else wp.vec3}[values.dim()]
        setattr(arrays, name, warp_array(values.to(device), kind))
    out = [torch.full((count, 3), -7.0, device=device) for count in (2 * PATHS, 2 * PATHS, 2 * PATHS, PATHS)]
    for name, values in zip(("origin", "direction", "contribution", "throughput"), out, strict=True):
        setattr(scattered, name, warp_array(values, wp.vec3))
    there = ShadingPoints(*(values.to(device) for values in vars(points).values()))
    light = environment_light(build_environment_table(Environment(sky.radiance.to(device))))
    tracer = build_tracer(on_device(crumpled_mesh(), device))
    scene = ray_scene(light, tracer, None if horizon is None else horizon.to(device))
    samples = sample_set(COUNTS, SEED, ROUND, by_material=True)
    inputs = [arrays, PATHS, FIRST_POINT, depth, point_arrays(there), scene, samples]
    wp.launch(scatter_hits, dim=PATHS, inputs=inputs, outputs=[scattered], device=device)
    return [values.cpu() for values in out]


@pytest.mark.parametrize("depth", [0, 1, 4])
@pytest.mark.parametrize("sky", [sunny_sky(sun=1e3), constant_sky(0.0)], ids=["sunny", "black"])
def test_the_kernel_scatters_as_its_twin_does(depth: int, sky: Environment, device: str) -> None:
    points = points_seen_at([0.0, 45.0], roughness=0.3, metallic=0.4, copies=40)
    paths = ray, face, barycentric, arriving, throughput = some_paths(len(points.pixel))
    origin, direction, contribution, carried = scattered_by_kernel(paths, points, sky, None, depth, device)

    exact = Environment(sky.radiance.double())
    x = surfaces_at(mesh_in(torch.float64, crumpled_mesh()), face, barycentric.double())
    point = FIRST_POINT + ray // COUNTS.total
    strategy, index = strategy_of(split_at(points, COUNTS, by_material=True)[point], ROUND, ray % COUNTS.total)
    samples = PathSamples(strategy_seed(points.pixel[point], strategy, SEED), index)
    rays = twin(x, -arriving.double(), throughput.double(), samples, depth, exact, build_environment_table(exact))

    is_void = origin.abs().amax(-1) > VOID_BEYOND
    for half, expected in zip((slice(0, PATHS), slice(PATHS, None)), rays, strict=True):
        live = expected.contribution.amax(-1) > 0 if float(sky.radiance.max()) > 0 else ~is_void[half]
        assert 0.2 < float(live.double().mean()) < 0.9
        assert float((is_void[half] == ~live).double().mean()) > 0.995
        same = live & ((direction[half].double() - expected.direction).norm(dim=-1) < 1e-3)
        assert float(same.sum() / live.sum()) > 0.99  # rounding may choose the other lobe
        torch.testing.assert_close(origin[half][same], (x.position + build_tracer(crumpled_mesh()).lift * x.face_normal)[same].float())
        assert float(relative_error(contribution[half], expected.contribution)[same].quantile(0.98)) < 2e-3
        assert float(contribution[half][~live].abs().max()) < 1e-3 * max(1.0, float(contribution.max()))
    assert float(relative_error(carried, rays[1].throughput)[same].quantile(0.98)) < 2e-3
    goes_on = rays[1].throughput[same].amax(-1) > 0
    assert float(goes_on.double().mean()) > 0.99 if depth == 0 else 0.1 < float(goes_on.double().mean()) < 0.99


def test_rays_above_a_horizon_leave_from_outside(device: str) -> None:
    points, numbers = points_seen_at([0.0, 45.0], copies=40), torch.Generator().manual_seed(2)
    paths, mesh = some_paths(len(points.pixel)), crumpled_mesh()
    horizon = 2 * torch.rand(len(mesh.faces), 8, generator=numbers)
    free = scattered_by_kernel(paths, points, sunny_sky(), None, 0, device)
    spared = scattered_by_kernel(paths, points, sunny_sky(), horizon, 0, device)
    for a, b in zip(free[1:], spared[1:], strict=True):
        assert torch.equal(a, b)  # they bring what they bring, traced or not
    outside, void = (rays[0].abs().amax(-1) > VOID_BEYOND for rays in (spared, free))
    assert bool(outside[void].all()) and 0.2 < float(outside[~void].double().mean()) < 0.9


def relative_error(found: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    """(path,) largest of the channels."""
    error = (found.double() - truth).abs() / (truth.abs() + 1e-3 * truth.abs().mean() + 1e-6)
    return error.amax(-1)
