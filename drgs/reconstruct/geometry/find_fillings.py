"""What may fill a hollow: beside a concave crease a smooth sheet is cut off by a cap, and behind the cap it would go on.

A hull fills a narrow hollow from edge to edge, and where the cap meets the hollow's wall there is a crease that the object has not. Each concave crease is
looked at from both sides: one side is the sheet, which a quadric extends; the other is the cap, if the surface turns away again soon. Emptied, the cap's vertices lie
on the extended sheet for a share of the cap's width, and from there straight to the cap's far edge: a wedge is taken out. Most such wedges were
never filled; photographs must decide (try_sheets). Lengths in the settings are shares of the object's radius, angles are in radians.

In: a triangle mesh with the normals that shading found. Out: fillings, and the mesh's vertices without them.
Source: the continuation of smooth surfaces behind what hides them, as perception of relatable contours has it (Kellman and Shipley 1991;
docs/sources.md: kellman1991); quadrics by positions and normals.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree
from torch import Tensor

from drgs.reconstruct.geometry.average_around import averaged, averaging_matrix, rings_as_wide_as
from drgs.reconstruct.geometry.mesh_edges import MeshEdges, mesh_edges
from drgs.scene.mesh import vertex_normals

AT_ONCE = 100
"""Creases whose surroundings are measured together; each takes a number a vertex of the mesh."""
REGROUPINGS = 6
FEWEST = 8
"""Vertices that show a side of a crease."""
FEWEST_OF_SHEET = 25
FACING = 0.75
"""Least cosine between the sheet's mean normal and those of the vertices that it is fitted to."""
UNIT = 0.1
"""Of the radius: quadrics are fitted in this unit, so that curvatures of an object's own size are held weakly."""
STIFF = 1e-3
"""Weight of a quadric's curvature against each vertex it is fitted to."""
SAMPLES = 12
"""Of an extended sheet."""
SHOWN = 0.3
"""Least weight of a vertex in all fillings around it: else it is none's."""


@dataclass(frozen=True)
class FillingSettings:
    """What is taken for a crease, a sheet and a cap."""

    concavity_width: float = 0.012
    """Around a vertex, the width of a Gaussian, of whose mean it must lie ..."""
    concavity: float = 0.0008
    """... so much inward, at a crease."""
    spacing: float = 0.015
    """Of creases that are looked at."""
    band: float = 0.012
    """Around the crease, which is rounded and shows neither side."""
    beside: float = 0.045
    """Up to here both sides are told apart by their normals."""
    bent: float = 0.44
    """Least angle between them."""
    rising: float = 0.1
    """Least sine by which each side rises over the other."""
    turned: float = 0.44
    """By which normals lean more over the cap's far edge than on the cap."""
    narrowest: float = 0.02
    widest: float = 0.12
    """A cap, from crease to edge."""
    slab: float = 0.012
    """To either side along the crease, in which a cap's edge is looked for; and the width of a Gaussian by which fillings of neighbouring creases are blended."""
    reach: float = 0.03
    """Along the crease, to either side, of one filling."""
    sheet: float = 0.08
    """From the crease, up to where the sheet is fitted."""
    rough: float = 0.004
    """Most that the sheet may lie off its quadric, as a root mean square."""


@dataclass(frozen=True, eq=False)
class Filling:
    """A cap beside one crease, and the sheet that it may hide. Vectors start at the crease."""

    vertices: Int[np.ndarray, "vertex"]
    """Of the cap."""
    across: Float[np.ndarray, "vertex"]
    """Where they lie, 0 at the crease and 1 at the far edge."""
    aside: Float[np.ndarray, "vertex 3"]
    """From the section through the crease's vertex."""
    weight: Float[np.ndarray, "vertex"]
    """Against other fillings."""
    crease: Float[np.ndarray, "3"]
    far_edge: Float[np.ndarray, "3"]
    width: float
    """Of the cap [world units]."""
    onward: Float[np.ndarray, "3"]
    """Unit, along the sheet and behind the cap."""
    up: Float[np.ndarray, "3"]
    """The sheet's unit normal."""
    heights: Float[np.ndarray, "3"]
    """The sheet's height over its tangent, as a polynomial of the distance onward [world units]."""

    def places(self, share: float) -> Float[np.ndarray, "vertex 3"]:
        """Where the cap's vertices lie without the filling.

        Args:
            share: of the cap's width that the sheet goes on for.
        """
        onward = np.linspace(0, share * self.width, SAMPLES)
        sheet = onward[:, None] * self.onward + np.polynomial.polynomial.polyval(onward, self.heights)[:, None] * self.up
        profile = np.concatenate([sheet, self.far_edge[None]])
        length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(profile, axis=0), axis=1))])
        along = np.stack([np.interp(self.across, length / length[-1], axis) for axis in profile.T], 1)
        return self.crease + along + self.aside


@dataclass(frozen=True, eq=False)
class _Surroundings:
    """What lies around a crease's vertex, in shares of the radius and from that vertex on."""

    crease: int
    vertices: Int[np.ndarray, "vertex"]
    places: Float[np.ndarray, "vertex 3"]
    normals: Float[np.ndarray, "vertex 3"]
    away: Float[np.ndarray, "vertex"]
    """Along edges."""


def find_fillings(
    vertices: Float[Tensor, "vertex 3"],
    faces: Int[Tensor, "face 3"],
    normals: Float[Tensor, "vertex 3"],
    radius: float,
    settings: FillingSettings,
) -> list[Filling]:
    """Of all concave creases, from both sides.

    Args:
        normals: unit. radius: of the object's bounding sphere [world units].
    """
    edges = mesh_edges(faces)
    places, facing = vertices.cpu().double().numpy(), normals.cpu().double().numpy()
    start, end = edges.vertices.cpu().numpy().T
    length = np.linalg.norm(places[start] - places[end], axis=1)
    both = (np.concatenate([length, length]), (np.concatenate([start, end]), np.concatenate([end, start])))
    graph = coo_matrix(both, shape=(len(places), len(places))).tocsr()
    creases = _creases(vertices, faces, edges, radius, settings)
    reach = 1.2 * settings.widest
    found = []
    for first in range(0, len(creases), AT_ONCE):
        chosen = creases[first : first + AT_ONCE]
        for crease, away in zip(chosen, dijkstra(graph, indices=chosen, limit=reach * radius), strict=True):
            around = np.flatnonzero(away < reach * radius)
            near = _Surroundings(int(crease), around, (places[around] - places[crease]) / radius, facing[around], away[around] / radius)
            sides = _two_sides(near, settings)
            if sides is not None:
                for sheet, cap in (sides, sides[::-1]):
                    filling = _filling(near, sheet, cap, places[crease], radius, settings)
                    found += [] if filling is None else [filling]
    return found


def emptied(
    vertices: Float[Tensor, "vertex 3"], fillings: list[Filling], share: float, around: csr_matrix
) -> tuple[Float[Tensor, "vertex 3"], Bool[Tensor, "vertex"]]:
    """The vertices without the fillings, and which ones those had.

    Args:
        share: see Filling.places. around: averaging_matrix of the mesh.
    """
    places = vertices.cpu().double().numpy()
    total, weight = np.zeros_like(places), np.zeros(len(places))
    for filling in fillings:
        step = filling.places(share) - places[filling.vertices]
        total[filling.vertices] += filling.weight[:, None] * step
        weight[filling.vertices] += filling.weight
    filled = weight > SHOWN
    step = np.where(filled[:, None], total / np.maximum(weight, SHOWN)[:, None], 0)
    return vertices + averaged(around, torch.from_numpy(step).to(vertices), 1), torch.from_numpy(filled).to(vertices.device)


def _creases(vertices: Tensor, faces: Tensor, edges: MeshEdges, radius: float, settings: FillingSettings) -> Int[np.ndarray, "crease"]:
    """Vertices on concave creases, the deepest first and none near another."""
    count = len(vertices)
    rings = rings_as_wide_as(settings.concavity_width * radius, edges, vertices)
    inward = vertices - averaged(averaging_matrix(edges, count), vertices, rings)
    depth = (-(inward * vertex_normals(vertices, faces)).sum(-1) / radius).cpu().numpy()
    order = np.argsort(-depth, kind="stable")
    order = order[depth[order] > settings.concavity]
    places = vertices.cpu().double().numpy()[order]
    tree, free, chosen = cKDTree(places), np.ones(len(order), bool), []
    for number, vertex in enumerate(order):
        if free[number]:
            chosen.append(vertex)
            free[tree.query_ball_point(places[number], settings.spacing * radius)] = False
    return np.array(chosen, dtype=np.int64)


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)


def _two_sides(near: _Surroundings, settings: FillingSettings) -> tuple[np.ndarray, np.ndarray] | None:
    """For each side of the crease (2, 3): its mean normal, and its mean place; None where there are no two that rise over each other."""
    ring = (near.away > settings.band) & (near.away < settings.beside)
    if ring.sum() < 2 * FEWEST:
        return None
    normals, places = near.normals[ring], near.places[ring]
    mean = _unit(normals.sum(0))
    spread = normals - (normals @ mean)[:, None] * mean
    one = spread @ np.linalg.eigh(spread.T @ spread)[1][:, 2] > 0
    for _ in range(REGROUPINGS):
        if min(one.sum(), (~one).sum()) < FEWEST:
            return None
        first, second = _unit(normals[one].sum(0)), _unit(normals[~one].sum(0))
        one = normals @ first > normals @ second
    if min(one.sum(), (~one).sum()) < FEWEST or first @ second > np.cos(settings.bent):
        return None
    between = places[~one].mean(0) - places[one].mean(0)
    if min(between @ first, -between @ second) < settings.rising * np.linalg.norm(between):
        return None
    return np.stack([first, places[one].mean(0)]), np.stack([second, places[~one].mean(0)])


def _filling(
    near: _Surroundings, sheet: np.ndarray, cap: np.ndarray, crease: np.ndarray, radius: float, settings: FillingSettings
) -> Filling | None:
    """What the cap may fill; None where its side is no cap, or the other side no smooth sheet."""
    along = _unit(np.cross(sheet[0], cap[0]))
    onward, across = np.cross(along, sheet[0]), np.cross(along, cap[0])
    onward, across = -onward * np.sign(onward @ sheet[1]), across * np.sign(across @ cap[1])
    distance, aside = near.places @ across, near.places @ along
    lean = np.arcsin((near.normals @ across).clip(-1, 1))
    order = np.argsort(distance, kind="stable")
    order = order[(np.abs(aside) < settings.slab)[order] & (distance[order] > 0)]
    flat = order[(distance[order] > settings.band) & (distance[order] < max(settings.narrowest, settings.beside))]
    if not len(flat):
        return None
    usual = float(np.median(lean[flat]))
    edge = order[(distance[order] > settings.narrowest) & (lean[order] > usual + settings.turned)]
    if not len(edge) or distance[edge[0]] > settings.widest:
        return None
    width = float(distance[edge[0]])
    far = near.places[order[np.abs(distance[order] - width) < settings.band]].mean(0)
    heights = _sheet_heights(near, sheet[0], onward, along, settings)
    if heights is None:
        return None
    covers = (distance > 0) & (distance < width) & (np.abs(aside) < settings.reach) & (lean < usual + settings.turned)
    return Filling(
        near.vertices[covers],
        distance[covers] / width,
        radius * aside[covers, None] * along,
        np.exp(-0.5 * (aside[covers] / settings.slab) ** 2),
        crease,
        radius * (far - (far @ along) * along),
        radius * width,
        onward,
        sheet[0],
        heights * radius ** np.array([1.0, 0.0, -1.0]),
    )


def _sheet_heights(
    near: _Surroundings, up: np.ndarray, onward: np.ndarray, along: np.ndarray, settings: FillingSettings
) -> Float[np.ndarray, "3"] | None:
    """The polynomial of the sheet's height in the section through the crease [radii]; None where the sheet is short or rough."""
    back = -near.places @ onward
    chosen = (back > settings.band) & (back < settings.sheet) & (near.normals @ up > FACING) & (near.away < 1.3 * settings.sheet)
    if chosen.sum() < FEWEST_OF_SHEET:
        return None
    places, normals = near.places[chosen] / UNIT, near.normals[chosen]
    x, y, z = places @ onward, places @ along, places @ up
    steep = normals @ up
    one, none = np.ones_like(x), np.zeros_like(x)
    height = np.stack([one, x, y, x * x, x * y, y * y], 1)
    # A slope by a radian counts as much as half a unit of height.
    slopes = 0.5 * np.concatenate([np.stack([none, one, none, 2 * x, y, none], 1), np.stack([none, none, one, none, x, 2 * y], 1)])
    rows = np.concatenate([height, slopes])
    wanted = np.concatenate([z, -0.5 * (normals @ onward) / steep, -0.5 * (normals @ along) / steep])
    weight = np.tile(1 / (1 + (2 * back[chosen] / settings.sheet) ** 2), 3)
    weighted = rows * weight[:, None]
    held = STIFF * len(x) * np.diag([0.0, 0.0, 0.0, 1.0, 1.0, 1.0])
    quadric = np.linalg.solve(weighted.T @ rows + held, weighted.T @ wanted)
    if UNIT * np.sqrt(np.mean((height @ quadric - z) ** 2)) > settings.rough:
        return None
    return quadric[[0, 1, 3]] * UNIT ** np.array([1.0, 0.0, -1.0])
