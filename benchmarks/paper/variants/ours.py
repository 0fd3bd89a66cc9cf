"""Ours: materials, light and geometry apart, so that rays are traced anew in every pose. On particles (P), or on a mesh (M).

P: particles within the mesh know where they went and their F; vertices and surfels follow by Taylor-corrected moving least squares.
M: only the moved vertices are known; F follows from the faces, and surfels from it. Seen is the mesh, as in every built asset; or its Gaussians, as
in drgs2026.
"""

from typing import Literal

import torch
from torch import Tensor

from benchmarks.paper.fields import Field, at_rest
from benchmarks.paper.traced import traced_settings
from benchmarks.paper.variant import AbstractVariant, Draw, Subject
from drgs.deform.carry.carry_gaussians import carry_normals, carry_tangents
from drgs.deform.carry.drive_mesh import drive_surfels, vertex_gradients
from drgs.deform.carry.gmls import GmlsSettings, build_weights, interpolate
from drgs.deform.matter.fill_particles import FillSettings, fill_particles
from drgs.render.intersect.trace_rays import build_tracer
from drgs.render.render_frame import render_frame
from drgs.scene.camera import Camera
from drgs.scene.environment import Environment
from drgs.scene.gaussians import surfel_tangents
from drgs.scene.materials import Materials
from drgs.scene.mesh import TriangleMesh
from drgs.scene.posed_scene import PosedScene, PosedSurfels, PrimarySurface

PARTICLES = 20_000
"""Inside the object; as many as a simulation's by default."""


class OursVariant(AbstractVariant):
    """Traced rays; `driver` says what is known of the motion, `primary` what the camera sees."""

    relights = True

    def __init__(self, name: str, title: str, driver: Literal["particles", "mesh"], primary: PrimarySurface, simplified: str) -> None:
        self.name, self.title, self.simplified = name, title, simplified
        self._driver, self._primary = driver, primary

    def bind(self, subject: Subject) -> dict[str, Tensor]:
        mesh = subject.asset.mesh
        if self._driver == "mesh":
            return {}
        return {"particles": fill_particles(mesh.vertices, mesh.faces, FillSettings(particles=PARTICLES)).positions}

    def scene(self, subject: Subject, bound: dict[str, Tensor], field: Field, light: Environment | None) -> PosedScene:
        """What is rendered, moved by the field."""
        asset, gaussians = subject.asset, subject.asset.gaussians
        mesh, surfels, horizons = asset.mesh, None, asset.horizons
        if gaussians is not None:
            materials = Materials(gaussians.albedo, gaussians.roughness, gaussians.metallic)
            surfels = PosedSurfels(gaussians.centers, surfel_tangents(gaussians), torch.sigmoid(gaussians.opacity_logits), materials)
        if field is not at_rest:
            horizons = None
            move = self._with_particles if self._driver == "particles" else self._with_vertices
            mesh, surfels = move(subject, bound, field, surfels)
        return PosedScene(surfels, mesh, light or asset.environment, horizons=horizons, preferred=self._primary)

    def pose(self, subject: Subject, bound: dict[str, Tensor], field: Field, light: Environment | None) -> Draw:
        scene = self.scene(subject, bound, field, light)
        settings = traced_settings(subject.samples_per_pixel)
        tracer = build_tracer(scene.mesh)

        def draw(camera: Camera) -> Tensor:
            return render_frame(scene, camera, settings, tracer).rgba_srgb.clamp(0, 1)

        return draw

    def _with_particles(
        self, subject: Subject, bound: dict[str, Tensor], field: Field, surfels: PosedSurfels | None
    ) -> tuple[TriangleMesh, PosedSurfels | None]:
        mesh, particles = subject.asset.mesh, bound["particles"]
        points = mesh.vertices if surfels is None else torch.cat([mesh.vertices, surfels.centers])
        weights = build_weights(particles, points, GmlsSettings(), (mesh.vertices, mesh.faces))
        places, gradients = interpolate(weights, *field(particles))
        count = len(mesh.vertices)
        return _posed(mesh, surfels, places[:count], gradients[:count], places[count:], gradients[count:])

    def _with_vertices(
        self, subject: Subject, bound: dict[str, Tensor], field: Field, surfels: PosedSurfels | None
    ) -> tuple[TriangleMesh, PosedSurfels | None]:
        mesh, binding = subject.asset.mesh, subject.asset.binding
        vertices = field(mesh.vertices)[0]
        gradients = vertex_gradients(mesh.vertices, vertices, mesh.faces)
        moved, _ = _posed(mesh, None, vertices, gradients, vertices[:0], gradients[:0])
        if surfels is None or binding is None:
            return moved, None
        centers, tangents = drive_surfels(mesh.vertices, vertices, mesh.faces, gradients, binding, surfels.centers, surfels.tangents)
        return moved, PosedSurfels(centers, tangents, surfels.opacities, surfels.materials)


def _posed(
    mesh: TriangleMesh, surfels: PosedSurfels | None, vertices: Tensor, gradients: Tensor, centers: Tensor, surfel_gradients: Tensor
) -> tuple[TriangleMesh, PosedSurfels | None]:
    normals = carry_normals(mesh.normals, gradients)
    moved = TriangleMesh(vertices.contiguous(), mesh.faces, normals, mesh.albedo, mesh.roughness, mesh.metallic)
    if surfels is None:
        return moved, None
    tangents = carry_tangents(surfels.tangents, surfel_gradients)
    return moved, PosedSurfels(centers.contiguous(), tangents, surfels.opacities, surfels.materials)


_FIELD_ONLY = "a known deformation moves the particles where the paper simulates"
OURS_PARTICLES = OursVariant("ours_particles", "ours (P)", "particles", "mesh", _FIELD_ONLY)
OURS_MESH = OursVariant("ours_mesh", "ours (M)", "mesh", "mesh", "nothing: the moved vertices are given, as an animation gives them")
OURS_GAUSSIANS = OursVariant(
    "ours_gaussians",
    "ours (P), Gaussians seen",
    "particles",
    "gaussians",
    _FIELD_ONLY + "; what cameras see are the Gaussians, as in the paper",
)
