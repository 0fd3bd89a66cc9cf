"""How thick an object is below places of its surface."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from drgs.render.intersect.trace_rays import trace_rays
from drgs.render.intersect.tracer import AbstractTracer


def thickness(tracer: AbstractTracer, vertices: Int[Tensor, "place"], inward: Float[Tensor, "place 3"]) -> Float[Tensor, "place"]:
    """(place,) how far it is from the vertices along unit directions to the other side of the object [world units]; 0 where there is none."""
    hits = trace_rays(tracer.mesh.vertices[vertices] + 8 * tracer.lift * inward, inward, tracer)
    return torch.where(hits.hit, hits.distance, torch.zeros_like(hits.distance))
