"""How far before or behind the surface its texture lies, by what several photographs show alike: where paint has a pattern, parallax tells depth.

Shading knows which way a surface faces and masks know where it ends; neither knows how deep the floor of a recess lies, and masks that are drawn by
hand are a few pixels wide. A small patch of the surface around a vertex is moved to several depths along its normal and looked up in the photographs
that see it best. (A flat patch lies before a round surface but at its middle, so its best depth is too deep, by half a pixel on limbs 25 pixels wide; and it
reaches beyond what is narrower than it.) Where their patterns agree (normalised cross-correlation of what is left without smooth shading, the better half of the
pairs, so that a view that is hidden there does not count) at one depth and at no other, the texture lies there. Plain places agree everywhere or nowhere. Flat mirrors agree
nowhere, but round ones at the image of what they mirror, for far surroundings half their radius deep: so what is said to lie far off is not believed.
What the patches around say differently is believed less. A scene of which hardly any place says something is not asked further.

In: the mesh through its tracer, normals, photographs. Out: MatchedDepths. Source: Furukawa and Ponce 2010 (patches along normals;
docs/sources.md: furukawa2010).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from drgs.reconstruct.fit.evidence.patch_kernels import PackedPictures, patterns_of_patches
from drgs.reconstruct.geometry.average_around import averaged, averaging_matrix, rings_as_wide_as
from drgs.reconstruct.geometry.mesh_edges import MeshEdges
from drgs.render.intersect.trace_rays import trace_rays
from drgs.render.intersect.tracer import AbstractTracer
from drgs.scene.camera import Camera, scaled_camera
from drgs.scene.views import Views

PATCH = 7
"""Side of a patch [samples]."""
SPACING = 2.0
"""Of its samples [pixels of the nearest camera]."""
STEP = 1.5
"""From one depth to the next [pixels of the nearest camera]: between views 20 degrees apart half a pixel of parallax."""
BEHIND, BEFORE = 0.12, 0.05
"""Shares of the radius that are searched. A hull is too large where it errs, not too small."""
NEAR = 0.03
"""Share of the radius within which a depth is believed: what lies farther off, find_hollows found. Of surfaces that lie within two pixels of the truth, what
patches say to lie four pixels off and more is wrong nearly always: a mirror's image (of a ball, half its radius deep), gloss."""
VIEWS = 8
"""That are compared at a vertex: those that it faces most."""
FEWEST_PAIRS = 3
FACING = 0.4
"""Least cosine between normal and view."""
NEAREST, FARTHEST = 0.105, 0.78
"""Angles between the views of a pair [radians]: from 6 degrees there is parallax, up to 45 patterns look alike."""
MARGIN = 8
"""Pixels of a photograph's border where no patch is looked up."""
HALF_BELIEVED = 0.5
"""Of a step: what is so far from the patches around, or among patches that are so far apart, counts half."""
RELIEF = 1.0
"""Of half a patch's width: how far before or behind its vertex a patch may reach, along the normal. What turns away more is not asked."""
FAINT = 0.01
"""Standard deviation of a patch, of display values 0..1, that is noise."""
ALIKE, WELL_ALIKE = 0.4, 0.7
"""Correlation, without what is smooth, from which a depth is believed, and fully."""
APART = 5.0
"""Pixels, as STEP, from the best depth within which others may agree as well."""
DISTINCT, WELL_DISTINCT = 0.05, 0.2
"""By how much the best depth must agree better than those farther away, to be believed, and fully. Of places of the finished tankard (textured wood)
69 of 100 passed the two lower bounds before smooth shading was taken out, of the teapot, the bunny and still_life 1 or less (docs/decisions/0003-fitting.md)."""
LEAST_BELIEF = 0.15
"""Mean over the places that views see, below which nothing is believed at all: still_life has .09 (photographs of 400 pixels) to .12 (256), metal counted as 0, a
microphone .07, a teapot 0, and what they say is wrong; the tankard's textured wood .28 (512) and .39 (256), eagle .17 (400) and .21 (256), a patterned mug .21, bricks
.18, a bunny .19 (256; .09 of 400), where patches and surface agree to a part of a pixel (docs/decisions/0003-fitting.md, "Mirrors' images as texture")."""
ASKED_FIRST, ASKED = 2000, 30_000
"""Vertices, at most, by which a scene's belief is estimated, and that are looked at where it suffices: the others hear their neighbours."""
SIDE = 512
"""Of photographs, at most [pixels]: in finer ones patches are smaller, and fewer are alike (of the tankard's 0.15 at 1024 pixels are believed)."""
VERTICES_AT_ONCE = 1000


@dataclass(frozen=True, eq=False)
class MatchedDepths:
    """Where texture says that the surface lies."""

    places: Float[Tensor, "vertex 3"]
    """World; where nothing is said, the vertex itself."""
    weight: Float[Tensor, "vertex"]
    """0..1: how much it is believed."""


def matched_texture(
    tracer: AbstractTracer,
    normals: Float[Tensor, "vertex 3"],
    metal: Float[Tensor, "vertex"],
    edges: MeshEdges,
    views: Views,
    radius: float,
) -> MatchedDepths:
    """Of the tracer's mesh; all weights are 0 where the photographs show too little texture.

    Args:
        normals: unit. metal: evidence in -1 .. 1 (metal_evidence): what mirrors shows the texture of other things. radius: of the object [world units].
    """
    search = _Search(tracer, torch.nn.functional.normalize(normals, dim=-1), views, radius)
    count = len(normals)
    paint = 1 - metal.clamp(0, 1)

    def every(most: int) -> tuple[Tensor, _Scores]:
        some = torch.arange(0, count, -(-count // most), device=normals.device)
        return some, search.scores(some)

    some, found = every(ASKED_FIRST)
    if float((_believed(found.score, search.near) * paint[some]).sum()) < LEAST_BELIEF * max(float(found.seen.sum()), 1.0):
        return MatchedDepths(tracer.mesh.vertices, torch.zeros_like(metal))
    some, found = every(ASKED)
    # The surroundings lie about as deep: what chance makes agree at one vertex it does not at the next.
    rings, around = 1 if len(some) == count else 2, averaging_matrix(edges, count)
    sums = search.vertices.new_zeros(count, len(search.depths) + 1)
    sums[some] = torch.cat([found.score, found.seen[:, None].to(found.score)], -1)
    sums = averaged(around, sums, rings)
    score = sums[:, :-1] / sums[:, -1:].clamp(min=1e-6)
    weight = _believed(score, search.near) * paint
    depth = torch.where(weight > 0, _best_depth(score, search.depths), 0.0)
    wide = rings_as_wide_as(0.5 * PATCH * SPACING * search.pixel, edges, search.vertices)
    known, mean, square = averaged(around, torch.stack([weight, weight * depth, weight * depth.square()], -1), wide).unbind(-1)
    mean, square = mean / known.clamp(min=1e-9), square / known.clamp(min=1e-9)
    disagreement = ((depth - mean).square() + (square - mean.square()).clamp(min=0)) / (HALF_BELIEVED * search.step) ** 2
    weight = weight / (1 + disagreement)
    return MatchedDepths(tracer.mesh.vertices + depth[:, None] * search.normals, weight)


def smooth_patches(device: torch.device) -> Float[Tensor, "term sample"]:
    """What shading, shadows' edges and gloss make of one paint over a patch: a polynomial of degree 2 of the place in it. Rows of length 1, perpendicular to each
    other; samples as PATCH has them."""
    axis = torch.arange(PATCH, device=device) - (PATCH - 1) / 2
    one, x, curved = torch.ones_like(axis), axis, axis.square() - axis.square().mean()
    terms = torch.stack([torch.outer(a, b).flatten() for a, b in ((one, one), (x, one), (one, x), (x, x), (curved, one), (one, curved))])
    return torch.nn.functional.normalize(terms, dim=1)


@dataclass(frozen=True, eq=False)
class _Scores:
    score: Float[Tensor, "asked depth"]
    """Correlation, -1..1."""
    seen: Bool[Tensor, "asked"]
    """By enough pairs of views."""


class _Search:
    """Final. Patches of a mesh's vertices, looked up in the photographs."""

    def __init__(self, tracer: AbstractTracer, normals: Tensor, views: Views, radius: float) -> None:
        self.tracer, self.normals, self.vertices = tracer, normals, tracer.mesh.vertices
        device = normals.device
        factors = [min(1.0, SIDE / max(camera.width, camera.height)) for camera in views.cameras]
        self.cameras = [scaled_camera(camera.to(device), factor) for camera, factor in zip(views.cameras, factors, strict=True)]
        grey = [
            _resized(image.to(device).float().mean(-1) / 255, camera) for image, camera in zip(views.images_srgb, self.cameras, strict=True)
        ]
        self.pictures = PackedPictures(self.cameras, grey)
        self.coverage = [_resized(mask.to(device).float(), camera) for mask, camera in zip(views.coverage, self.cameras, strict=True)]
        centers = torch.stack([camera.center_world for camera in self.cameras])
        middle = self.vertices.mean(0)
        focal = torch.stack([camera.intrinsics[0, 0] for camera in self.cameras])
        self.pixel = float(((centers - middle).norm(dim=1) / focal).median())
        """What a pixel spans at the object [world units]."""
        self.step = STEP * self.pixel
        first, last = -round(BEHIND * radius / self.step), round(BEFORE * radius / self.step)
        self.depths = torch.arange(first, last + 1, device=device) * self.step
        self.near = self.depths.abs() <= NEAR * radius
        self.towards = torch.nn.functional.normalize(centers[None] - self.vertices[:, None], dim=-1)
        """(vertex, view, 3) unit."""
        axis = torch.arange(PATCH, device=device) - (PATCH - 1) / 2
        self.patch = SPACING * self.pixel * torch.cartesian_prod(axis, axis)
        self.smooth = smooth_patches(device)

    def scores(self, index: Int[Tensor, "asked"]) -> _Scores:
        facing = self._facing(index).split(VERTICES_AT_ONCE)
        parts = [self._scores_of(some, own) for some, own in zip(index.split(VERTICES_AT_ONCE), facing, strict=True)]
        return _Scores(torch.cat([part.score for part in parts]), torch.cat([part.seen for part in parts]))

    def _scores_of(self, index: Int[Tensor, "asked"], facing: Float[Tensor, "asked view"]) -> _Scores:
        across, whole = self._across(index)
        facing = facing * whole[:, None]
        facing, view = facing.topk(min(VIEWS, len(self.cameras)), dim=1)
        patterns = patterns_of_patches(
            self.vertices[index], self.normals[index], self.depths, across, view, facing > 0, self.pictures, self.smooth, FAINT * PATCH
        )
        one, other = torch.triu_indices(view.shape[1], view.shape[1], 1, device=index.device)
        towards = self.towards[index[:, None], view]
        apart = (towards[:, one] * towards[:, other]).sum(-1).clamp(-1, 1).acos()
        counts = (facing[:, one] > 0) & (facing[:, other] > 0) & (apart > NEAREST) & (apart < FARTHEST)
        alike = (patterns @ patterns.transpose(-1, -2))[:, :, one, other].masked_fill(~counts[:, None], -1.0)
        pairs = counts.sum(1)
        ranked = alike.sort(dim=-1, descending=True).values
        half = (pairs + 1) // 2
        kept = torch.arange(len(one), device=index.device) < half[:, None]
        score = (ranked * kept[:, None]).sum(-1) / half.clamp(min=1)[:, None]
        seen = pairs >= FEWEST_PAIRS
        return _Scores(torch.where(seen[:, None], score, 0.0), seen)

    def _facing(self, index: Int[Tensor, "asked"]) -> Float[Tensor, "asked view"]:
        """Cosine between normal and view, 0 where the view does not see the vertex."""
        facing = torch.zeros(len(index), len(self.cameras), device=index.device)
        for view, camera in enumerate(self.cameras):
            cosine = (self.towards[index, view] * self.normals[index]).sum(-1)
            place, ahead = _pixels(camera, self.vertices[index])
            size = torch.tensor([camera.width, camera.height], device=index.device)
            sees = ((cosine > FACING) & ahead & (place > MARGIN).all(-1) & (place < size - MARGIN).all(-1)).nonzero().squeeze(1)
            column, row = place[sees].long().unbind(-1)
            sees = sees[self.coverage[view][row, column] > 0]
            origin = self.vertices[index[sees]] + 4 * self.tracer.lift * self.normals[index[sees]]
            open_ = ~trace_rays(origin, self.towards[index[sees], view].contiguous(), self.tracer).hit
            facing[sees[open_], view] = cosine[sees[open_]]
        return facing

    def _across(self, index: Int[Tensor, "asked"]) -> tuple[Float[Tensor, "asked sample 3"], Bool[Tensor, "asked"]]:
        """From each vertex to the samples of its patch [world units], on the surface before and behind its tangent plane; and whether all were found."""
        normal = self.normals[index]
        helper = torch.where(normal[:, 2:].abs() < 0.9, normal.new_tensor([0.0, 0.0, 1.0]), normal.new_tensor([1.0, 0.0, 0.0]))
        tangent = torch.nn.functional.normalize(torch.linalg.cross(helper, normal), dim=-1)
        bitangent = torch.linalg.cross(normal, tangent)
        flat = self.patch[:, :1] * tangent[:, None] + self.patch[:, 1:] * bitangent[:, None]
        above = RELIEF * float(self.patch.max())
        start = (self.vertices[index] + above * normal)[:, None] + flat
        hits = trace_rays(start.reshape(-1, 3), -normal[:, None].expand_as(start).reshape(-1, 3), self.tracer)
        found = (hits.hit & (hits.distance < 2 * above)).view(flat.shape[:2])
        relief = torch.where(found, above - hits.distance.view(found.shape), 0.0)
        return flat + relief[..., None] * normal[:, None], found.all(1)


def _resized(picture: Float[Tensor, "_height _width"], camera: Camera) -> Float[Tensor, "_rows _columns"]:
    """At the camera's size, by means over areas."""
    if picture.shape == (camera.height, camera.width):
        return picture
    return torch.nn.functional.interpolate(picture[None, None], (camera.height, camera.width), mode="area")[0, 0]


def _pixels(camera: Camera, places: Float[Tensor, "*batch 3"]) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
    """Where they are in the picture [pixels], and whether they lie before the camera."""
    at = places @ camera.camera_from_world[:3, :3].T + camera.camera_from_world[:3, 3]
    homogeneous = at @ camera.intrinsics.T
    return homogeneous[..., :2] / homogeneous[..., 2:], at[..., 2] > 1e-6


def _believed(score: Float[Tensor, "asked depth"], near: Bool[Tensor, "depth"]) -> Float[Tensor, "asked"]:
    """0..1: how much the best depth is believed, where it is `near`; 0 at either end of what was searched, where the best may lie beyond."""
    best, at = score.max(1)
    number = torch.arange(score.shape[1], device=score.device)
    elsewhere = score.masked_fill((number - at[:, None]).abs() <= APART / STEP, -1.0).amax(1)
    alike = (best - ALIKE) / (WELL_ALIKE - ALIKE)
    distinct = (best - elsewhere - DISTINCT) / (WELL_DISTINCT - DISTINCT)
    inside = (at > 0) & (at < score.shape[1] - 1) & near[at]
    return alike.clamp(0, 1) * distinct.clamp(0, 1) * inside


def _best_depth(score: Float[Tensor, "asked depth"], depths: Float[Tensor, "depth"]) -> Float[Tensor, "asked"]:
    """Along the normal [world units], between two of those searched by the parabola through three scores."""
    at = score.argmax(1).clamp(1, score.shape[1] - 2)
    before, best, after = (score.gather(1, (at + k)[:, None]).squeeze(1) for k in (-1, 0, 1))
    bend = (before - 2 * best + after).clamp(max=-1e-6)
    return depths[at] + ((before - after) / (2 * bend)).clamp(-0.5, 0.5) * (depths[1] - depths[0])
