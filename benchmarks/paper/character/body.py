"""The character's surface and its paint, from the signed distance of parts that flow into one another.

In: how fine. Out: a closed mesh with materials on its vertices, and of which joint's part each vertex is. Parts are cones with round ends; their
smallest distance is taken smoothly, belts and cuffs are shells of what they lie on, and marching cubes find where the distance is zero. Sources:
Lewiner et al. 2003 (marching cubes); the smooth minimum is the logarithm of the sum of exponentials.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from scipy import sparse
from skimage.measure import marching_cubes

from benchmarks.paper.character.skeleton import INDEX, Point, mirrored, mirrored_name
from drgs.scene.mesh import TriangleMesh


@dataclass(frozen=True)
class Matter:
    """What a part is made of."""

    albedo: tuple[float, float, float]
    """Linear."""
    roughness: float
    metallic: float = 0.0
    mottling: float = 0.3
    """How much lighter and darker it is in places, as a share of its albedo: even paint does not say how deep it lies, and nothing worn is even."""


MATTERS = {
    "skin": Matter((0.55, 0.29, 0.18), 0.5, mottling=0.2),
    "eyes": Matter((0.02, 0.015, 0.015), 0.2, mottling=0.0),
    "tunic": Matter((0.05, 0.13, 0.42), 0.75),
    "stripe": Matter((0.75, 0.68, 0.5), 0.75),
    "trousers": Matter((0.42, 0.09, 0.05), 0.8),
    "leather": Matter((0.13, 0.06, 0.03), 0.4),
    "steel": Matter((0.66, 0.64, 0.61), 0.28, 1.0, 0.12),
    "gold": Matter((0.85, 0.6, 0.26), 0.3, 1.0, 0.12),
    "plume": Matter((0.6, 0.04, 0.04), 0.55),
}


@dataclass(frozen=True)
class Part:
    """A cone with round ends."""

    joint: str
    matter: str
    start: Point
    end: Point
    radii: tuple[float, float]
    """At the start and at the end."""


@dataclass(frozen=True)
class Shell:
    """A layer over parts, between two heights along an axis."""

    joint: str
    matter: str
    over: str
    """The matter of the parts that it lies on."""
    axis: Point
    """Unit."""
    between: tuple[float, float]
    """Of the place along the axis [world units]."""
    thickness: float
    around: Point
    reach: float
    """Only nearer to `around` than this."""


SKIN_BLEND, CREASE_BLEND = 0.012, 0.003
"""Scale of the smooth minimum between parts, and where shells lie on them [world units]."""
DOWN_ARM = (0.683, 0.0, -0.7304)
"""Along the left arm; unit up to rounding."""


def _both(parts: Iterable[Part]) -> list[Part]:
    """Parts of the left and their mirror images."""
    left = list(parts)
    return left + [Part(str(mirrored_name(part.joint)), part.matter, mirrored(part.start), mirrored(part.end), part.radii) for part in left]


def _both_shells(shells: Iterable[Shell]) -> list[Shell]:
    left = list(shells)
    return left + [
        Shell(
            str(mirrored_name(shell.joint)), shell.matter, shell.over, mirrored(shell.axis), shell.between, shell.thickness,
            mirrored(shell.around), shell.reach,
        )
        for shell in left
    ]  # fmt: skip


PARTS = [
    Part("hips", "tunic", (-0.045, 0.0, -0.02), (0.045, 0.0, -0.02), (0.115, 0.115)),
    Part("spine", "tunic", (0.0, 0.0, 0.08), (0.0, 0.0, 0.17), (0.12, 0.12)),
    Part("chest", "tunic", (-0.05, 0.0, 0.26), (0.05, 0.0, 0.26), (0.115, 0.115)),
    Part("neck", "skin", (0.0, 0.0, 0.36), (0.0, -0.005, 0.45), (0.06, 0.06)),
    Part("head", "skin", (0.0, 0.0, 0.56), (0.0, -0.012, 0.53), (0.15, 0.14)),
    Part("head", "skin", (0.0, -0.15, 0.545), (0.0, -0.165, 0.525), (0.022, 0.028)),
    Part("head", "plume", (0.0, -0.09, 0.71), (0.0, 0.03, 0.75), (0.022, 0.034)),
    Part("head", "plume", (0.0, 0.03, 0.75), (0.0, 0.14, 0.685), (0.034, 0.034)),
    Part("head", "plume", (0.0, 0.14, 0.685), (0.0, 0.18, 0.58), (0.034, 0.028)),
    *_both([
        Part("left_shoulder", "tunic", (0.05, 0.0, 0.33), (0.14, 0.0, 0.325), (0.07, 0.075)),
        Part("left_upper_arm", "tunic", (0.15, 0.0, 0.33), (0.285, 0.0, 0.195), (0.072, 0.056)),
        Part("left_forearm", "skin", (0.3, 0.0, 0.18), (0.425, 0.0, 0.045), (0.05, 0.04)),
        Part("left_hand", "leather", (0.43, 0.0, 0.04), (0.48, 0.0, -0.015), (0.05, 0.05)),
        Part("left_hand", "leather", (0.44, -0.03, 0.025), (0.455, -0.075, -0.01), (0.024, 0.02)),
        Part("left_thigh", "tunic", (0.085, 0.0, -0.07), (0.1, -0.006, -0.15), (0.1, 0.098)),
        Part("left_thigh", "trousers", (0.1, -0.006, -0.15), (0.13, -0.02, -0.34), (0.09, 0.07)),
        Part("left_shin", "trousers", (0.13, -0.02, -0.36), (0.15, -0.008, -0.5), (0.069, 0.062)),
        Part("left_shin", "leather", (0.15, -0.008, -0.5), (0.165, 0.0, -0.64), (0.07, 0.058)),
        Part("left_foot", "leather", (0.165, 0.01, -0.675), (0.19, -0.11, -0.695), (0.062, 0.05)),
    ]),
]  # fmt: skip
"""All of the left and the middle, and what mirrors the left."""
SHELLS = [
    Shell("hips", "gold", "tunic", (0.0, 0.0, 1.0), (0.035, 0.085), 0.016, (0.0, 0.0, 0.06), 0.2),
    Shell("head", "steel", "skin", (0.0, 0.26, 0.9656), (0.572, 0.9), 0.022, (0.0, 0.0, 0.6), 0.3),
    *_both_shells([
        Shell("left_forearm", "gold", "skin", DOWN_ARM, (0.21, 0.246), 0.014, (0.4, 0.0, 0.07), 0.12),
        Shell("left_shin", "gold", "leather", (0.0, 0.0, 1.0), (-0.5, -0.46), 0.012, (0.15, 0.0, -0.48), 0.12),
    ]),
]  # fmt: skip
LAYERS: list[Part | Shell] = [*PARTS, *SHELLS]
EYES = ((0.058, -0.128, 0.56), 0.026)
"""The left one's middle, and its radius."""
STRIPES, STRIPE = 0.11, 0.3
"""From a stripe of the tunic to the next [world units], and how much of that it takes."""
MOTTLES = ((71.0, 23.0, 59.0), (-47.0, 83.0, 31.0), (29.0, -61.0, 89.0))
"""Waves whose sum is light and dark spots, some seven hundredths apart [1 / world units]."""
MARGIN = 3
"""Cells of the grid around the parts."""
RELAXATIONS = 5


@dataclass(frozen=True, eq=False)
class Body:
    """The surface at rest."""

    mesh: TriangleMesh
    joint: Int[ndarray, "vertex"]
    """Whose part is nearest: place in JOINTS."""


def model_body(cell: float) -> Body:
    """
    Args:
        cell: of the grid [world units]; edges of the mesh are about as long.

    Raises:
        ValueError: the cells are too wide for the thinnest parts.
    """
    thinnest = min(min(part.radii) for part in PARTS)
    if not 0 < cell <= 1.5 * thinnest:
        raise ValueError(
            f"the cells are {cell:g} wide; expected at most {1.5 * thinnest:g}, for the thinnest part's radius is {thinnest:g}"
        )
    ends = np.array([[part.start, part.end] for part in PARTS])
    radii = np.array([part.radii for part in PARTS])[..., None]
    low, high = (ends - radii).min((0, 1)) - MARGIN * cell, (ends + radii).max((0, 1)) + MARGIN * cell
    # Symmetric about x = 0, so that no vertex is left or right by chance.
    counts = np.ceil((high - low) / cell).astype(int) + 1
    axes = [start + cell * np.arange(count) for start, count in zip(low, counts, strict=True)]
    axes[0] = axes[0] - axes[0].mean()
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    distance = distances(grid.reshape(-1, 3))[0].reshape(grid.shape[:3])
    vertices, faces, _, _ = marching_cubes(distance, 0.0, spacing=(cell,) * 3, gradient_direction="descent", allow_degenerate=False)
    vertices = relaxed(vertices + np.array([axis[0] for axis in axes]), faces, cell)
    _, nearest = distances(vertices)
    normals = distance_gradient(vertices, cell)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    painted = paint(vertices, nearest, cell)
    mesh = TriangleMesh(
        torch.from_numpy(vertices.astype(np.float32)),
        torch.from_numpy(faces.astype(np.int32)),
        torch.from_numpy(normals.astype(np.float32)),
        *(torch.from_numpy(values.astype(np.float32)) for values in (painted.albedo, painted.roughness, painted.metallic)),
    )
    return Body(mesh, np.array([INDEX[LAYERS[place].joint] for place in nearest]))


def distances(points: Float[ndarray, "point 3"]) -> tuple[Float[ndarray, "point"], Int[ndarray, "point"]]:
    """Signed distance to the surface, negative inside, exact where no two parts meet; and the nearest of LAYERS."""
    own = np.stack([cone_distance(points, part) for part in PARTS])
    over = np.stack([_shell_distance(points, shell, own) for shell in SHELLS])
    blended = smooth_minimum(np.concatenate([smooth_minimum(own, SKIN_BLEND)[None], over]), CREASE_BLEND)
    # Where a shell is, it is what one sees.
    return blended, np.concatenate([own, over - 2 * CREASE_BLEND]).argmin(0)


def cone_distance(points: Float[ndarray, "point 3"], part: Part) -> Float[ndarray, "point"]:
    """To a cone with round ends; along the bone the radius grows evenly, which is exact for a cylinder and nearly so for slender cones."""
    start, end = np.array(part.start), np.array(part.end)
    along = end - start
    share = (((points - start) @ along) / (along @ along)).clip(0, 1)
    away = points - start - share[:, None] * along
    return np.sqrt((away * away).sum(1)) - (part.radii[0] + share * (part.radii[1] - part.radii[0]))


def _shell_distance(points: Float[ndarray, "point 3"], shell: Shell, own: Float[ndarray, "part point"]) -> Float[ndarray, "point"]:
    below = smooth_minimum(own[[part.matter == shell.over for part in PARTS]], SKIN_BLEND)
    place, (low, high) = points @ np.array(shell.axis), shell.between
    within = np.maximum(low - place, place - high)
    near = np.linalg.norm(points - np.array(shell.around), axis=1) - shell.reach
    return np.maximum(-smooth_minimum(-np.stack([below - shell.thickness, within]), CREASE_BLEND), near)


def smooth_minimum(values: Float[ndarray, "value point"], scale: float) -> Float[ndarray, "point"]:
    """At most `scale` times the logarithm of their number below the smallest."""
    least = values.min(0)
    return least - scale * np.log(np.exp((least - values) / scale).sum(0))


def distance_gradient(points: Float[ndarray, "point 3"], cell: float) -> Float[ndarray, "point 3"]:
    """By differences over a tenth of a cell."""
    step = 0.1 * cell
    ahead = [distances(points + step * axis)[0] - distances(points - step * axis)[0] for axis in np.eye(3)]
    return np.stack(ahead, -1) / (2 * step)


def relaxed(vertices: Float[ndarray, "vertex 3"], faces: Int[ndarray, "face 3"], cell: float) -> Float[ndarray, "vertex 3"]:
    """Vertices moved towards the mean of their neighbours and back onto the surface: marching cubes leave slivers."""
    pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    count = len(vertices)
    neighbours = sparse.coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count)).tocsr()
    degree = np.asarray(neighbours.sum(1))
    for _ in range(RELAXATIONS):
        vertices = 0.5 * (vertices + neighbours @ vertices / degree)
        gradient = distance_gradient(vertices, cell)
        vertices = vertices - gradient * (distances(vertices)[0] / (gradient * gradient).sum(1))[:, None]
    return vertices


@dataclass(frozen=True, eq=False)
class Paint:
    """Materials of vertices."""

    albedo: Float[ndarray, "vertex 3"]
    roughness: Float[ndarray, "vertex"]
    metallic: Float[ndarray, "vertex"]

    def covered(self, name: str, share: Float[ndarray, "vertex"]) -> "Paint":
        """Under so much of one of MATTERS."""
        over = MATTERS[name]
        return Paint(
            self.albedo + share[:, None] * (np.array(over.albedo) - self.albedo),
            self.roughness + share * (over.roughness - self.roughness),
            self.metallic + share * (over.metallic - self.metallic),
        )


def paint(vertices: Float[ndarray, "vertex 3"], nearest: Int[ndarray, "vertex"], cell: float) -> Paint:
    """Of vertices whose nearest layer is given. What is painted on has soft edges, a cell wide: vertices know no finer ones."""
    names = np.array([layer.matter for layer in LAYERS])[nearest]
    on_arm = np.array([layer.joint.endswith("upper_arm") for layer in LAYERS])[nearest]
    own = [MATTERS[name] for name in names]
    painted = Paint(*(np.array([getattr(matter, key) for matter in own]) for key in ("albedo", "roughness", "metallic")))
    x, z = np.abs(vertices[:, 0]), vertices[:, 2]
    # Stripes go around the trunk and around the arms.
    along = np.where(on_arm, x * DOWN_ARM[0] + z * DOWN_ARM[2], z)
    mottling = np.array([matter.mottling for matter in own])
    spots = (2 * np.sin(np.stack([x, vertices[:, 1], z], -1) @ np.array(MOTTLES).T).mean(1)).clip(-1, 1)
    painted = replace(painted, albedo=painted.albedo * (1 + mottling * spots)[:, None])
    from_middle = STRIPES * np.abs((along / STRIPES) % 1 - 0.5)
    painted = painted.covered("stripe", (names == "tunic") * (0.5 + (0.5 * STRIPE * STRIPES - from_middle) / cell).clip(0, 1))
    middle, radius = EYES
    away = np.linalg.norm(np.stack([x, vertices[:, 1], z], -1) - middle, axis=1)
    return painted.covered("eyes", (names == "skin") * (0.5 + (radius - away) / cell).clip(0, 1))
