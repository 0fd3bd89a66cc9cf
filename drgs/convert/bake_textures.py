"""Textures of an exported mesh: materials, occlusion and, where faces were left out, the normals of the mesh that they were left out of.

In: a mesh with materials at its vertices. Out: the mesh to be exported, its atlas, and pictures as bytes. A mesh with too many faces for charts is
shrunk, and each texel looks from the small surface to the large one: materials, normals and occlusion are those of the point it meets. So it is done, too,
where albedo is finer than vertices.

Occlusion is how bright a white sky that is brighter above than below, as most are, would make a place, with the light that the object throws onto itself,
as a share of its brightness in the open. Without that light, as the word is often meant, white hollows would come out far too dark where programs multiply by it what an environment
sends: none of them traces bounces.
Source: glTF 2.0 for what channels mean and for the frame of normals: x along u, y against the rows, z outwards.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from numpy import ndarray
from torch import Tensor

from drgs.convert.bake_transfer import DEGREE, bake_transfer, open_transfer
from drgs.convert.shrink_mesh import shrink_mesh
from drgs.exchange.export_formats import DEFAULT_FACES
from drgs.exchange.texture_atlas import TEXELS_PER_FACE, Atlas, paint, unwrap
from drgs.maths.color import srgb_from_linear
from drgs.render.intersect.trace_rays import build_tracer, trace_rays
from drgs.render.intersect.tracer import AbstractTracer
from drgs.scene.albedo_detail import detailed_albedo
from drgs.scene.mesh import TriangleMesh

TEXELS_PER_VERTEX = 16
"""Of the large mesh: four from one to the next along either side."""
LEAST_CORNERS = 5_000
"""Coarser meshes are divided before their occlusion is traced at vertices."""
TEXELS_PER_SAMPLE = 2
"""Of a detail between the vertices, of which there are parts^2 for each."""
MOST_TEXELS = 1 << 24
"""That a detail may want."""
REACH = 0.01
"""How far the large surface is looked for from the small one, as a share of the mesh's extent."""
TEXELS_AT_ONCE = 1 << 16
"""That look at the large mesh; more would only take memory."""
LEAST_FACING = 0.05
"""Of a normal along the small surface's: no program shows one that looks away."""


SKY_SLOPE = 0.6
"""What the sky of occlusion is brighter straight above than at the horizon, as a share; darker below by as much. Of the sample, three.js is under the
CIE's overcast sky 4.7 of 255 off our picture with it and 6.0 without, under lamps 10.9 and 11.2 (benchmarks gltf)."""


@dataclass(frozen=True, eq=False)
class TexturedMesh:
    """What goes into a file."""

    mesh: TriangleMesh
    atlas: Atlas
    base_color: UInt8[ndarray, "height width 3"]
    """sRGB."""
    surface: UInt8[ndarray, "height width 3"]
    """Occlusion in red (255 in the open), roughness in green, metallic in blue."""
    normal: UInt8[ndarray, "height width 3"] | None
    """Of unit vectors n in the frame of `tangents` 255 (n + 1) / 2; None where the vertices' normals are all there is."""
    tangents: Float[ndarray, "corner 4"] | None
    """Of the atlas's vertices: unit, along u, and the sign of cross(normal, tangent) against the rows. None with `normal`."""
    variants: tuple[tuple[UInt8[ndarray, "height width 3"], UInt8[ndarray, "height width 3"]], ...] = ()
    """`base_color` and `surface` of each variant."""


def bake_textures(mesh: TriangleMesh, most_faces: int = DEFAULT_FACES, variants: Sequence[TriangleMesh] = ()) -> TexturedMesh:
    """Textures of a mesh on the CPU, which is shrunk where it has more faces.

    Args:
        variants: the same mesh in other materials.
    """
    small = shrink_mesh(mesh, most_faces)
    if small is mesh and mesh.detail is None:
        atlas = unwrap(_array(mesh.vertices), _array(mesh.faces))

        def picture_at_corners(of: TriangleMesh) -> UInt8[ndarray, "height width 6"]:
            fine_atlas, fine = _finely_divided(atlas, of)
            values = torch.cat([_materials(fine), _openness(fine)[:, None]], -1)
            return paint(fine_atlas, _array(values), _surface_texels)

        picture, *others = (picture_at_corners(of) for of in (mesh, *variants))
        return TexturedMesh(mesh, atlas, picture[..., :3], picture[..., 3:], None, None, _parts(others))
    parts = 1 if mesh.detail is None else mesh.detail.parts
    wanted = max(TEXELS_PER_VERTEX, TEXELS_PER_SAMPLE * parts**2) * len(mesh.vertices)
    texels = max(TEXELS_PER_FACE, min(wanted, MOST_TEXELS) // len(small.faces))
    atlas = unwrap(_array(small.vertices), _array(small.faces), texels)
    tangents = atlas_tangents(atlas, small)
    corners = torch.from_numpy(atlas.vertex_of)
    values = torch.cat([small.vertices[corners], small.normals[corners], torch.from_numpy(tangents)], -1)
    of_corners = replace(atlas, vertex_of=np.arange(len(atlas.uv)))
    picture, *others = (paint(of_corners, _array(values), _LargeSurface(of).texels) for of in (mesh, *variants))
    return TexturedMesh(small, atlas, picture[..., :3], picture[..., 3:6], picture[..., 6:], tangents, _parts(others))


def _parts(
    pictures: Sequence[UInt8[ndarray, "height width _"]],
) -> tuple[tuple[UInt8[ndarray, "height width 3"], UInt8[ndarray, "height width 3"]], ...]:
    """Base colour and surface of each."""
    return tuple((picture[..., :3], picture[..., 3:6]) for picture in pictures)


def atlas_tangents(atlas: Atlas, mesh: TriangleMesh) -> Float[ndarray, "corner 4"]:
    """Of each vertex of the atlas: the unit direction across its normal in which u grows, and 1, or -1 where the picture shows the surface mirrored."""
    points = _array(mesh.vertices).astype(np.float64)[atlas.vertex_of[atlas.faces]]
    uv = atlas.uv[atlas.faces].astype(np.float64)
    (e1, e2), (d1, d2) = (np.moveaxis(array[:, 1:] - array[:, :1], 1, 0) for array in (points, uv))
    area = d1[:, 0] * d2[:, 1] - d1[:, 1] * d2[:, 0]
    # Weighted by the faces' areas in the picture, of which the sign stays.
    along = (e1 * d2[:, 1:] - e2 * d1[:, 1:]) * np.sign(area)[:, None]
    downwards = (e2 * d1[:, :1] - e1 * d2[:, :1]) * np.sign(area)[:, None]
    normals = _array(torch.nn.functional.normalize(mesh.normals, dim=-1)).astype(np.float64)[atlas.vertex_of]
    tangent, down = (
        np.stack([np.bincount(atlas.faces.reshape(-1), np.repeat(axis, 3), len(atlas.uv)) for axis in values.T], -1)
        for values in (along, downwards)
    )
    tangent -= (tangent * normals).sum(-1, keepdims=True) * normals
    length = np.linalg.norm(tangent, axis=-1, keepdims=True)
    # Any direction across the normal serves vertices of faces that have no area in the picture.
    spare = np.cross(normals, np.eye(3)[np.abs(normals).argmin(-1)])
    unit = np.where(length > 1e-12, tangent / np.maximum(length, 1e-300), spare / np.linalg.norm(spare, axis=-1, keepdims=True))
    sign = np.where((np.cross(normals, unit) * -down).sum(-1) < 0, -1.0, 1.0)
    return np.concatenate([unit, sign[:, None]], -1).astype(np.float32)


class _LargeSurface:
    """Final. Where texels of a small mesh look."""

    def __init__(self, mesh: TriangleMesh) -> None:
        self._tracer: AbstractTracer = build_tracer(mesh)
        self._mesh = mesh
        self._values = torch.cat([_materials(mesh), _openness(mesh)[:, None], mesh.normals], -1)

    def texels(self, places: Float[ndarray, "texel 10"]) -> UInt8[ndarray, "texel 9"]:
        """Base colour, surface and normal of texels at these positions with these normals and tangents."""
        parts = max(-(-len(places) // TEXELS_AT_ONCE), 1)
        return np.concatenate([self._look(part) for part in np.array_split(places, parts)])

    def _look(self, places: Float[ndarray, "texel 10"]) -> UInt8[ndarray, "texel 9"]:
        given = torch.from_numpy(np.ascontiguousarray(places))
        normals = torch.nn.functional.normalize(given[:, 3:6], dim=-1)
        face, weights = self._meet(given[:, :3].contiguous(), normals)
        mesh = self._mesh
        values = (self._values[mesh.faces.long()[face]] * weights[..., None]).sum(1)
        values[:, :3] = detailed_albedo(values[:, :3], mesh.detail, mesh.faces, face, weights[:, 1:])
        tangents = torch.nn.functional.normalize(given[:, 6:9], dim=-1)
        up = torch.linalg.cross(normals, tangents) * given[:, 9:].sign()
        frame = torch.stack([tangents, torch.nn.functional.normalize(up, dim=-1), normals], -1)
        seen = torch.linalg.solve(frame, torch.nn.functional.normalize(values[:, 6:], dim=-1)[..., None])[..., 0]
        seen = torch.cat([seen[:, :2], seen[:, 2:].clamp(min=LEAST_FACING)], -1)
        encoded = (torch.nn.functional.normalize(seen, dim=-1) + 1) * (255 / 2)
        return np.concatenate([_surface_texels(_array(values[:, :6])), _array(encoded.round().to(torch.uint8))], -1)

    def _meet(
        self, points: Float[Tensor, "texel 3"], normals: Float[Tensor, "texel 3"]
    ) -> tuple[Int[Tensor, "texel"], Float[Tensor, "texel 3"]]:
        """Face of the large mesh, and weights of its corners, that is nearest along the normal or against it; the nearest of all where there is none."""
        best = torch.full((len(points),), REACH * self._tracer.extent)
        face, weights = torch.full((len(points),), -1), torch.zeros(len(points), 3)
        for way in (normals, -normals):
            # From a little behind, for the point itself may be on the surface.
            hits = trace_rays(points - self._tracer.lift * way, way, self._tracer)
            distance = (hits.distance - self._tracer.lift).abs()
            facing = (self._tracer.face_normals[hits.face.long().clamp(min=0)] * normals).sum(-1) > 0
            nearer = hits.hit & facing & (distance < best)
            found = torch.cat([1 - hits.barycentric.sum(-1, keepdim=True), hits.barycentric], -1)
            best, face = torch.where(nearer, distance, best), torch.where(nearer, hits.face.long(), face)
            weights = torch.where(nearer[:, None], found, weights)
        lost = (face < 0).nonzero()[:, 0]
        if len(lost):
            import igl  # here and not above, like all below that only some exports need: each is a process of its own

            vertices, faces = _array(self._mesh.vertices).astype(np.float64), _array(self._mesh.faces)
            _, nearest, place = igl.point_mesh_squared_distance(_array(points[lost]).astype(np.float64), vertices, faces)
            a, b, c = (np.ascontiguousarray(vertices[faces[nearest, corner]]) for corner in range(3))
            face[lost] = torch.from_numpy(nearest).long()
            weights[lost] = torch.from_numpy(igl.barycentric_coordinates(place, a, b, c)).float()
        return face, weights


def _openness(mesh: TriangleMesh) -> Float[Tensor, "vertex"]:
    """Brightness under a white sky of 1 + SKY_SLOPE z, bounces included, as a share of that in the open; 0..1."""
    # In harmonics, of which the first is constant and the third grows with z.
    sky = torch.zeros((DEGREE + 1) ** 2)
    sky[0], sky[2] = math.sqrt(4 * math.pi), SKY_SLOPE * math.sqrt(4 * math.pi / 3)
    return (bake_transfer(mesh) @ sky / (open_transfer(mesh) @ sky)).clamp(0, 1)


def _finely_divided(atlas: Atlas, mesh: TriangleMesh) -> tuple[Atlas, TriangleMesh]:
    """The same surface in the same place of the picture, in so many triangles that shadows do not fall between their corners."""
    values = _array(torch.cat([mesh.normals, _materials(mesh)], -1))[atlas.vertex_of]
    points, faces = _array(mesh.vertices)[atlas.vertex_of], atlas.faces
    attributes = np.concatenate([values, atlas.uv], -1)
    while 0 < len(points) < LEAST_CORNERS:
        import trimesh

        points, faces, found = trimesh.remesh.subdivide(points, faces, vertex_attributes={"all": attributes})
        attributes = found["all"]
    fine = torch.from_numpy(np.ascontiguousarray(attributes, np.float32))
    vertices = torch.from_numpy(np.ascontiguousarray(points, np.float32))
    whole = TriangleMesh(
        vertices,
        torch.from_numpy(np.ascontiguousarray(faces, np.int32)),
        torch.nn.functional.normalize(fine[:, :3], dim=-1),
        fine[:, 3:6].contiguous(),
        fine[:, 6].contiguous(),
        fine[:, 7].contiguous(),
    )
    return Atlas(np.arange(len(points)), faces.astype(np.int32), _array(fine[:, 8:]), atlas.width, atlas.height), whole


def _materials(mesh: TriangleMesh) -> Float[Tensor, "vertex 5"]:
    return torch.cat([mesh.albedo, mesh.roughness[:, None], mesh.metallic[:, None]], -1)


def _surface_texels(values: Float[ndarray, "texel 6"]) -> UInt8[ndarray, "texel 6"]:
    """Base colour in sRGB, and occlusion, roughness and metallic, of base colour, roughness, metallic and openness."""
    given = torch.from_numpy(np.ascontiguousarray(values)).clamp(0, 1)
    return _array((torch.cat([srgb_from_linear(given[:, :3]), given[:, 5:], given[:, 3:5]], -1) * 255).round().to(torch.uint8))


def _array(tensor: Tensor) -> ndarray:
    return tensor.detach().cpu().contiguous().numpy()
