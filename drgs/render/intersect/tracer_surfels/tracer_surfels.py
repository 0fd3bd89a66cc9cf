"""Rays against surfels: the public functions, and the autograd node behind blended radiance."""

from typing import Any

import torch
import warp as wp
from torch import Tensor

from drgs.render.intersect.tracer_surfels.surfel_scene import SurfelScene, sh_degree
from drgs.render.intersect.tracer_surfels.walk_rays import BlendedRays, GradientHits, RayGradients, SurfelTable, sum_by_surfel, walk_rays
from drgs.warp_torch import launch, warp_array, warp_device

HITS_PER_CHUNK = 2_000_000
"""Hits whose gradients are held at once (52 bytes each); rays are cut into chunks of at most this many, or one ray."""


def trace_surfel_radiance(origins: Tensor, directions: Tensor, scene: SurfelScene, t_min: float) -> tuple[Tensor, Tensor, Tensor]:
    """Radiance (R, 3), opacity (R,) and depth (R,) of what rays (R, 3), (R, 3) meet, blended front to back.

    Depth is the mean distance along the ray, weighted as the radiance; +inf where nothing is met. Radiance is not
    divided by opacity: add (1 - opacity) times what lies behind. Gradients reach the scene's centres, tangents,
    opacities and radiance, not the rays.

    Args:
        directions: unit length.
        t_min: hits at or before this distance [world units] do not count.
    """
    radiance, opacity, weighted_t = BlendedRadiance.apply(
        scene.centers, scene.tangents, scene.opacities, scene.radiance, scene, origins.detach(), directions.detach(), float(t_min)
    )
    depth = torch.where(opacity > 0, weighted_t / opacity.clamp(min=1e-12), torch.full_like(opacity, torch.inf))
    return radiance, opacity, depth


def ray_arrays(origins: Tensor, directions: Tensor) -> list[wp.array]:
    return [warp_array(origins.float(), wp.vec3), warp_array(directions.float(), wp.vec3)]


def table_of(scene: SurfelScene, radiance: Tensor) -> Any:
    """SurfelTable of a scene; the caller keeps it alive while kernels run."""
    table = SurfelTable()
    table.tree = scene.tree.id
    table.frames = warp_array(scene.frames.reshape(-1, 4), wp.vec4)
    table.radiance = warp_array(radiance.float(), wp.vec3)
    table.degree = sh_degree(scene)
    return table


def _blended_rays(radiance: Tensor, opacity: Tensor, depth: Tensor, hit_count: Tensor) -> Any:
    """The struct that kernels read or write; shares memory with the tensors."""
    blended = BlendedRays()
    blended.radiance, blended.opacity = warp_array(radiance, wp.vec3), warp_array(opacity)
    blended.depth, blended.hit_count = warp_array(depth), warp_array(hit_count)
    return blended


def empty_hits(count: int, device: torch.device) -> tuple[Any, dict[str, Tensor]]:
    """GradientHits for `count` hits, and the tensors behind it by field."""
    tensors = {name: torch.empty(count, dtype=torch.int32, device=device) for name in ("surfel", "ray")}
    tensors |= {name: torch.empty(count, 3, device=device) for name in ("plane", "center", "radiance")}
    noted = GradientHits()
    for name, tensor in tensors.items():
        setattr(noted, name, warp_array(tensor, None if tensor.ndim == 1 else wp.vec3))
    return noted, tensors


class BlendedRadiance(torch.autograd.Function):
    """Forward: walk the rays, keep hit counts. Backward: walk again, note each hit's gradients, add them up by surfel."""

    @staticmethod
    def forward(
        ctx: Any,
        centers: Tensor,
        tangents: Tensor,
        opacities: Tensor,
        radiance: Tensor,
        scene: SurfelScene,
        origins: Tensor,
        directions: Tensor,
        t_min: float,
    ) -> tuple[Tensor, Tensor, Tensor]:
        count, device = origins.shape[0], origins.device
        blended, opacity, depth = torch.zeros(count, 3, device=device), torch.zeros(count, device=device), torch.zeros(count, device=device)
        hit_count = torch.zeros(count, dtype=torch.int32, device=device)
        kept_radiance = radiance.detach().float()[scene.kept].contiguous()
        if scene.tree is not None and count:
            launch(
                walk_rays,
                count,
                inputs=[table_of(scene, kept_radiance), *ray_arrays(origins, directions), t_min, RayGradients()],
                outputs=[_blended_rays(blended, opacity, depth, hit_count), GradientHits()],
                device=warp_device(origins),
            )
        ctx.scene, ctx.t_min = scene, t_min
        ctx.shapes = [(x.shape, x.dtype) for x in (centers, tangents, opacities, radiance)]
        ctx.save_for_backward(origins, directions, kept_radiance, blended, opacity, depth, hit_count)
        return blended, opacity, depth

    @staticmethod
    def backward(ctx: Any, *output_grads: Tensor) -> tuple:
        origins, directions, kept_radiance, blended, opacity, depth, hit_count = ctx.saved_tensors
        scene, device, kept_count = ctx.scene, origins.device, ctx.scene.kept.shape[0]
        sums = [torch.zeros(kept_count, 3, device=device) for _ in range(3)]
        sums += [torch.zeros(kept_count, device=device), torch.zeros_like(kept_radiance)]
        if scene.tree is not None:
            table = table_of(scene, kept_radiance)
            outputs = [warp_array(x, None if x.ndim == 1 else wp.vec3) for x in sums]
            met = hit_count.nonzero()[:, 0]  # rays without hits have no gradient, and are often most of them
            per_ray = [x.float()[met] for x in (origins, directions, *output_grads, blended, opacity, depth)]
            met_count = hit_count[met]
            for rays in chunks_of_rays(met_count):
                sum_chunk(table, [x[rays] for x in per_ray], met_count[rays], ctx.t_min, kept_count, outputs)
        grads = [sums[0], torch.stack([sums[1], sums[2]], -1), sums[3], sums[4]]
        scattered = []
        for grad, (shape, dtype) in zip(grads, ctx.shapes, strict=True):
            whole = torch.zeros(shape, dtype=dtype, device=device)
            whole[scene.kept] = grad.to(dtype)
            scattered.append(whole)
        return *scattered, None, None, None, None


def chunks_of_rays(hit_count: Tensor) -> list[slice]:
    """Runs of rays with at most HITS_PER_CHUNK hits together (or one ray with more); every ray has a hit."""
    total = torch.cumsum(hit_count.long(), 0)
    chunks, first, done = [], 0, 0
    while first < hit_count.shape[0]:
        last = max(first + 1, int(torch.searchsorted(total, done + HITS_PER_CHUNK, right=True)))
        chunks.append(slice(first, last))
        first, done = last, int(total[last - 1])
    return chunks


def sum_chunk(table: Any, pieces: list[Tensor], hit_count: Tensor, t_min: float, kept_count: int, outputs: list[wp.array]) -> None:
    """Add the gradients of a chunk of rays to `outputs`.

    Args:
        pieces: origins, directions, gradients of radiance, opacity and depth, and those three themselves.
    """
    origins, directions, grad_radiance, grad_opacity, grad_depth, blended, opacity, depth = (x.contiguous() for x in pieces)
    ends = torch.cumsum(hit_count.long(), 0)
    noted, tensors = empty_hits(int(ends[-1]), origins.device)
    device = warp_device(origins)
    gradients = RayGradients()
    gradients.radiance, gradients.opacity, gradients.depth = (
        warp_array(grad_radiance, wp.vec3),
        warp_array(grad_opacity),
        warp_array(grad_depth),
    )
    gradients.first_hit = warp_array(ends - hit_count)
    launch(
        walk_rays,
        origins.shape[0],
        inputs=[table, *ray_arrays(origins, directions), t_min, gradients],
        outputs=[_blended_rays(blended, opacity, depth, hit_count.contiguous()), noted],
        device=device,
    )
    order = torch.argsort(tensors["surfel"], stable=True)
    per_surfel = torch.bincount(tensors["surfel"].long(), minlength=kept_count)
    start = torch.cat([per_surfel.new_zeros(1), torch.cumsum(per_surfel, 0)])
    launch(
        sum_by_surfel,
        kept_count,
        inputs=[table.degree, warp_array(directions.float(), wp.vec3), warp_array(order), warp_array(start), noted],
        outputs=outputs,
        device=device,
    )
