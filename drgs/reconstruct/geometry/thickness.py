"""How thick an object is below places of its surface, and steps that leave it as thick as meshes can be.

What looks at thin plates sees one side at a time, and normals say nothing of how far apart the two are: each may drift through the other, solve by
solve, where no outline is near. What was pushed through itself is outside, and a mesh made anew has a hole there.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from drgs.render.intersect.trace_rays import trace_rays
from drgs.render.intersect.tracer import AbstractTracer
from drgs.scene.mesh import vertex_normals

OPPOSED = -0.5
"""Cosine between normals of two sides of a part, at most; elsewhere the ray met a bend."""
ROUNDS = 3
"""In which two sides that come too near give way to each other."""


def thickness(tracer: AbstractTracer, vertices: Int[Tensor, "place"], inward: Float[Tensor, "place 3"]) -> Float[Tensor, "place"]:
    """(place,) how far it is from the vertices along unit directions to the other side of the object [world units]; 0 where there is none."""
    hits = trace_rays(tracer.mesh.vertices[vertices] + 8 * tracer.lift * inward, inward, tracer)
    return torch.where(hits.hit, hits.distance, torch.zeros_like(hits.distance))


@dataclass(frozen=True, eq=False)
class OtherSide:
    """What lies behind vertices of a thin part."""

    vertices: Int[Tensor, "thin"]
    """Below which the object is thin."""
    corners: Int[Tensor, "thin 3"]
    """Of the face on the other side."""
    weights: Float[Tensor, "thin 3"]
    room: Float[Tensor, "thin"]
    """[world units] By how much both together may come nearer."""

    def kept_apart(self, step: Float[Tensor, "vertex"]) -> Float[Tensor, "vertex"]:
        """Steps of all vertices along their outward normals [world units], but those inwards no farther than there is room for both sides."""
        for _ in range(ROUNDS):
            here, there = step[self.vertices], (self.weights * step[self.corners]).sum(1)
            missing = (-here - there - self.room).clamp(min=0)
            inward, opposite = (-here).clamp(min=0), (-there).clamp(min=0)
            step = step.index_add(0, self.vertices, missing * inward / (inward + opposite).clamp(min=1e-30))
        return step


def other_side(tracer: AbstractTracer, least: float) -> OtherSide:
    """Of the tracer's mesh, seen from its vertices against their normals.

    Args:
        least: thickness that stays [world units]; what is thinner already does not get thinner.
    """
    mesh = tracer.mesh
    outward = vertex_normals(mesh.vertices, mesh.faces)
    hits = trace_rays(mesh.vertices - 8 * tracer.lift * outward, -outward, tracer)
    corners, second = mesh.faces.long()[hits.face.long().clamp(min=0)], hits.barycentric
    weights = torch.cat([1 - second.sum(-1, keepdim=True), second], -1)
    facing = (tracer.face_normals[hits.face.long().clamp(min=0)] * outward).sum(-1)
    thin = (hits.hit & (facing < OPPOSED)).nonzero().squeeze(1)
    room = (hits.distance[thin] + 8 * tracer.lift - least).clamp(min=0)
    return OtherSide(thin, corners[thin], weights[thin], room)
