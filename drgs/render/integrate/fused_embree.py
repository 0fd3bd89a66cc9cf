"""The integrator of the CPU: rays are started, traced, followed and summed a few points at a time, in one kernel that calls Embree itself.

The same estimate as wavefront.py's steps one after the other, which tests hold it to. Rays live in scratch memory that a launch uses over
and over, so they stay in the cache, and Python is entered once for tens of thousands of rays.

The two native bodies below go by sixteen rays. They take structs as kernels do; only numbers that differ from call to call come apart.
"""

import threading
from pathlib import Path
from typing import Any

import torch
import warp as wp

from drgs.maths.constants import F0, MIN_ROUGHNESS
from drgs.render.integrate.environment_pool import BLOCK_STREAM, BLOCKS
from drgs.render.integrate.integrator import AbstractIntegrator, Estimate
from drgs.render.integrate.path_arrays import PathArrays, path_arrays
from drgs.render.integrate.ray_scene import RayScene
from drgs.render.integrate.sample_arrays import PointArrays, SampleSet, StartArrays
from drgs.render.integrate.sample_rays import point_at
from drgs.render.integrate.sum_samples import LightSums, RaySamples, ray_samples, sum_point
from drgs.render.integrate.surface_light import SurfaceLightArrays, light_of_hit
from drgs.render.intersect.ray_memory import TracedArrays, traced_arrays
from drgs.render.intersect.tracer_embree import EMBREE_RAY, EmbreeHandles
from drgs.render.native_source import native_source
from drgs.warp_torch import load_kernel, warp_array

RAYS_A_SLICE = 1 << 18
"""Of a launch, which keeps none of them."""
RAYS_A_CHUNK = 2048
"""Rays that a launch index works on: their 60 kB stay in a core's own cache."""


@wp.struct
class RememberedRays:
    """Of all points; each empty where there are none."""

    known: TracedArrays
    """What rays met before, used for those that are still the same."""
    kept: TracedArrays
    """Where to write down what the rays meet."""


@wp.struct
class FusedScratch:
    """Of a chunk of rays."""

    rays: RaySamples
    even: PathArrays
    """Paths that go on from hits 0, 2, ... behind their first ray."""
    odd: PathArrays
    counts: wp.array[int]
    """How many there are in `even` and in `odd`; and rays traced so far."""


def _source(name: str) -> str:
    folder = Path(__file__).parent
    constants = {"F0": F0, "MIN_ROUGHNESS": MIN_ROUGHNESS, "BLOCKS": BLOCKS, "BLOCK_STREAM": BLOCK_STREAM}
    return native_source(folder / name, EMBREE_RAY, folder / "ray_vector.h", constants=constants)


@wp.func_native(_source("start_rays.h"))
def start_sixteen_rays(
    embree: EmbreeHandles, base: int, ray_count: int, first: int, bounces: int, points: PointArrays, starts: StartArrays,
    scene: RayScene, samples: SampleSet, remembered: RememberedRays, scratch: FusedScratch,
): ...  # fmt: skip


@wp.func_native(_source("scatter_hits.h"))
def scatter_sixteen_hits(
    embree: EmbreeHandles, base: int, first_point: int, depth: int, is_last: bool, points: PointArrays,
    scene: RayScene, samples: SampleSet, scratch: FusedScratch,
): ...  # fmt: skip


@wp.func_native("""
// Faces and their corners lie anywhere in memory: what a later path needs is asked for now.
const float* const lights = (const float*)known.vertex.data;
if (path + 16 < count) {
    const long face = paths.face.data[path + 16];
    __builtin_prefetch((const float*)known.face_normal.data + 3 * face);
    __builtin_prefetch(faces.data + 3 * face);
}
if (path + 8 < count)
    for (int c = 0; c < 3; ++c) __builtin_prefetch(lights + 4 * (long)faces.data[3 * (long)paths.face.data[path + 8] + c]);
""")
def ask_for_known(path: int, count: int, known: SurfaceLightArrays, faces: wp.array[int], paths: PathArrays): ...


@wp.func
def leave_known_paths(scene: RayScene, paths: PathArrays, count: int, rays: RaySamples) -> int:
    """Paths at whose surfaces light is known end there; the others move up. How many are left."""
    left = wp.int32(0)
    for path in range(count):
        ask_for_known(path, count, scene.known, scene.mesh.faces, paths)
        light = light_of_hit(scene.known, scene.mesh.faces, paths.face[path], paths.barycentric[path], paths.arriving[path])
        if light[3] > 0.0:
            rays.indirect[int(paths.ray[path])] = wp.vec3(light[0], light[1], light[2])
        else:
            paths.ray[left] = paths.ray[path]
            paths.face[left] = paths.face[path]
            paths.barycentric[left] = paths.barycentric[path]
            paths.arriving[left] = paths.arriving[path]
            paths.throughput[left] = paths.throughput[path]
            left += 1
    return left


@wp.kernel(enable_backward=False, module="unique")
def shade_chunks(
    embree: EmbreeHandles,
    first: int,
    last: int,
    chunk: int,
    bounces: int,
    points: PointArrays,
    starts: StartArrays,
    scene: RayScene,
    samples: SampleSet,
    # outputs
    remembered: RememberedRays,
    scratch: FusedScratch,
    sums: LightSums,
):
    """A launch runs on one thread from its first index to its last, so all its chunks use the same scratch."""
    begin = first + wp.tid() * chunk
    end = wp.min(begin + chunk, last)
    count = samples.cosine + samples.ggx + samples.environment
    rays = (end - begin) * count
    scratch.counts[0] = 0
    for group in range((rays + 15) // 16):
        start_sixteen_rays(embree, 16 * group, rays, begin * count, bounces, points, starts, scene, samples, remembered, scratch)
    if scene.known.vertex.shape[0] > 0:
        scratch.counts[0] = leave_known_paths(scene, scratch.even, scratch.counts[0], scratch.rays)
    for depth in range(bounces):
        paths = scratch.counts[depth % 2]
        scratch.counts[1 - depth % 2] = 0
        for group in range((paths + 15) // 16):
            scatter_sixteen_hits(embree, 16 * group, begin, depth, depth + 1 == bounces, points, scene, samples, scratch)
    for listed in range(begin, end):
        sum_point(point_at(points, listed), (listed - begin) * count, points, samples, scratch.rays, bounces, sums)


class ScratchOfThread(threading.local):
    """Final. Each thread's own, kept for all chunks: launches come by the hundred."""

    def __init__(self) -> None:
        self.counts = torch.zeros(3, dtype=torch.int32)
        self._scratch: Any = FusedScratch()
        self._rays = 0

    def fit(self, rays: int) -> Any:
        """FusedScratch for chunks of so many rays, whose counts are 0."""
        self.counts.zero_()
        if rays > self._rays:
            self._rays = max(rays, RAYS_A_CHUNK)
            self._scratch.rays = ray_samples(self._rays, torch.device("cpu"))
            self._scratch.even, self._scratch.odd = path_arrays(self._rays), path_arrays(self._rays)
            self._scratch.counts = warp_array(self.counts)
        return self._scratch


_of_thread = ScratchOfThread()


class FusedEmbreeIntegrator(AbstractIntegrator):
    """Final. Its tracer is an EmbreeTracer."""

    def load_kernels(self) -> None:
        load_kernel(shade_chunks, "cpu")

    def rays_a_slice(self) -> int:
        return RAYS_A_SLICE

    def shade_slice(self, estimate: Estimate, first: int, last: int) -> int:
        chunk = max(1, RAYS_A_CHUNK // estimate.rays_a_point)
        scratch = _of_thread.fit(chunk * estimate.rays_a_point)
        remembered = RememberedRays()
        if estimate.known is not None:
            remembered.known = traced_arrays(estimate.known)
        if estimate.kept is not None:
            remembered.kept = traced_arrays(estimate.kept)
        inputs: list[Any] = [self.tracer.handle, first, last, chunk, estimate.bounces]
        inputs += [estimate.points, estimate.starts, estimate.scene, estimate.samples]
        outputs = [remembered, scratch, estimate.sums]
        wp.launch(shade_chunks, dim=-(-(last - first) // chunk), inputs=inputs, outputs=outputs, device="cpu")
        return int(_of_thread.counts[2])
