"""Whether a place is metal, by what the photographs say: two explanations of its brightness over all views, each at its best.

With geometry, roughness and light as they are, the radiance of a vertex in view v is, by split sum,

    L_v = d E + f A_v + B_v,   A_v = S_v F1,  B_v = S_v F2,

with d the diffuse albedo, f the reflectance at normal incidence, E the irradiance over pi that arrives and S_v the light of the mirror lobe.
Matter that is no metal has f = 0.04 and a free d, metal has d = 0 and a free f: three numbers each, so that their residuals compare fairly.
Gradients never decide this: a darker light and a diffuse part trade places without a trace in the loss.

Errors of shape and light spoil the predicted mirror S_v, not the constant E, so they count against metal alone: real paint hardly ever says
"metal", real metal says "paint" wherever its normals are off. So the benefit of the doubt is metal's, and each place hears its surroundings, as far as they are
of its colour, its hue above all: matter of one kind seldom changes colour at once, and often does where another kind begins. What paint explains well
hears all that is painted alike, too, wherever it is: where light is known badly, a dim mirror may explain as much.
Where light turns with the camera, what arrives at paint changes from view to view as well, and is predicted nearly as badly: then there is less of it.
And no metal is dark: what reflects less than a twelfth in its brightest channel is lacquer, however well a dark mirror explains it.

The same sums say how bright the light is (light_scale). d and f trade places with it, but what matter of any kind reflects at grazing angles (B_v),
and paint at any (0.04), does not.

In: the mesh through its tracer, photographs, light. Out: evidence in -1 (no metal) .. 1 (metal) a vertex, near 0 where nothing is known.
"""

import math
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from drgs.maths.constants import F0
from drgs.reconstruct.fit.evidence.seen_vertices import mirrored_radiance, seen_vertices
from drgs.reconstruct.fit.light.mesh_light import LightOf
from drgs.reconstruct.fit.light.split_sum import shade_split_sum
from drgs.reconstruct.fit.view_targets import ViewTarget
from drgs.reconstruct.geometry.agree_along_edges import agree_along_edges
from drgs.reconstruct.geometry.mesh_edges import MeshEdges
from drgs.render.intersect.tracer import AbstractTracer
from drgs.warp_torch import by_pool

FEWEST_VIEWS = 4
DARK = 0.05
"""Radiance below which errors count as absolute rather than relative."""
NOISE = 0.02
"""Standard deviation of a photograph's radiance, relative above DARK, that explains nothing."""
NEIGHBOURHOOD = 3
"""Times that residuals are averaged with the neighbours'."""
DOUBT = 0.5
"""Of the residuals' logarithms: by how much metal may explain worse and is believed, where it leaves much unexplained. On finished surfaces (decisions/0003, "Metal by its
hue") 0.6 misses less metal yet and calls more paint metal."""
DOUBT_TURNED = 0.2
"""The same where light turns with the camera. Drafts, metallic RMSE of bunny and teapot: .45 and .38 with 0.4, .17 and .42 with 0.2, .09 and .54 with 0."""
DARKEST = (0.08, 0.16)
"""Reflectance of metal, in its brightest channel: below the first none is that dark, from the second on nothing speaks against it. Of captures whose
truth is known true metal has 0.34 and more, carved bronze 0.15 and more; black and dark red lacquer, explained as metal, 0.15 and less."""
TOO_DARK = 1.0
"""Taken off the doubt where no metal is that dark: there it must explain better."""
LOST = 0.45
"""Relative error of the better explanation above which neither says much: there the shape is wrong, not the paint."""
STRONGEST = 2.0
"""Difference of the logarithms beyond which a place counts no more than that."""
TOGETHER = 3.0
"""Weight of neighbours being of one kind, against a difference of logarithms of 1."""
UNSEEN = 1e-4
"""Weight of a place of which views say nothing: it is what its surroundings are."""
EDGES = 90_000
"""Of the meshes (60 000 faces) for which NEIGHBOURHOOD and TOGETHER were chosen. Finer ones average oftener and hold neighbours together the more, so that a place
hears as much of the surface: else errors of shape that are a few pixels wide are called paint on a mesh that has faces enough for them."""
SAME_COLOUR = 0.4
"""Difference of the logarithms of colours, over three channels, across an edge whose ends hear each other a third as much as if there were none ..."""
BRIGHTNESS = 0.1
"""... where differences that all channels share count so much: what arrives in a hollow, and so how bright matter seems there, is known less well than its hue."""
STRANGERS = 1e-3
"""At least."""
ALIKE_ANYWHERE = 1.0
"""As TOGETHER, of a place and of all that is painted as it, wherever it is: that is mostly of one kind, too, and where light is known badly others say of which."""
EXPLAINED = 0.15
"""Relative error that paint leaves at a place which hears them a third as much as one without error: metal's colour is what it mirrors, not what it is."""
PAINTS_APART = 0.5
"""Between colours that stand for a paint each, in differences of SAME_COLOUR of logarithms."""
MOST_PAINTS, NEAREST_PAINTS = 64, 2
"""Of an object, and those that a place is joined with. 200 and 4 decide the same and take twice the time."""
DECISIVE = 0.3
"""Agreement of a place and its surroundings, -1..1, at which evidence is 0.76."""


VIEW_PARTS = 4
"""Parts of the views that are summed up side by side."""
SCALES = tuple(2 ** (k / 2) for k in range(-6, 7))
"""Of the light, that are compared."""
RIGHT_SCALE = 1.6
"""Factor either way within which the light's brightness is let be: mirrors that are badly predicted look best where they are dim, at 0.65 on a chair of wood
whose light was right to a tenth. Finished captures whose light is right are found within 1.1."""


@dataclass(frozen=True, eq=False)
class ViewSums:
    """Sums over the views of each vertex, (vertex, 3), of products of the photograph p, what white paint sends back e, and of the mirror lobe the parts
    that go with the reflectance, a, and without, b; errors are relative (DARK)."""

    pp: Tensor
    pe: Tensor
    pa: Tensor
    pb: Tensor
    ee: Tensor
    ea: Tensor
    eb: Tensor
    aa: Tensor
    ab: Tensor
    bb: Tensor
    views: Float[Tensor, "vertex"]
    """Number of them."""

    @property
    def color(self) -> Float[Tensor, "vertex 3"]:
        """Of paint without gloss that is as bright: what the photographs say before anybody asks what it is made of."""
        return self.pe / self.ee.clamp(min=1e-12)

    @property
    def floor(self) -> Float[Tensor, "vertex"]:
        """Of an error: the photographs' noise."""
        return 3 * NOISE**2 * self.views

    def error_of_paint(self, scale: float = 1.0) -> Float[Tensor, "vertex"]:
        """That the best paint leaves under the light times `scale`."""
        f = F0 * scale
        ey = self.pe - scale * self.eb - f * self.ea
        yy = self.pp - 2 * scale * self.pb + scale**2 * self.bb - 2 * f * (self.pa - scale * self.ab) + f**2 * self.aa
        d = (ey / self.ee.clamp(min=1e-12)).clamp(0, scale)
        return (yy - 2 * d * ey + d**2 * self.ee).clamp(min=0).sum(-1)

    def error_of_metal(self, scale: float = 1.0) -> Float[Tensor, "vertex"]:
        """That the best metal leaves under the light times `scale`."""
        f, ay = self.reflectance(scale), self.pa - scale * self.ab
        yy = self.pp - 2 * scale * self.pb + scale**2 * self.bb
        return (yy - 2 * f * ay + f**2 * self.aa).clamp(min=0).sum(-1)

    def reflectance(self, scale: float = 1.0) -> Float[Tensor, "vertex 3"]:
        """Of that metal, times `scale`."""
        return ((self.pa - scale * self.ab) / self.aa.clamp(min=1e-12)).clamp(0, scale)


def view_sums(tracer: AbstractTracer, targets: list[ViewTarget], light_of: LightOf) -> ViewSums:
    """Of the tracer's mesh, whose roughness is taken as known."""
    device = tracer.mesh.vertices.device
    # So many parts on any machine: sums must not depend on how many cores there are.
    edges = [len(targets) * k // VIEW_PARTS for k in range(VIEW_PARTS + 1)]
    parts = by_pool(lambda first, last: _sums_of(targets[first:last], tracer, light_of), edges, device)
    sums = torch.stack([part[0] for part in parts]).sum(0)
    pp, pe, pa, pb, ee, ea, eb, aa, ab, bb = sums.unbind()
    return ViewSums(pp, pe, pa, pb, ee, ea, eb, aa, ab, bb, torch.stack([part[1] for part in parts]).sum(0))


@torch.no_grad()
def _sums_of(targets: list[ViewTarget], tracer: AbstractTracer, light_of: LightOf) -> tuple[Tensor, Tensor]:
    """(10, vertex, 3) products and (vertex,) number of these views."""
    mesh = tracer.mesh
    count, device = len(mesh.vertices), mesh.vertices.device
    sums = torch.zeros(10, count, 3, device=device)
    views = torch.zeros(count, device=device)
    for target in targets:
        here = seen_vertices(tracer, target)
        seen, photo = here.index, here.photo
        if len(seen) == 0:
            continue
        normal, roughness = mesh.normals[seen], mesh.roughness[seen]
        light = light_of(target)
        transmittance, met = mirrored_radiance(tracer, here, light)

        white = torch.ones(len(seen), 3, device=device)
        shaded = partial(shade_split_sum, residual=0 * white, roughness=roughness, normal=normal, wo=here.wo, tables=light.tables)
        shaded = partial(shaded, light_from_world=light.light_from_world)
        lit = partial(shaded, transmittance=transmittance, hit_radiance=met, open_share=light.open_share[seen])
        b = lit(diffuse_albedo=0 * white, f0=0 * white)
        a, e = lit(diffuse_albedo=0 * white, f0=white) - b, lit(diffuse_albedo=white, f0=0 * white) - b
        weight = 1 / (photo + DARK) ** 2
        terms = (photo, e, a, b)
        products = (first * second for k, first in enumerate(terms) for second in terms[k:])
        for k, product in enumerate(products):
            sums[k].index_add_(0, seen, weight * product)
        views.index_add_(0, seen, torch.ones_like(roughness))
    return sums, views


def metal_evidence(sums: ViewSums, edges: MeshEdges, turned: bool, scale: float = 1.0) -> Float[Tensor, "vertex"]:
    """What the sums of a mesh with these edges say under the light times `scale`. `turned`: the light turns with the camera."""
    views, noise = sums.views, sums.floor
    finer = max(1.0, len(edges.vertices) / EDGES)
    alike = _alike(sums, edges)
    averaged = partial(_averaged, views=views, edges=edges, alike=alike, rings=round(NEIGHBOURHOOD * finer))
    plain = averaged(sums.error_of_paint(scale) + noise)
    metal = averaged(sums.error_of_metal(scale) + noise)
    floor = averaged(noise)
    unexplained = 1 - floor / metal.clamp(min=1e-12)
    relative_error = ((torch.minimum(plain, metal) - floor).clamp(min=0) / 3).sqrt()
    trust = 1 / (1 + (relative_error / LOST) ** 4)
    brightest = averaged(sums.reflectance(scale).amax(-1) / scale * views)
    dark = ((DARKEST[1] - brightest) / (DARKEST[1] - DARKEST[0])).clamp(0, 1)
    doubt = (DOUBT_TURNED if turned else DOUBT) - TOO_DARK * dark * dark * (3 - 2 * dark)
    better = torch.log(plain.clamp(min=1e-12) / metal.clamp(min=1e-12)) + doubt * trust * unexplained
    strength = torch.where(views >= FEWEST_VIEWS, trust * better.abs().clamp(max=STRONGEST), torch.zeros_like(better))
    weight, wish = strength + UNSEEN, torch.sign(better) * (strength > 0)
    joined, held = edges.vertices, TOGETHER * finer * alike
    if not turned:  # there it gains nothing (decisions/0003, "The same paint elsewhere")
        more, strengths = _paints(sums, plain - floor)
        paints = int(more.max()) + 1 - len(weight) if len(more) else 0
        weight, wish = torch.cat([weight, weight.new_full((paints,), UNSEEN)]), torch.cat([wish, wish.new_zeros(paints)])
        joined, held = torch.cat([joined, more]), torch.cat([held, strengths])
    kind = agree_along_edges(joined, weight, wish, held)[: len(strength)]
    return torch.tanh(kind / DECISIVE)


def _paints(sums: ViewSums, error: Float[Tensor, "vertex"]) -> tuple[Int[Tensor, "join 2"], Float[Tensor, "join"]]:
    """Joins of vertices, which paint explains well, with paints: further nodes, numbered after the vertices, that stand for a colour each; and how strong they are.

    Args:
        error: that paint leaves a view, without noise.
    """
    seen = (sums.views >= FEWEST_VIEWS).nonzero().squeeze(1)
    place = (sums.color[seen].clamp(min=1e-3).log() / SAME_COLOUR).double().cpu().numpy()
    if len(place) == 0:
        return seen.new_zeros(0, 2), error.new_zeros(0)
    paints, apart = [place[0]], np.linalg.norm(place - place[0], axis=1)
    while len(paints) < MOST_PAINTS and apart.max() > PAINTS_APART:
        paints.append(place[apart.argmax()])
        apart = np.minimum(apart, np.linalg.norm(place - paints[-1], axis=1))
    nearest = min(NEAREST_PAINTS, len(paints))
    distance, number = cKDTree(np.stack(paints)).query(place, k=range(1, nearest + 1))
    near = np.exp(-np.square(distance / PAINTS_APART))
    share = torch.from_numpy(near / near.sum(1, keepdims=True)).to(error)
    explained = torch.exp(-error[seen].clamp(min=0) / (3 * EXPLAINED**2))
    joined = torch.stack([seen.repeat_interleave(nearest), len(error) + torch.from_numpy(number.reshape(-1)).to(seen)], 1)
    return joined, ALIKE_ANYWHERE * (share * explained[:, None]).reshape(-1)


def light_scale(sums: ViewSums) -> float:
    """By what factor the light should be brighter, and paint and metal darker, to explain the photographs best; 1 where it is within RIGHT_SCALE of right,
    and where the photographs bound it on one side only.

    Light that is three times too bright makes chrome look like lead: its pictures are right, and those under any other light too dark.
    """
    seen = sums.views >= FEWEST_VIEWS
    if not bool(seen.any()):
        return 1.0

    def left(scale: float) -> float:
        error = torch.minimum(sums.error_of_metal(scale), sums.error_of_paint(scale)) + sums.floor
        return float(torch.log(error[seen] / sums.views[seen]).mean())

    errors = [left(scale) for scale in SCALES]
    best = min(range(len(SCALES)), key=errors.__getitem__)
    if best in (0, len(SCALES) - 1):
        return 1.0  # no light is too dim for what is black
    below, here, above = errors[best - 1 : best + 2]
    scale = SCALES[best] * (SCALES[1] / SCALES[0]) ** ((below - above) / (2 * max(below - 2 * here + above, 1e-9)))
    return scale if abs(math.log(scale)) > math.log(RIGHT_SCALE) else 1.0


def _alike(sums: ViewSums, edges: MeshEdges) -> Float[Tensor, "edge"]:
    """How much the ends of an edge hear each other, 1 where their colours are the same or not known."""
    start, end = edges.vertices.unbind(1)
    color, known = sums.color.clamp(min=1e-3).log(), sums.views >= FEWEST_VIEWS
    apart = color[start] - color[end]
    brighter = apart.mean(-1, keepdim=True)
    # What the three channels share, and what is left: their squares add up to that of the difference.
    unlike = (apart - brighter).square().sum(-1) + BRIGHTNESS * 3 * brighter.square()[:, 0]
    step = unlike * (known[start] & known[end])
    return torch.exp(-step / SAME_COLOUR**2).clamp(min=STRANGERS)


def _averaged(error: Tensor, views: Tensor, edges: MeshEdges, alike: Tensor, rings: int) -> Tensor:
    """(vertex,) error a view, averaged `rings` times over the neighbours by the number of views, and by how much these are `alike` (edge,)."""
    start, end = edges.vertices.unbind(1)
    total, weight = error, views
    for _ in range(rings):
        # An eighth each time, which loses nothing, or many rings would leave float32's range.
        total, weight = (
            (values + torch.zeros_like(values).index_add_(0, start, alike * values[end]).index_add_(0, end, alike * values[start])) / 8
            for values in (total, weight)
        )
    return total / weight.clamp(min=1e-30)  # counts, or nothing at all
