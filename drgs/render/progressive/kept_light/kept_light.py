"""What white matt paint at a mesh's vertices would send: sums of estimates, each with its own number of them and its error.

It depends neither on the camera nor on the albedo there, so a moving camera can read it, and an edit of materials leaves the environment's own
part as it is. What empties which part is invalidate.py's. Frozen: adding estimates makes a new record.
"""

from dataclasses import dataclass, replace
from typing import Any

import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from drgs.render.progressive.frame_sums import BRIGHTNESS_POWERS
from drgs.render.records import SampleCounts
from drgs.scene.mesh import TriangleMesh
from drgs.warp_torch import warp_array

wp.set_module_options({"enable_backward": False})

A_ROUND = SampleCounts(cosine=8, ggx=0, environment=8)
"""Rays of an estimate."""
MOST_VERTICES = 1 << 20
"""Of a mesh that light is kept on: 40 bytes each, and twelve a face, so about 70 MB."""


@dataclass(frozen=True, eq=False)
class FacesAround:
    """The faces that meet at each vertex: those of vertex v are face[first[v] : first[v + 1]]."""

    first: Int[Tensor, "vertex_and_one"]
    """int32."""
    face: Int[Tensor, "corner"]
    """int32."""


@dataclass(frozen=True, eq=False)
class KeptLight:
    """Written by gather_light, read by read_light."""

    direct: Float[Tensor, "vertex 3"]
    """Sum over rounds of irradiance / pi that comes straight from the environment."""
    indirect: Float[Tensor, "vertex 3"]
    """Sum over indirect rounds of irradiance / pi that other surfaces send."""
    visibility: Float[Tensor, "vertex"]
    """Sum of open shares of the cosine-weighted sky."""
    variance: Float[Tensor, "vertex"]
    """Sum of the estimates' own variances of the luminance of direct and indirect light together."""
    rounds: Int[Tensor, "vertex"]
    """int32; estimates behind all sums but the indirect one."""
    indirect_rounds: Int[Tensor, "vertex"]
    """int32; no more than rounds."""
    around: FacesAround


@wp.struct
class KeptArrays:
    """KeptLight as kernels see it."""

    direct: wp.array[wp.vec3]
    indirect: wp.array[wp.vec3]
    visibility: wp.array[float]
    variance: wp.array[float]
    rounds: wp.array[int]
    indirect_rounds: wp.array[int]


def kept_arrays(kept: KeptLight) -> Any:
    """The struct that kernels read and write; shares memory with the tensors."""
    arrays = KeptArrays()
    arrays.direct, arrays.indirect = warp_array(kept.direct, wp.vec3), warp_array(kept.indirect, wp.vec3)
    arrays.visibility, arrays.variance = warp_array(kept.visibility), warp_array(kept.variance)
    arrays.rounds, arrays.indirect_rounds = warp_array(kept.rounds), warp_array(kept.indirect_rounds)
    return arrays


def faces_around(mesh: TriangleMesh) -> FacesAround:
    """Of each vertex, in the order of their numbers."""
    corner = mesh.faces.reshape(-1).long()
    face = torch.argsort(corner, stable=True) // 3
    first = torch.zeros(len(mesh.vertices) + 1, dtype=torch.int64, device=corner.device)
    first[1:] = torch.bincount(corner, minlength=len(mesh.vertices)).cumsum(0)
    return FacesAround(first.int(), face.int())


def no_light(mesh: TriangleMesh, around: FacesAround | None = None) -> KeptLight:
    """Nothing kept yet.

    Args:
        around: of a mesh with the same faces; None: they are looked for.
    """
    count, device = len(mesh.vertices), mesh.vertices.device
    direct, indirect = (torch.zeros(count, 3, device=device) for _ in range(2))
    visibility, variance = (torch.zeros(count, device=device) for _ in range(2))
    rounds, indirect_rounds = (torch.zeros(count, dtype=torch.int32, device=device) for _ in range(2))
    return KeptLight(direct, indirect, visibility, variance, rounds, indirect_rounds, around or faces_around(mesh))


def without_indirect(kept: KeptLight) -> KeptLight:
    """The environment's own light alone."""
    return replace(kept, indirect=torch.zeros_like(kept.indirect), indirect_rounds=torch.zeros_like(kept.indirect_rounds))


def brighten_kept(kept: KeptLight, brightness: float) -> KeptLight:
    """The same under a light `brightness` times as strong."""
    direct, indirect = kept.direct * brightness, kept.indirect * brightness
    return replace(kept, direct=direct, indirect=indirect, variance=kept.variance * brightness ** BRIGHTNESS_POWERS["scatter"])
