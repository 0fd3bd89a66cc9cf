"""Progressive frames: start, refine as often as wished, look at any time.

A pass adds `samples_per_pass` rays to every covered pixel and updates the running sums; passes continue the same
low-discrepancy sequences, so n passes of k samples are as good as one of n k. With the mesh as primary
surface each pass also looks through another place of the pixel. State is a frozen record: refining returns a new one.
"""

import time
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from drgs.render.denoise import denoise
from drgs.render.environment_table import build_environment_table, environment_light
from drgs.render.lift_points import lift_points
from drgs.render.plan import RenderPlan, plan_frame
from drgs.render.rasterize_gbuffer import rasterize_gbuffer
from drgs.render.records import Frame, GBuffer, Radiance
from drgs.render.sample_rays import PointArrays, SampleCounts, point_arrays, sample_counts, shading_points
from drgs.render.shade import shade
from drgs.render.tonemap import tonemap
from drgs.render.trace_primary import PrimaryPoints, screen_box, trace_primary_points
from drgs.render.trace_rays import build_tracer
from drgs.render.tracer import AbstractTracer
from drgs.scene.camera import Camera, pixel_rays_world
from drgs.scene.environment import Environment, environment_radiance
from drgs.scene.posed_scene import PosedScene
from drgs.warp_torch import launch, warp_array, warp_device

wp.set_module_options({"enable_backward": False})


@dataclass(frozen=True)
class RenderSettings:
    """How a frame is made."""

    samples_per_pixel: int = 32
    """Light samples behind a finished frame."""
    samples_per_pass: int | None = None
    """Light samples a pass adds; None: 32 on Gaussians, 8 on a mesh, whose passes are its antialiasing as well."""
    counts: SampleCounts | None = None
    """Samples of each strategy a pass; None: 2:1:1. Overrides samples_per_pass."""
    bounces: int = 1
    """Surfaces light may meet on its way from the environment to the visible one; 0: direct light and shadows only."""
    primary: Literal["gaussians", "mesh"] | None = None
    """What the camera sees; None: the Gaussians where the scene has any."""
    denoise: Literal["none", "svgf", "oidn"] = "none"
    """Of what resolve_frame shows; the sums stay as they are."""
    skip: bool = True
    """Leave out what the scene does not need (drgs/render/plan.py)."""
    seed: int = 0
    exposure: float = 0.0
    """[stops]."""
    background: Literal["transparent", "environment"] | tuple[float, float, float] = "transparent"
    """A colour is linear radiance."""


@dataclass(frozen=True, eq=False)
class FrameState:
    """A frame in the making. Sums run over passes and are weighted by coverage; pixels are flat, row-major."""

    scene: PosedScene
    camera: Camera
    settings: RenderSettings
    tracer: AbstractTracer
    light: Any
    """EnvironmentLight struct."""
    plan: RenderPlan
    fixed: PrimaryPoints | None
    """The points of every pass, when the camera sees Gaussians."""
    box: tuple[int, int, int, int]
    """Part of the image that may see the mesh: left, top, right, bottom [pixels]."""
    gbuffer: GBuffer | None
    """Given by the rasteriser; None when the mesh is traced: then `surface` holds running sums."""
    diffuse: Float[Tensor, "pixel 3"]
    specular: Float[Tensor, "pixel 3"]
    weight: Float[Tensor, "pixel"]
    """Passes that found a surface."""
    luminance: Float[Tensor, "pixel"]
    luminance_squared: Float[Tensor, "pixel"]
    scatter: Float[Tensor, "pixel 3"]
    """Sum of the passes' own variance estimates: whole luminance, diffuse, specular."""
    visibility: Float[Tensor, "pixel"]
    surface: Float[Tensor, "pixel 15"]
    """Sums of position, normal, wo, albedo, roughness, metallic, depth."""
    passes: int
    seconds: dict[str, float]
    """Of each step, summed over passes."""


def start_frame(
    scene: PosedScene, camera: Camera, settings: RenderSettings, tracer: AbstractTracer | None = None, gbuffer: GBuffer | None = None
) -> FrameState:
    """All that a frame needs before its first pass.

    Args:
        tracer: of scene.mesh, to reuse one.
        gbuffer: of the scene's Gaussians through this camera, to reuse one.
    """
    seconds: dict[str, float] = {}
    clock = time.perf_counter()

    def lap(step: str) -> None:
        nonlocal clock
        now = time.perf_counter()
        seconds[step] = seconds.get(step, 0.0) + now - clock
        clock = now

    device = scene.mesh.vertices.device
    primary = settings.primary or ("gaussians" if scene.surfels is not None else "mesh")
    if primary == "gaussians" and scene.surfels is None and gbuffer is None:
        raise ValueError("primary 'gaussians' was asked for, but this scene has no Gaussians; use primary 'mesh'")
    tracer = build_tracer(scene.mesh) if tracer is None else tracer
    lap("build_tracer")
    table = build_environment_table(scene.environment)
    light = environment_light(scene.environment, table, scene.environment_rotation_degrees, scene.environment_intensity)
    lap("environment_table")
    fixed, box = None, (0, 0, camera.width, camera.height)
    if primary == "gaussians":
        if gbuffer is None:
            gbuffer = rasterize_gbuffer(scene.surfels, camera)
        lap("rasterize_gbuffer")
        points = shading_points(gbuffer)
        fixed = PrimaryPoints(points, lift_points(points, tracer), gbuffer.depth.reshape(-1)[points.pixel.long()])
        lap("lift_points")
    else:
        gbuffer = None
        box = screen_box(scene.mesh, camera)
    counts = samples_a_pass(settings, primary == "mesh")
    plan = plan_frame(scene.environment, scene.environment_intensity, counts, settings.bounces, settings.skip)
    pixels = camera.width * camera.height
    vectors = [torch.zeros(pixels, 3, device=device) for _ in range(2)]
    weight, luminance, luminance_squared, visibility = (torch.zeros(pixels, device=device) for _ in range(4))
    scatter, surface = torch.zeros(pixels, 3, device=device), torch.zeros(pixels, 15, device=device)
    sums = [*vectors, weight, luminance, luminance_squared, scatter, visibility, surface]
    return FrameState(scene, camera, settings, tracer, light, plan, fixed, box, gbuffer, *sums, 0, seconds)


@wp.kernel
def add_pass(
    first: int,
    pixel: wp.array[int],
    pass_diffuse: wp.array[wp.vec3],
    pass_specular: wp.array[wp.vec3],
    pass_variance: wp.array[wp.vec3],
    pass_visibility: wp.array[float],
    # outputs; each pixel occurs once a pass, so plain adds are exact and ordered
    diffuse: wp.array[wp.vec3],
    specular: wp.array[wp.vec3],
    weight: wp.array[float],
    luminance: wp.array[float],
    luminance_squared: wp.array[float],
    scatter: wp.array[wp.vec3],
    visibility: wp.array[float],
):
    i = first + wp.tid()
    p = pixel[i]
    c = pass_diffuse[i] + pass_specular[i]
    y = 0.2126 * c[0] + 0.7152 * c[1] + 0.0722 * c[2]
    diffuse[p] = diffuse[p] + pass_diffuse[i]
    specular[p] = specular[p] + pass_specular[i]
    weight[p] = weight[p] + 1.0
    luminance[p] = luminance[p] + y
    luminance_squared[p] = luminance_squared[p] + y * y
    scatter[p] = scatter[p] + pass_variance[i]
    visibility[p] = visibility[p] + pass_visibility[i]


@wp.kernel
def add_surface(
    first: int,
    points: PointArrays,
    depth: wp.array[float],
    # outputs
    surface: wp.array2d[float],
):
    i = first + wp.tid()
    p = points.pixel[i]
    for k in range(3):
        surface[p, k] = surface[p, k] + points.position[i][k]
        surface[p, 3 + k] = surface[p, 3 + k] + points.normal[i][k]
        surface[p, 6 + k] = surface[p, 6 + k] + points.wo[i][k]
        surface[p, 9 + k] = surface[p, 9 + k] + points.albedo[i][k]
    surface[p, 12] = surface[p, 12] + points.roughness[i]
    surface[p, 13] = surface[p, 13] + points.metallic[i]
    surface[p, 14] = surface[p, 14] + depth[i]


def refine_frame(state: FrameState, passes: int = 1) -> FrameState:
    """The frame after `passes` more passes; the given state stays as it is."""
    names = ("diffuse", "specular", "weight", "luminance", "luminance_squared", "scatter", "visibility")
    sums = {name: getattr(state, name).clone() for name in names}
    surface = state.surface if state.fixed is not None else state.surface.clone()
    arrays = [warp_array(sum_, wp.vec3 if sum_.dim() == 2 else None) for sum_ in sums.values()]
    device = warp_device(surface)
    seconds = dict(state.seconds)
    for index in range(state.passes, state.passes + passes):
        clock = time.perf_counter()
        primary = state.fixed
        if primary is None:
            primary = trace_primary_points(state.tracer, state.camera, state.settings.seed, index, box=state.box)
        points = primary.points
        traced = time.perf_counter()
        plan, seed = state.plan, state.settings.seed
        light = shade(points, primary.starts, state.light, state.tracer, plan.counts, plan.bounces, seed, index, plan.by_material)
        shaded = time.perf_counter()
        vectors = [warp_array(light.diffuse, wp.vec3), warp_array(light.specular, wp.vec3)]
        numbers = [warp_array(light.variance, wp.vec3), warp_array(light.visibility)]
        launch(add_pass, len(points.pixel), [warp_array(points.pixel), *vectors, *numbers], arrays, device)
        if state.fixed is None:
            launch(add_surface, len(points.pixel), [point_arrays(points), warp_array(primary.depth)], [warp_array(surface)], device)
        ended = time.perf_counter()
        for step, duration in (("trace_primary", traced - clock), ("shade", shaded - traced), ("accumulate", ended - shaded)):
            seconds[step] = seconds.get(step, 0.0) + duration
    return replace(state, **sums, surface=surface, passes=state.passes + passes, seconds=seconds)


def resolve_frame(state: FrameState) -> Frame:
    """The picture so far."""
    clock = time.perf_counter()
    camera, settings = state.camera, state.settings
    shape = (camera.height, camera.width)
    passes = max(1, state.passes)
    gbuffer = _mean_gbuffer(state) if state.gbuffer is None else state.gbuffer
    weight = state.weight.clamp(min=1)
    # Straight (alpha-normalised) radiance; the variance is that of the mean of one pixel's passes.
    mean = state.luminance / passes
    between = (state.luminance_squared / passes - mean * mean).clamp(min=0) / max(1, passes - 1)
    variance = (between if passes > 1 else state.scatter[:, 0]) * (passes / weight) ** 2
    scatter = state.scatter / (weight * weight)[:, None]
    radiance = Radiance(
        (state.diffuse / weight[:, None]).reshape(*shape, 3),
        (state.specular / weight[:, None]).reshape(*shape, 3),
        variance.reshape(shape),
        (state.visibility / weight).reshape(shape),
        state.passes * samples_a_pass(state.settings, state.fixed is None).total,
        scatter[:, 1].reshape(shape),
        scatter[:, 2].reshape(shape),
    )
    seconds = dict(state.seconds)
    shown = denoise(radiance, gbuffer, camera, settings.denoise)
    seconds["denoise"] = time.perf_counter() - clock
    linear = shown.diffuse + shown.specular
    rgba = tonemap(linear, gbuffer.coverage, settings.exposure, _background(state))
    seconds["resolve"] = time.perf_counter() - clock - seconds["denoise"]
    metadata = {
        "samples": radiance.samples,
        "passes": state.passes,
        "bounces": settings.bounces,
        "counts": asdict(state.plan.counts),
        "skipped": [asdict(skip) for skip in state.plan.skips],
        "primary": "mesh" if state.fixed is None else "gaussians",
        "milliseconds": {step: round(1000 * duration, 3) for step, duration in seconds.items()},
    }
    return Frame(rgba, linear, gbuffer, shown, metadata)


def samples_a_pass(settings: RenderSettings, mesh: bool) -> SampleCounts:
    """Samples of each strategy that a pass is asked for, before the plan moves any.

    Args:
        mesh: whether the camera sees the mesh.
    """
    return settings.counts or sample_counts(settings.samples_per_pass or (8 if mesh else 32))


def passes_needed(state: FrameState) -> int:
    """Passes that the settings' samples a pixel ask for, in all."""
    total = samples_a_pass(state.settings, state.fixed is None).total
    return max(1, -(-state.settings.samples_per_pixel // total))


def _mean_gbuffer(state: FrameState) -> GBuffer:
    shape = (state.camera.height, state.camera.width)
    coverage = (state.weight / max(1, state.passes)).reshape(shape)
    mean = (state.surface / state.weight.clamp(min=1)[:, None]).reshape(*shape, 15)
    depth = torch.where(coverage > 0, mean[..., 14], torch.inf)
    normal, wo = (torch.nn.functional.normalize(mean[..., a : a + 3], dim=-1) for a in (3, 6))
    return GBuffer(coverage, depth, mean[..., :3], normal, wo, mean[..., 9:12], mean[..., 12], mean[..., 13])


def _background(state: FrameState) -> Tensor | None:
    background, scene = state.settings.background, state.scene
    if background == "transparent":
        return None
    if background != "environment":
        return torch.tensor(background, device=state.diffuse.device)
    _, direction = pixel_rays_world(state.camera)
    angle = torch.tensor(scene.environment_rotation_degrees).deg2rad()
    cos, sin = torch.cos(angle), torch.sin(angle)
    x, y, z = direction.to(state.diffuse.device).unbind(-1)
    turned = torch.stack([cos * x + sin * y, cos * y - sin * x, z], -1)
    return scene.environment_intensity * environment_radiance(Environment(scene.environment.radiance.detach()), turned)
