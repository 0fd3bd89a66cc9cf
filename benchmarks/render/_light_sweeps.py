"""Sweeps of light transport over its extremes: what came out, and how far it is from the truth.

Three kinds of truth: the float64 twins of drgs/reference on the same random numbers (estimator, rasteriser); the same picture taken where
rounding is harmless (scale, offset, faulty meshes); conservation of energy under an even sky. Each sweep gives Rows; `stability.py` makes
a page of them, tests/stress asks of small ones that they stay as they are.
"""

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from drgs.reference import shade as twin
from drgs.reference.rasterize_gbuffer import rasterize as rasterize_twin
from drgs.render.film.resolve_frame import resolve_frame
from drgs.render.integrate.choose_integrator import choose_integrator
from drgs.render.integrate.environment_table import build_environment_table, environment_light
from drgs.render.integrate.integrator import IntegratorSettings
from drgs.render.intersect.horizon import Horizons
from drgs.render.intersect.trace_rays import build_tracer
from drgs.render.progressive.refine import refine_frame
from drgs.render.progressive.start_frame import start_frame
from drgs.render.records import DenoiseMethod, RayStarts, RenderSettings, SampleCounts, ShadedPoints, ShadingPoints
from drgs.render.visible.rasterize import RasterSettings, rasterize
from drgs.render.visible.rasterize.near_plane import near_plane_of
from drgs.scene.camera import Camera
from drgs.scene.environment import Environment
from drgs.scene.gaussians import surfel_tangents
from drgs.scene.materials import Materials
from drgs.scene.mesh import TriangleMesh
from drgs.scene.posed_scene import PosedScene, PosedSurfels
from tests.reconstruct.surfel_spheres import surfel_sphere
from tests.render.closed_form_scenes import constant_sky, front_camera, points_seen_at, sphere_mesh, sunny_sky, two_spheres

ANGLES = [0.0, 30.0, 60.0, 80.0, 89.0, 89.9, 89.99]
ROUGHNESS = [0.0, 0.03, 0.1, 0.3, 0.5, 0.7, 1.0]
SUNS = [1.0, 1e2, 1e4, 1e6]
SCALES = [1e-3, 1e-2, 1e2, 1e4]
OFFSETS = [1.0, 1e2, 1e3, 1e4, 1e5]
DARK_SHARE = 1e-3
"""Of a row's mean radiance; added to the truth before an error is divided by it."""


@dataclass(frozen=True)
class Row:
    """What became of one case."""

    case: str
    max_error: float | None = None
    """Relative; None where there is nothing to compare with."""
    mean_error: float | None = None
    not_finite: int = 0
    """Values of all pictures or estimates of the case that are NaN or infinite."""
    energy: float | None = None
    """Largest share of the light that comes back, where no more than 1 may."""
    refused: str | None = None
    """The sentence, where the product says no."""


def compared(case: str, found: Tensor, truth: Tensor, energy: float | None = None) -> Row:
    """Errors of (..., channel) values, relative to the truth plus a small share of its mean."""
    error = (found.double() - truth.double()).abs() / (truth.double().abs() + DARK_SHARE * truth.double().abs().mean()).clamp(min=1e-300)
    finite = torch.isfinite(found)
    error = error[finite]
    largest, mean = (float(error.max()), float(error.mean())) if error.numel() else (0.0, 0.0)
    return Row(case, largest, mean, int((~finite).sum()), energy)


def refusal(case: str, attempt: Callable[[], object]) -> Row:
    """The sentence with which an attempt ends; a row without one if it succeeds."""
    try:
        attempt()
    except ValueError as error:
        return Row(case, refused=str(error))
    return Row(case)


# The estimator at single points, nothing in the way.


def estimate(points: ShadingPoints, sky: Environment, counts: SampleCounts, bounces: int = 0, seed: int = 3) -> ShadedPoints:
    starts = RayStarts(points.position_world + 100 * points.normal_world, points.normal_world)
    light = environment_light(build_environment_table(sky))
    integrator = choose_integrator(build_tracer(sphere_mesh(1, radius=1e-3)))
    return integrator.shade(points, starts, light, IntegratorSettings(counts, bounces, seed))


def against_twin(case: str, points: ShadingPoints, sky: Environment, counts: SampleCounts | None = None, seed: int = 3) -> Row:
    """The float32 kernels and the float64 twin, same points, same light, same random numbers."""
    counts = counts or SampleCounts(16, 8, 8)
    found = estimate(points, sky, counts, seed=seed)
    exact = ShadingPoints(*(t.double() if t.is_floating_point() else t for t in vars(points).values()))
    starts = RayStarts(exact.position_world + 100 * exact.normal_world, exact.normal_world)
    sky64, tracer = Environment(sky.radiance.double()), build_tracer(sphere_mesh(1, radius=1e-3))
    diffuse, specular = twin.shade(exact, starts, sky64, build_environment_table(sky64), tracer, IntegratorSettings(counts, seed=seed))
    row = compared(case, found.diffuse + found.specular, diffuse + specular)
    others = sum(int((~torch.isfinite(t)).sum()) for t in (found.variance, found.visibility))
    return dataclasses.replace(row, not_finite=row.not_finite + others)


def joined(parts: list[ShadingPoints]) -> ShadingPoints:
    """All points together, renumbered."""
    points = ShadingPoints(*(torch.cat([getattr(part, name) for part in parts]) for name in vars(parts[0])))
    return dataclasses.replace(points, pixel=torch.arange(len(points.pixel)).int())


def roughness_rows(copies: int, height: int = 64) -> list[Row]:
    sky = sunny_sky(height)
    return [
        against_twin(f"roughness {r:g}", joined([points_seen_at(ANGLES, roughness=r, metallic=m, copies=copies) for m in (0, 0.5, 1)]), sky)
        for r in ROUGHNESS
    ]


def angle_rows(copies: int, height: int = 64) -> list[Row]:
    sky = sunny_sky(height)
    return [
        against_twin(
            f"seen at {angle:g}°",
            joined([points_seen_at([angle], roughness=r, metallic=m, copies=copies) for m in (0, 1) for r in (0.0, 0.2, 1.0)]),
            sky,
        )
        for angle in ANGLES
    ]


def light_rows(copies: int, height: int = 64) -> list[Row]:
    points = joined([points_seen_at([20.0, 70.0, 89.0], roughness=r, metallic=0.5, copies=copies) for r in (0.0, 0.2, 0.9)])
    rows = [against_twin(f"brightest texel {sun:g}", points, sunny_sky(height, sun)) for sun in SUNS]
    one = torch.zeros(height, 2 * height, 3)
    one[height // 4, height // 2] = 1e6
    rows.append(against_twin("sun of one texel, 1e6, in a black sky", points, Environment(one)))
    pole = torch.zeros(height, 2 * height, 3)
    pole[0, 0] = 1e6
    rows.append(against_twin("sun of one texel at the pole", points, Environment(pole)))
    rows += [against_twin(f"even sky of {value:g}", points, constant_sky(value, height)) for value in (1.0, 1e-12, 1e-30, 1e12)]
    rows.append(against_twin("black sky", points, constant_sky(0.0, height)))
    rows.append(against_twin("sky of 4×2 texels", points, sunny_sky(2)))
    return rows


def large_sky_row(height: int, copies: int = 20) -> Row:
    """A sky of noise with a sun of 1e6, `height` texels high."""
    points = joined([points_seen_at([20.0, 70.0], roughness=r, metallic=0.5, copies=copies) for r in (0.0, 0.2, 0.9)])
    return against_twin(f"sky of {2 * height}×{height}, brightest texel 1e6", points, sunny_sky(height, 1e6))


# Energy under an even sky of 1.


def furnace_rows(samples: int, copies: int) -> list[Row]:
    """White surfaces. Metal may return no more than what comes; of dielectrics each part by itself."""
    rows, counts = [], SampleCounts(samples // 4, samples // 2, samples // 4)
    for r in ROUGHNESS:
        metal, paint = (
            estimate(points_seen_at(ANGLES, albedo=1.0, roughness=r, metallic=m, copies=copies), constant_sky(), counts) for m in (1.0, 0.0)
        )
        for name, light in (("metal", metal.specular), ("dielectric, diffuse", paint.diffuse), ("dielectric, specular", paint.specular)):
            of_angles = light.reshape(len(ANGLES), copies, 3).mean(1)
            rows.append(
                Row(f"white {name}, roughness {r:g}", not_finite=int((~torch.isfinite(light)).sum()), energy=float(of_angles.max()))
            )
    for bounces in (1, 8):
        mesh = two_spheres(albedo=1.0, roughness=0.3, metallic=1.0)
        linear = picture(PosedScene(None, mesh, constant_sky()), front_camera(16, 8.0), bounces=bounces, samples=samples)
        finite = int((~torch.isfinite(linear)).sum())
        rows.append(Row(f"two white metal spheres, {bounces} bounces, mean", not_finite=finite, energy=float(covered_mean(linear))))
    return rows


def covered_mean(linear: Tensor) -> Tensor:
    return linear[linear.sum(-1) > 0].mean()


# Whole pictures.


def picture(
    scene: PosedScene, camera: Camera, bounces: int = 1, samples: int = 64, denoise: DenoiseMethod = "none", horizons: bool = False
) -> Tensor:
    """(height, width, 3) linear radiance.

    Args:
        horizons: look at all faces first, as long sessions end up doing.
    """
    tracer = build_tracer(scene.mesh)
    if horizons:
        tracer.horizons = Horizons(scene.mesh, tracer.lift)
        tracer.horizons.find(tracer.horizons.faces)
    state = start_frame(scene, camera, RenderSettings(samples_per_pixel=samples, bounces=bounces, denoise=denoise), tracer)
    per_pass = state.plan.counts.total or samples
    return resolve_frame(refine_frame(state, max(1, samples // per_pass))).radiance_linear


def moved(mesh: TriangleMesh, scale: float, offset: Tensor) -> TriangleMesh:
    return dataclasses.replace(mesh, vertices=(mesh.vertices.double() * scale + offset).float())


def moved_camera(camera: Camera, scale: float, offset: Tensor) -> Camera:
    pose = camera.camera_from_world.double().clone()
    center = -pose[:3, :3].T @ pose[:3, 3] * scale + offset
    pose[:3, 3] = -pose[:3, :3] @ center
    return dataclasses.replace(camera, camera_from_world=pose.float())


def picture_row(case: str, scene: PosedScene, camera: Camera, truth: Tensor) -> Row:
    """A picture with all horizons known, and finite also when denoised."""
    row = compared(case, picture(scene, camera, horizons=True), truth)
    filtered = picture(scene, camera, denoise="svgf")
    return dataclasses.replace(row, not_finite=row.not_finite + int((~torch.isfinite(filtered)).sum()))


def placement_rows(size: int) -> list[Row]:
    """The same scene, larger, smaller and elsewhere; two spheres of radius 1."""
    mesh, camera, sky = two_spheres(roughness=0.3, metallic=0.5), front_camera(size, 8.0), sunny_sky(sun=30.0)
    truth = picture(PosedScene(None, mesh, sky), camera)
    places = [(f"scale {scale:g}", scale, torch.zeros(3, dtype=torch.float64)) for scale in SCALES]
    places += [(f"{offset:g} from the origin", 1.0, offset * torch.tensor([1, -0.7, 0.3], dtype=torch.float64)) for offset in OFFSETS]
    return [
        picture_row(case, PosedScene(None, moved(mesh, scale, offset), sky), moved_camera(camera, scale, offset), truth)
        for case, scale, offset in places
    ]


def mesh_rows(size: int) -> list[Row]:
    """Meshes that are no closed surfaces."""
    mesh, camera, sky = two_spheres(roughness=0.3, metallic=0.5), front_camera(size, 8.0), sunny_sky(sun=30.0)
    truth = picture(PosedScene(None, mesh, sky), camera)

    def with_faces(extra: Tensor) -> TriangleMesh:
        return dataclasses.replace(mesh, faces=torch.cat([mesh.faces, extra.int()]).contiguous())

    def row(case: str, changed: TriangleMesh, to: Tensor | None = None) -> Row:
        scene = PosedScene(None, changed, sky)
        return picture_row(case, scene, camera, picture(scene, camera) if to is None else to)

    flat = mesh.faces[:1].repeat(3, 1)
    flat[0, 1] = flat[0, 0]
    flat[1] = flat[1, 0]
    flat[2, 2] = flat[2, 1]
    fins = torch.tensor([[0, 1, 50], [0, 1, 60], [0, 1, 400]])
    above = mesh.vertices[mesh.faces.long()].mean(1)[:, 2] < 0.3
    inward = dataclasses.replace(mesh, normals=-mesh.normals)
    noise = torch.nn.functional.normalize(torch.randn(mesh.normals.shape, generator=torch.Generator().manual_seed(1)), dim=-1)
    return [
        row("triangles without area added", with_faces(flat), truth),
        row("every triangle twice", with_faces(mesh.faces), truth),
        row("every triangle twice, once turned over", with_faces(mesh.faces[:, [0, 2, 1]]), truth),
        row("three more triangles at one edge", with_faces(fins)),
        row("open: tops cut off", dataclasses.replace(mesh, faces=mesh.faces[above].contiguous())),
        row("no triangles", dataclasses.replace(mesh, faces=mesh.faces[:0]), torch.zeros_like(truth)),
        row("vertex normals that point inwards", inward, torch.zeros_like(truth)),
        row("vertex normals at random", dataclasses.replace(mesh, normals=noise)),
        row("vertex normals of length 0", dataclasses.replace(mesh, normals=torch.zeros_like(mesh.normals)), torch.zeros_like(truth)),
    ]


def image_rows() -> list[Row]:
    """Pictures of one pixel, and of none."""
    scene, camera = PosedScene(None, two_spheres(), sunny_sky()), front_camera(1, 8.0, field_of_view=0.2)
    rows = []
    for width, height in ((1, 1), (1, 7), (17, 1)):
        linear = picture(scene, dataclasses.replace(camera, width=width, height=height), denoise="svgf")
        rows.append(Row(f"picture of {width}×{height}", not_finite=int((~torch.isfinite(linear)).sum())))
    for width, height in ((0, 0), (0, 4), (3, 0)):
        empty = dataclasses.replace(camera, width=width, height=height)
        rows.append(refusal(f"picture of {width}×{height}", partial(picture, scene, empty)))
    return rows


def refused_rows() -> list[Row]:
    """What is refused, and the sentence."""
    mesh, camera, sky = two_spheres(), front_camera(8, 8.0), sunny_sky()
    nowhere = torch.zeros(3, dtype=torch.float64)
    rows = []
    for case, value in (("NaN", math.nan), ("infinite", math.inf), ("negative", -1.0), ("1e20", 1e20)):
        radiance = sky.radiance.clone()
        radiance[3, 7, 1] = value
        rows.append(refusal(f"a texel that is {case}", partial(picture, PosedScene(None, mesh, Environment(radiance)), camera)))
    hole = mesh.vertices.clone()
    hole[5, 1] = math.nan
    rows.append(refusal("a vertex that is NaN", lambda: build_tracer(dataclasses.replace(mesh, vertices=hole))))
    for scale in (1e-9, 1e12):
        rows.append(refusal(f"scale {scale:g}", partial(build_tracer, moved(mesh, scale, nowhere))))
    rows.append(refusal("1e6 from the origin", lambda: build_tracer(moved(mesh, 1.0, nowhere + 1e6))))
    return rows


# Surfels.


def surfel_ball(count: int, opacity: float) -> PosedSurfels:
    ball = surfel_sphere(count)
    shade_of_red = torch.tensor([0.7, 0.3, 0.2]).expand(count, 3).contiguous()
    materials = Materials(shade_of_red, torch.linspace(0, 1, count), torch.linspace(1, 0, count))
    return PosedSurfels(ball.centers, surfel_tangents(ball), torch.full((count,), opacity), materials)


def crosses(surfels: PosedSurfels) -> Tensor:
    """(surfel,) areas spanned by the tangents."""
    return torch.linalg.cross(surfels.tangents[:, :, 0].double(), surfels.tangents[:, :, 1].double()).norm(dim=-1)


def surfel_rows(count: int, size: int) -> list[Row]:
    """Maps of the rasteriser against its float64 twin; and the frame from them is finite."""
    camera, ball = front_camera(size), surfel_ball(count, 0.9)
    middle = dataclasses.replace(ball, centers=torch.zeros_like(ball.centers), tangents=ball.tangents[:1].repeat(count, 1, 1))
    edge_on = dataclasses.replace(ball, tangents=torch.tensor([[0.1, 0], [0, 0.1], [0, 0]]).roll(1, 0).repeat(count, 1, 1))
    origin = torch.tensor([1.0, -0.7, 0.3], dtype=torch.float64)

    def placed(scale: float, offset: float) -> tuple[PosedSurfels, Camera]:
        at = offset * origin
        centers = (ball.centers.double() * scale + at).float()
        return dataclasses.replace(ball, centers=centers, tangents=scale * ball.tangents), moved_camera(camera, scale, at)

    cases = {
        "surfels of opacity 0": (dataclasses.replace(ball, opacities=torch.zeros(count)), camera),
        "surfels of opacity 1": (dataclasses.replace(ball, opacities=torch.ones(count)), camera),
        "surfels of opacity 0.004": (dataclasses.replace(ball, opacities=torch.full((count,), 0.004)), camera),
        "surfels all at one place": (middle, camera),
        "surfels facing away": (dataclasses.replace(ball, tangents=ball.tangents.flip(-1)), camera),
        "surfels seen edge on": (edge_on, camera),
        "surfels without area": (dataclasses.replace(ball, tangents=torch.zeros_like(ball.tangents)), camera),
        "surfels of the size of the picture": (dataclasses.replace(ball, tangents=100 * ball.tangents), camera),
    }
    cases |= {f"surfels, scale {scale:g}": placed(scale, 0.0) for scale in (1e-3, 1e2, 1e4)}
    cases |= {f"surfels {offset:g} from the origin": placed(1.0, offset) for offset in (1e2, 1e3)}
    rows = []
    whole = picture(PosedScene(ball, sphere_mesh(3, radius=0.97), sunny_sky()), camera, samples=32)
    for scale in (1e-3, 1e4):
        small, seen_by = placed(scale, 0.0)
        mesh = sphere_mesh(3, radius=0.97 * scale)
        rows.append(
            compared(f"frame of surfels, scale {scale:g}", picture(PosedScene(small, mesh, sunny_sky()), seen_by, samples=32), whole)
        )
    for case, (surfels, seen_by) in cases.items():
        shown = (crosses(surfels) > 0).nonzero().squeeze(-1)  # the kernel drops surfels without area, the twin knows no such rule
        settings = RasterSettings(near=near_plane_of(surfels.centers))
        found = rasterize(surfels.centers, surfels.tangents, surfels.opacities, surfels.materials.albedo, seen_by, settings)
        centers, tangents = surfels.centers[shown].double(), surfels.tangents[shown].double()
        opacities, albedo = surfels.opacities[shown].double(), surfels.materials.albedo[shown].double()
        exact = rasterize_twin(centers, tangents, opacities, albedo, seen_by, settings)
        row = compared(case, torch.cat([found.features, found.coverage[None]]), torch.cat([exact.features, exact.coverage[None]]))
        sky = sunny_sky()
        frame = picture(PosedScene(surfels, sphere_mesh(3, radius=0.97), sky), seen_by, samples=32, denoise="svgf")
        rows.append(dataclasses.replace(row, not_finite=row.not_finite + int((~torch.isfinite(frame)).sum())))
    return rows
