"""What rays may meet, as kernels see it: the mesh, and the environment behind it."""

from typing import Any

import warp as wp
from torch import Tensor

from drgs.render.integrate.environment_table import EnvironmentLight
from drgs.render.intersect.mesh_surface import MeshArrays, mesh_arrays
from drgs.render.intersect.tracer import AbstractTracer


@wp.struct
class RayScene:
    """Read-only."""

    light: EnvironmentLight
    mesh: MeshArrays


def ray_scene(light: Any, tracer: AbstractTracer, horizon: Tensor | None = None) -> Any:
    """The struct that kernels read; shares memory with the tensors.

    Args:
        light: EnvironmentLight (environment_table.environment_light).
        horizon: (face, SECTORS) sines of the tracer's mesh; rays above them are not traced.
    """
    scene = RayScene()
    scene.light = light
    scene.mesh = mesh_arrays(tracer.mesh, tracer.lift, horizon)
    return scene
