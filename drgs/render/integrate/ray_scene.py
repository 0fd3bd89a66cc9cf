"""What rays may meet, as kernels see it: the mesh, and the environment behind it."""

from typing import Any

import warp as wp
from torch import Tensor

from drgs.render.integrate.environment_pool import CandidatePools, candidate_pools
from drgs.render.integrate.environment_table import EnvironmentLight
from drgs.render.integrate.surface_light import SurfaceLight, SurfaceLightArrays, surface_light_arrays
from drgs.render.intersect.mesh_surface import MeshArrays, mesh_arrays
from drgs.render.intersect.tracer import AbstractTracer


@wp.struct
class RayScene:
    """Read-only."""

    light: EnvironmentLight
    mesh: MeshArrays
    pools: CandidatePools
    known: SurfaceLightArrays


def ray_scene(
    light: Any, tracer: AbstractTracer, horizon: Tensor | None = None, pools: Any = None, known: SurfaceLight | None = None
) -> Any:
    """The struct that kernels read; shares memory with the tensors.

    Args:
        light: EnvironmentLight (environment_table.environment_light).
        horizon: (face, SECTORS) sines of the tracer's mesh; rays above them are not traced.
        pools: CandidatePools (environment_pool.candidate_pools); None where samples do not choose.
        known: what surfaces send, where rays need not look for it.
    """
    scene = RayScene()
    scene.light = light
    scene.mesh = mesh_arrays(tracer.mesh, tracer.lift, horizon)
    scene.pools = candidate_pools(light, 1, 0, 0, 0, tracer.mesh.vertices.device) if pools is None else pools
    scene.known = surface_light_arrays(known, tracer.mesh.vertices)
    return scene
