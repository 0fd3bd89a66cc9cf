"""How high the mesh rises above each of its triangles: rays that leave a triangle above that horizon meet nothing and are not traced.

In: a mesh. Out: for each face and each of SECTORS sectors of azimuth, the sine of an elevation over the face's plane below which all of the
mesh lies.

A proof, not a sample. A triangle lies below elevation e if one plane, tilted outwards at e with the whole face behind it, has the triangle
on its outer side. Such planes are tried along the face's three edges and in eight more directions, so a horizon is at worst too high.
A triangle wholly behind the face, as seen along a sector, does not count in that sector. A face of a convex mesh has horizon 0.

Triangles in the order of a space-filling curve form groups, which are dismissed by their boxes. The cosine-weighted share of the sky below
elevation e is sin^2 e. The kernels are horizon_kernels.py's.
"""

import math
from functools import cached_property

import torch
import warp as wp
from torch import Tensor

from drgs.maths.z_order import z_order
from drgs.render.intersect.horizon_kernels import GROUP, SECTORS, STEEPEST, SUPER, raise_horizons, raise_horizons_simd
from drgs.scene.mesh import TriangleMesh
from drgs.warp_torch import launch, warp_array, warp_device

BLOCKED = 2.0
"""Sentinel: always trace."""
MARGIN = 1e-5
"""Added to the sine, against rounding."""
STORED_STEPS, STORED_BLOCKED = 254.0, 255
"""A sine of 1 as a byte; and the byte of BLOCKED."""

RAYS_A_FACE = 1000
"""Traced rays after which one more face is examined, if rays start from it: examining then takes about an eighth of a pass (120 000 faces:
23 to 32 us a face, 210 ns a ray)."""
RAYS_A_FACE_AHEAD = 4000
"""The same for a face that no ray starts from yet: a moving camera should not wait for what it may see later."""
MIN_FACES = 256
"""Fewer are not worth a launch."""
TRIAL = 0.05
"""Share of the faces after which the search may be given up."""
WORTHWHILE = 0.1
"""Share of rays spared below which it is."""


def _boxes(corners: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Boxes of runs of `size` triangles (face, 3, 3), the last run possibly short."""
    missing = -len(corners) % size
    padded = torch.cat([corners, corners[-1:].expand(missing, 3, 3)]).reshape(-1, 3 * size, 3)
    return padded.amin(1), padded.amax(1)


def _box_lanes(low: Tensor, high: Tensor) -> Tensor:
    """(box / 16, 6, 16) of boxes (box, 3); what is missing in the last lanes is empty and lies below everything."""
    missing = -len(low) % 16
    low = torch.cat([low, low.new_full((missing, 3), 1e30)])
    high = torch.cat([high, high.new_full((missing, 3), -1e30)])
    return torch.cat([low, high], 1).view(-1, 16, 6).transpose(1, 2).contiguous()


class Horizons:
    """The horizons of a mesh's faces, examined bit by bit while frames are rendered. Final.

    After each pass a number of faces is examined that is in proportion to the rays traced. First TRIAL of all faces, scattered over the
    mesh: if they show that hardly any ray would be spared, the search ends. Then the faces that rays start from; then the rest.
    """

    sine: Tensor
    """(face, SECTORS) sine of the elevation below which the mesh lies; BLOCKED where nothing is known."""

    def __init__(self, mesh: TriangleMesh, lift: float, stored: Tensor | None = None) -> None:
        """
        Args:
            lift: height above their triangle from which rays start [world units] (AbstractTracer.lift).
            stored: (face, SECTORS) uint8, stored_horizons of this very mesh: nothing is left to examine.
        """
        if stored is not None:
            self.sine = torch.where(stored == STORED_BLOCKED, BLOCKED, stored.float() / STORED_STEPS).contiguous()
            self.found = len(stored)
            self._open_sky = float((1 - self.sine.square()).clamp(min=0).sum())
            return
        device = mesh.vertices.device
        self.sine = torch.full((len(mesh.faces), SECTORS), BLOCKED, device=device)
        self.found = 0
        """Faces examined so far."""
        self._mesh = mesh
        self._lift = lift
        self._rays = 0
        self._waited = 0
        self._open_sky = 0.0
        self._known = torch.zeros(len(mesh.faces), dtype=torch.bool, device=device)

    @cached_property
    def _corners_by_face(self) -> Tensor:
        return self._mesh.vertices.detach().float()[self._mesh.faces.long()]

    @cached_property
    def _order(self) -> Tensor:
        """(face,) faces along the curve; a face's rank is its position in it."""
        return z_order(self._corners_by_face.mean(1))

    @cached_property
    def _corners(self) -> Tensor:
        """(face, 3, 3) along the curve."""
        return self._corners_by_face[self._order].contiguous()

    @cached_property
    def _scattered(self) -> Tensor:
        """All ranks, neighbours far apart."""
        count = self.faces
        stride = next(s for s in range(max(1, int(0.618 * count)), count + 2) if math.gcd(s, count) == 1)
        return torch.arange(count, device=self.sine.device) * stride % count

    @cached_property
    def _rank(self) -> Tensor:
        """(face,) position along the curve."""
        rank = torch.empty_like(self._order)
        rank[self._order] = torch.arange(self.faces, device=rank.device)
        return rank

    @cached_property
    def _boxes(self) -> tuple[Tensor, ...]:
        group = int(GROUP)
        return (*_boxes(self._corners, group), *_boxes(self._corners, group * int(SUPER)))

    @cached_property
    def _lanes(self) -> tuple[Tensor, ...]:
        """What raise_horizons_simd reads: triangles and boxes by sixteens."""
        group = int(GROUP)
        padded = torch.cat([self._corners, self._corners[-1:].expand(-self.faces % group, 3, 3)])
        triangles = padded.view(-1, group, 9).transpose(1, 2).contiguous()  # the last triangle repeated changes nothing
        return triangles, _box_lanes(*self._boxes[:2]), _box_lanes(*self._boxes[2:])

    @property
    def faces(self) -> int:
        return len(self.sine)

    def pay(self, rays: int, starts: Tensor | None = None) -> None:
        """Examine as many faces as go with so many more traced rays; none on CUDA, where a few faces at a time leave the device idle and rays
        are cheap.

        Args:
            starts: (point,) faces that the rays started from, -1 for none.
        """
        # On an H100 the search took two of a picture's 2.6 s (teapot, 512 rays a pixel); an asset brings its horizons with it.
        if self.found == self.faces or self.sine.is_cuda or self._is_hopeless():
            return
        if (
            self._waited < RAYS_A_FACE * TRIAL * self.faces
        ):  # in short renders, and on a mesh that moves with every frame, it would never pay off
            self._waited += rays
            return
        self._rays += rays
        trial = math.ceil(TRIAL * self.faces) - self.found
        if trial > 0:
            ranks, price = self._ahead(trial), RAYS_A_FACE
        else:
            ranks, price = self._wanted(starts), RAYS_A_FACE
            if len(ranks) == 0:
                ranks, price = self._ahead(self.faces), RAYS_A_FACE_AHEAD
        due = ranks[: self._rays // price]
        if len(due) >= min(MIN_FACES, len(ranks)):
            # Rays left over are kept, within bounds: no frame shall wait for a burst.
            self._rays = min(self._rays - price * len(due), RAYS_A_FACE_AHEAD * MIN_FACES)
            self._examine(due)

    def find(self, faces: int) -> None:
        """Examine so many more faces."""
        self._examine(self._ahead(faces))

    def _ahead(self, faces: int) -> Tensor:
        """Ranks of the next unknown faces in the scattered order."""
        return self._scattered[~self._known[self._scattered]][:faces]

    def _wanted(self, starts: Tensor | None) -> Tensor:
        """Ranks of the unknown ones among faces (point,), -1 for none."""
        if starts is None:
            return self._scattered[:0]
        ranks = self._rank[starts[starts >= 0].long()]
        return torch.unique(ranks[~self._known[ranks]])

    def _examine(self, ranks: Tensor) -> None:
        """Find the horizons of the faces of these ranks (face,)."""
        if len(ranks) == 0 or self._is_hopeless():
            return
        ranks = ranks.sort().values.int()  # neighbours read the same of the mesh
        tangent = torch.empty(self.faces, SECTORS, device=self.sine.device)
        boxes = [warp_array(box, wp.vec3) for box in self._boxes]
        corners, device = [warp_array(ranks), warp_array(self._corners.view(-1, 3), wp.vec3)], warp_device(tangent)
        if tangent.is_cuda:
            launch(raise_horizons, len(ranks), [*corners, self.faces, *boxes, self._lift], [warp_array(tangent.view(-1))], device)
        else:
            lanes = [warp_array(values.view(-1)) for values in self._lanes]
            # Hollows take far longer than what lies open, and lie together.
            launch(
                raise_horizons_simd,
                len(ranks),
                [*corners, *lanes, self._lift],
                [warp_array(tangent.view(-1))],
                device,
                slices_per_thread=32,
            )
        tangent = tangent[ranks.long()]
        sine = tangent / torch.sqrt(1 + tangent.square().clamp(max=1e12)) + MARGIN
        sine = torch.where(tangent < float(STEEPEST), sine, BLOCKED)
        self.sine[self._order[ranks.long()]] = sine
        self._open_sky += float((1 - sine.square()).clamp(min=0).sum())
        self._known[ranks.long()] = True
        self.found += len(ranks)

    def _is_hopeless(self) -> bool:
        return TRIAL * self.faces <= self.found < self.faces and self.spared() < WORTHWHILE

    def spared(self) -> float:
        """Share of cosine-weighted rays from the examined faces that need no tracing; each face counts alike."""
        return self._open_sky / (SECTORS * self.found) if self.found else 0.0


def usable_horizons(horizons: Horizons | None, blocked_share: float = 0.0) -> Tensor | None:
    """(face, SECTORS) horizons for the integrators; None where no face was examined.

    Args:
        blocked_share: of the cosine-weighted sky; faces whose horizons hide no more count as open.
    """
    if horizons is None or horizons.found == 0:
        return None
    if blocked_share <= 0:
        return horizons.sine
    return torch.where(horizons.sine.square().mean(1, keepdim=True) <= blocked_share, -1.0, horizons.sine)


def stored_horizons(sine: Tensor) -> Tensor:
    """(face, SECTORS) uint8 of horizons, rounded up, as an asset keeps them."""
    steps = torch.ceil(sine * STORED_STEPS)
    return torch.where(steps < STORED_BLOCKED, steps, STORED_BLOCKED).to(torch.uint8)


def find_horizons(mesh: TriangleMesh, lift: float) -> Tensor:
    """(face, SECTORS) horizons of all faces at once."""
    horizons = Horizons(mesh, lift)
    while horizons.found < horizons.faces and not horizons._is_hopeless():
        horizons.find(horizons.faces)
    return horizons.sine
