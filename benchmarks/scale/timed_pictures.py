"""Seconds of the two pictures that a viewer waits for: one while the camera moves, and the first pass of one at rest.

In: an asset and a size. Out: medians on the clock and of processor time, without what is made once and kept (kernels, the tree of faces, the
table of the environment). Both are 32 rays a pixel, as `python -m benchmarks frame` takes.
"""

import statistics
import time
from collections.abc import Callable
from itertools import islice

import torch

from benchmarks.render.frame import moving, orbit
from benchmarks.scale.cost_curve import Point
from benchmarks.scale.made_objects import bumpy_ball
from benchmarks.scale.scale_run import ScaleRun
from drgs.deform.pose_scene import pose_scene
from drgs.render.film.resolve_frame import resolve_frame
from drgs.render.integrate.plan import samples_per_pass
from drgs.render.progressive.refine import refine_frame
from drgs.render.progressive.start_frame import start_frame
from drgs.render.records import RenderSettings
from drgs.scene.asset import Asset, load_asset

RAYS = 32
"""A pixel, of a moving picture and of a first pass at rest."""
PICTURE_COSTS = {"seconds": "moving", "still_seconds": "first still pass"}


def shown_asset(run: ScaleRun) -> Asset:
    """The user's, or a made one."""
    return bumpy_ball(run.sizes.object_faces, run.device) if run.asset is None else load_asset(run.asset, run.device)


def picture_point(asset: Asset, side: int, run: ScaleRun) -> Point:
    """Both pictures of a square size; x is for the caller to say."""
    found = moving(asset, side, RAYS, run.sizes.moving_frames * run.repeats, None)
    still, still_cpu = still_seconds(asset, side, RAYS, RAYS, run.repeats)
    return {
        "seconds": found["frame_ms"] / 1000,
        "cpu_seconds": found["cpu_ms"] / 1000,
        "still_seconds": still,
        "still_cpu_seconds": still_cpu,
    }


def still_seconds(asset: Asset, side: int, rays: int, rays_per_pass: int | None, repeats: int) -> tuple[float, float]:
    """On the clock and of processor time: a picture at rest of `rays` a pixel after the camera came to another place, resolved.

    Args:
        rays_per_pass: None: those of `drgs render`.
    """
    scene, cameras = pose_scene(asset, []), list(islice(orbit(asset, side), 2))
    settings = RenderSettings(samples_per_pixel=rays, samples_per_pass=rays_per_pass)
    before = refine_frame(start_frame(scene, cameras[0], settings))

    def draw() -> None:
        state = start_frame(scene, cameras[1], settings, previous=before)
        resolve_frame(refine_frame(state, -(-rays // samples_per_pass(state.inputs).total)))

    return median_seconds(draw, repeats, scene.mesh.vertices.device)


def median_seconds(step: Callable[[], object], repeats: int, device: torch.device) -> tuple[float, float]:
    """On the clock and of processor time over all threads, after one that warms up."""
    times: list[tuple[float, float]] = []
    for _ in range(repeats + 1):
        started, cpu_started = time.perf_counter(), time.process_time()
        step()
        if device.type != "cpu":
            torch.cuda.synchronize(device)
        times.append((time.perf_counter() - started, time.process_time() - cpu_started))
    wall, cpu = zip(*times[1:], strict=True)
    return round(statistics.median(wall), 6), round(statistics.median(cpu), 6)
