"""What one part of a built asset costs: it is swapped for the truth, or put into the truth, and pictures are rendered. Nothing is fitted.

A subject has parts: geometry (the mesh that the camera sees), its shading normals, albedo, roughness, metallic, the occluders (the mesh that
other rays meet) and the light of the photographs. A row takes each from the asset (fitted) or from the scene (true); what it does not name goes
with the row's base, normals and occluders with the geometry. Attributes pass from one mesh to the other by the nearest point that faces the
same way. The camera sees the mesh in every row; both lights are the true ones but in the column `fitted_light`.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from benchmarks.measures.mesh_accuracy import SurfaceSamples, sample_surface
from benchmarks.scenes.bench_scene import Array
from drgs.evaluate.metrics import picture_figures
from drgs.maths.color import srgb_from_linear
from drgs.render.film.resolve_frame import linear_picture
from drgs.render.intersect.trace_rays import build_tracer
from drgs.render.intersect.tracer import AbstractTracer
from drgs.render.progressive.refine import refine_frame
from drgs.render.progressive.start_frame import start_frame
from drgs.render.records import RenderSettings
from drgs.render.visible.trace_primary import trace_primary
from drgs.scene.camera import Camera
from drgs.scene.environment import Environment
from drgs.scene.mesh import TriangleMesh
from drgs.scene.posed_scene import PosedScene

Source = Literal["fitted", "true"]
MATERIALS = ("albedo", "roughness", "metallic")
TRANSFER_SAMPLES = 500_000
LEANING = 0.3
"""Cosine to an axis from which on a normal leans to it; one axis at least has 0.57."""
LOOKS = 8
"""Places inside each pixel that a picture looks through, each with its share of the rays."""


@dataclass(frozen=True)
class Recipe:
    """Where each part comes from. None: from where the geometry comes."""

    name: str
    geometry: Source
    albedo: Source
    roughness: Source
    metallic: Source
    normals: Source | None = None
    occluders: Source | None = None

    @property
    def key(self) -> tuple:
        """Equal for recipes of the same picture."""
        followed = (self.normals or self.geometry, self.occluders or self.geometry)
        return (self.geometry, self.albedo, self.roughness, self.metallic, *followed)


def recipes() -> list[Recipe]:
    """Fitted with one part true, then true with one part fitted; no picture twice."""
    rows: list[Recipe] = []
    pairs: tuple[tuple[Source, Source], ...] = (("fitted", "true"), ("true", "fitted"))
    for base, other in pairs:
        whole = Recipe(base, base, base, base, base)
        rows.append(whole)
        rows += [replace(whole, name=f"{base}, {other} {part}", **{part: other}) for part in ("normals", *MATERIALS)]
        rows.append(replace(whole, name=f"{base}, {other} albedo and metallic", albedo=other, metallic=other))
        rows.append(replace(whole, name=f"{base}, {other} materials", albedo=other, roughness=other, metallic=other))
        rows.append(replace(whole, name=f"{base}, {other} occluders", occluders=other))
        rows.append(replace(whole, name=f"{base}, {other} geometry", geometry=other))
    unique = {row.key: row for row in reversed(rows)}
    return [row for row in rows if unique[row.key] is row]


class Subject:
    """The two meshes and what their mixtures look like; transfers are made once. Final."""

    def __init__(self, fitted: TriangleMesh, true: TriangleMesh) -> None:
        self.meshes: dict[Source, TriangleMesh] = {"fitted": fitted, "true": true}
        self.moved: dict[Source, dict[str, Tensor]] = {}

    def attributes(self, geometry: Source, source: Source) -> dict[str, Tensor]:
        """Per vertex of `geometry`: normals and materials of `source`."""
        if geometry == source:
            return {name: getattr(self.meshes[source], name) for name in ("normals", *MATERIALS)}
        if geometry not in self.moved:
            self.moved[geometry] = transfer_attributes(self.meshes[source], self.meshes[geometry])
        return self.moved[geometry]

    def seen_mesh(self, recipe: Recipe) -> TriangleMesh:
        return self._mesh(recipe, recipe.geometry, recipe.normals or recipe.geometry)

    def occluding_mesh(self, recipe: Recipe) -> TriangleMesh:
        shape = recipe.occluders or recipe.geometry
        return self.seen_mesh(recipe) if shape == recipe.geometry else self._mesh(recipe, shape, shape)

    def _mesh(self, recipe: Recipe, shape: Source, normals: Source) -> TriangleMesh:
        parts = {name: self.attributes(shape, getattr(recipe, name))[name] for name in MATERIALS}
        mesh = self.meshes[shape]
        # What lies between the vertices is of their own albedo.
        detail = mesh.detail if recipe.albedo == shape else None
        normals_of = self.attributes(shape, normals)["normals"]
        return TriangleMesh(mesh.vertices, mesh.faces, normals_of, parts["albedo"], parts["roughness"], parts["metallic"], detail=detail)


def transfer_attributes(source: TriangleMesh, target: TriangleMesh) -> dict[str, Tensor]:
    """Normals and materials of `source` at the vertices of `target`: of the nearest point that faces the vertex's way."""
    samples = sample_surface(source, TRANSFER_SAMPLES, 0)
    corners, weights = source.faces.long()[torch.from_numpy(samples.face)], torch.from_numpy(samples.barycentric).float()
    values = {name: (getattr(source, name)[corners] * _like(weights, getattr(source, name))).sum(1) for name in ("normals", *MATERIALS)}
    chosen = torch.from_numpy(nearest_facing(samples, target.vertices.double().numpy(), target.normals.double().numpy()))
    found = {name: value[chosen].contiguous() for name, value in values.items()}
    return found | {"normals": torch.nn.functional.normalize(found["normals"], dim=-1)}


def nearest_facing(samples: SurfaceSamples, points: Array, normals: Array) -> NDArray[np.int64]:
    """(point,) index of the nearest sample that faces the point's way, more or less: the other side of a thin wall may be nearer, and is not meant.

    Samples are sorted by the axis that their normals are nearest to; a point asks those axes that its normal leans to.
    """
    side = np.abs(samples.normals).argmax(1)
    side = 2 * side + (np.take_along_axis(samples.normals, side[:, None], 1)[:, 0] < 0)
    distance, nearest = np.full(len(points), np.inf), np.zeros(len(points), np.int64)
    for group in range(6):
        members = np.flatnonzero(side == group)
        leaning = normals[:, group // 2] * (1 - 2 * (group % 2))
        asking = np.flatnonzero(leaning > LEANING)
        if len(members) == 0 or len(asking) == 0:
            continue
        away, index = cKDTree(samples.points[members]).query(points[asking], workers=-1)
        closer = away < distance[asking]
        distance[asking[closer]], nearest[asking[closer]] = away[closer], members[index[closer]]
    lost = ~np.isfinite(distance)  # nothing of the source faces that way at all
    if lost.any():
        nearest[lost] = cKDTree(samples.points).query(points[lost], workers=-1)[1]
    return nearest


def _like(weights: Tensor, values: Tensor) -> Tensor:
    return weights[..., None] if values.dim() == 2 else weights


def swapped_picture(
    seen: AbstractTracer, occluding: AbstractTracer, light: Environment, camera: Camera, samples: int, bounces: int
) -> Array:
    """(height, width, 4) straight alpha, sRGB, of one mesh lit through another.

    Args:
        samples: rays a pixel, spread over LOOKS places inside it.
    """
    settings = RenderSettings(
        samples_per_pixel=max(1, samples // LOOKS), samples_per_pass=max(4, samples // LOOKS), bounces=bounces, primary="gaussians"
    )
    scene, total = PosedScene(None, occluding.mesh, light), None
    for look in range(LOOKS):
        gbuffer = trace_primary(seen.mesh, camera, pass_index=look, jitter=True, tracer=seen)
        state = start_frame(scene, camera, replace(settings, seed=look), occluding, gbuffer)
        picture = linear_picture(refine_frame(state, 1)).double()
        total = picture if total is None else total + picture
    assert total is not None
    alpha = total[..., 3:] / LOOKS
    color = total[..., :3] / total[..., 3:].clamp(min=1e-9)
    return torch.cat([srgb_from_linear(color).clamp(0, 1), alpha], -1).numpy()


def swap_rows(
    subject: Subject,
    cameras: tuple[Camera, ...],
    lights: dict[str, tuple[Environment, list[Array]]],
    fitted_light: Environment | None,
    samples: int,
    bounces: int,
    done: Callable[[str], None] = lambda name: None,
) -> list[dict]:
    """One row a recipe.

    Args:
        lights: by column (training, new): the true light and the true picture (RGBA) of each camera.
        fitted_light: the asset's own; under it only the two bases are rendered, against the training pictures.

    Returns:
        {"name", column: {"psnr", "psnr_scaled", "scale"}}; scaled is after one factor a channel.
    """
    rows = []
    for recipe in recipes():
        row: dict = {"name": recipe.name}
        seen_mesh, occluding_mesh = subject.seen_mesh(recipe), subject.occluding_mesh(recipe)
        seen = build_tracer(seen_mesh)
        occluding = seen if occluding_mesh is seen_mesh else build_tracer(occluding_mesh)
        columns = dict(lights)
        if fitted_light is not None and recipe.name in ("fitted", "true"):
            columns["fitted_light"] = (fitted_light, lights["training"][1])
        for column, (light, truths) in columns.items():
            pictures = [swapped_picture(seen, occluding, light, camera, samples, bounces) for camera in cameras]
            figures = picture_figures(list(zip(pictures, truths, strict=True)), new_light=True)
            row[column] = {name: figures[name] for name in ("psnr", "psnr_scaled", "scale")}
        rows.append(row)
        done(recipe.name)
    return rows
