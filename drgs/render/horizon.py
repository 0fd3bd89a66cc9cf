"""How high above each triangle the mesh may rise: rays that leave a triangle above that horizon meet nothing and need not be traced.

In: a mesh. Out: for each face and each of SECTORS sectors of azimuth the sine of an elevation over its plane; whatever the mesh has there lies
below. A proof, not a sample: a triangle counts as below elevation e when one plane that leans outwards at e, and that the whole face lies behind, has
it on its outer side. Such planes are tried in the directions of the face's edges and eight more, so the horizon errs upwards only. A triangle that lies
wholly behind the face as seen along a sector concerns other sectors only. A face of a convex mesh has horizon 0, one inside a fold more than 1.

Groups of triangles, neighbours along a space-filling curve, are dismissed by their boxes. The cosine-weighted share of the sky below
elevation e is sin^2 e.
"""

import math
from functools import cached_property
from pathlib import Path

import torch
import warp as wp
from torch import Tensor

from drgs.scene.mesh import TriangleMesh
from drgs.warp_torch import launch, warp_array, warp_device

wp.set_module_options({"enable_backward": False})

GROUP = wp.constant(16)
"""Triangles of a group."""
SUPER = wp.constant(16)
"""Groups of a group of groups."""
DIRECTIONS = wp.constant(11)
SECTORS = 8
"""Of azimuth, an eighth of a turn each."""
POLE = wp.constant(0.02)
"""Sine of the tilt off the z axis below which a face has the same horizon all around: there rounding turns its frame. Above, by less than
1e-5, and nothing counts as behind a face that does not keep the lift away from it, which is 1e-5 of the mesh's extent."""
STEEPEST = wp.constant(1.75)
"""Tangent of the elevation above which a horizon is of no use."""
BLOCKED = 2.0
"""Horizon of faces that no ray can be let off from."""
MARGIN = 1e-5
"""Added to the sine, against rounding."""
STORED_STEPS, STORED_BLOCKED = 254.0, 255
"""Of the sine as a byte; the byte of those that are of no use."""

RAYS_A_FACE = 1000
"""Traced rays that pay for one face that rays start from: with these, looking costs about an eighth of a pass (120 000 faces: 23 to 32 us a
face, 210 ns a ray)."""
RAYS_A_FACE_AHEAD = 4000
"""For one that nothing asked for yet: a moving camera should not wait for what it may see later."""
MIN_FACES = 256
"""Fewer are not worth a launch."""
TRIAL = 0.05
"""Share of the faces after which hopelessness is judged."""
WORTHWHILE = 0.1
"""Share of rays spared below which the search ends."""

Planes = wp.types.matrix(shape=(11, 3), dtype=float)
Supports = wp.types.vector(length=11, dtype=float)
Tangents = wp.types.vector(length=8, dtype=float)
Passed = wp.types.vector(length=8, dtype=wp.int32)


@wp.func
def horizon_frame(normal: wp.vec3) -> wp.vec3:
    """First axis of the frame in which azimuths over a face are counted; the second is normal x first."""
    across = wp.sqrt(normal[0] * normal[0] + normal[1] * normal[1])
    if across > 0.0:
        return wp.vec3(-normal[1] / across, normal[0] / across, 0.0)
    return wp.vec3(1.0, 0.0, 0.0)


@wp.func
def horizon_sector(normal: wp.vec3, direction: wp.vec3) -> int:
    """Which of a face's horizons a direction is to be compared with."""
    u = horizon_frame(normal)
    x = wp.dot(u, direction)
    y = wp.dot(wp.cross(normal, u), direction)
    return wp.where(x < 0.0, 1, 0) + wp.where(y < 0.0, 2, 0) + wp.where(wp.abs(y) > wp.abs(x), 4, 0)


@wp.func
def ratio(above: float, beyond: float, tolerance: float) -> float:
    """Tangent at which a point `above` the face's plane and `beyond` its edge is just on the outer side of a plane."""
    if above <= 0.0:
        return wp.where(beyond >= -tolerance, 0.0, 1.0e30)
    return wp.where(beyond > 0.0, above / wp.max(beyond, 1.0e-30), 1.0e30)


@wp.func
def box_above(normal: wp.vec3, base: float, low: wp.vec3, high: wp.vec3, tangent: float, planes: Planes, supports: Supports) -> wp.bool:
    """Whether a box may hold something above elevation `tangent`."""
    middle = 0.5 * (low + high)
    half = 0.5 * (high - low)
    above = wp.dot(normal, middle) + wp.dot(wp.abs(normal), half) - base
    if above <= 0.0:
        return False
    for k in range(DIRECTIONS):
        h = wp.vec3(planes[k, 0], planes[k, 1], planes[k, 2])
        beyond = wp.dot(h, middle) - wp.dot(wp.abs(h), half) - supports[k]
        if beyond > 0.0 and above <= tangent * beyond:
            return False
    return True


@wp.kernel
def raise_horizons(
    first: int,
    which: wp.array[int],
    corners: wp.array[wp.vec3],
    face_count: int,
    group_low: wp.array[wp.vec3],
    group_high: wp.array[wp.vec3],
    super_low: wp.array[wp.vec3],
    super_high: wp.array[wp.vec3],
    lift: float,
    # outputs
    tangent_out: wp.array[float],
):
    f = which[first + wp.tid()]
    a = corners[3 * f]
    b = corners[3 * f + 1]
    c = corners[3 * f + 2]
    cross = wp.cross(b - a, c - a)
    area = wp.length(cross)
    if area <= 0.0:
        for k in range(8):
            tangent_out[8 * f + k] = 1.0e30
        return
    normal = cross / area
    # Rays start at `lift` above the plane: what stays below half of it is out of their reach.
    base = wp.max(wp.max(wp.dot(normal, a), wp.dot(normal, b)), wp.dot(normal, c)) + 0.5 * lift
    u = horizon_frame(normal)
    v = wp.cross(normal, u)
    planes = Planes()
    supports = Supports()
    behind = Tangents()
    for k in range(DIRECTIONS):
        angle = 0.78539816339 * float(k)
        h = wp.cos(angle) * u + wp.sin(angle) * v
        if k == 8:
            h = wp.normalize(wp.cross(b - a, normal))
        if k == 9:
            h = wp.normalize(wp.cross(c - b, normal))
        if k == 10:
            h = wp.normalize(wp.cross(a - c, normal))
        planes[k, 0] = h[0]
        planes[k, 1] = h[1]
        planes[k, 2] = h[2]
        supports[k] = wp.max(wp.max(wp.dot(h, a), wp.dot(h, b)), wp.dot(h, c))
        if k < 8:
            behind[k] = wp.min(wp.min(wp.dot(h, a), wp.dot(h, b)), wp.dot(h, c)) - lift
    tangents = Tangents()
    passed = Passed()
    tangent = wp.float32(0.0)  # the least of them
    groups = (face_count + GROUP - 1) // GROUP
    supers = (groups + SUPER - 1) // SUPER
    own = f // (GROUP * SUPER)
    # The face's own neighbourhood first: it is what most often shows that there is nothing to gain.
    for turn in range(supers):
        s = own + turn
        if s >= supers:
            s -= supers
        if tangent < STEEPEST:  # noqa: SIM102 (Warp's `and` evaluates both)
            if box_above(normal, base, super_low[s], super_high[s], tangent, planes, supports):
                for g in range(s * SUPER, wp.min((s + 1) * SUPER, groups)):
                    if tangent < STEEPEST:  # noqa: SIM102
                        if box_above(normal, base, group_low[g], group_high[g], tangent, planes, supports):
                            for t in range(g * GROUP, wp.min((g + 1) * GROUP, face_count)):
                                p = corners[3 * t]
                                q = corners[3 * t + 1]
                                r = corners[3 * t + 2]
                                above_p = wp.dot(normal, p) - base
                                above_q = wp.dot(normal, q) - base
                                above_r = wp.dot(normal, r) - base
                                if wp.max(wp.max(above_p, above_q), above_r) > 0.0:
                                    lowest = wp.float32(1.0e30)
                                    for k in range(8):
                                        h = wp.vec3(planes[k, 0], planes[k, 1], planes[k, 2])
                                        farthest = wp.max(wp.max(wp.dot(h, p), wp.dot(h, q)), wp.dot(h, r))
                                        passed[k] = wp.where(farthest < behind[k], 1, 0)
                                    for k in range(DIRECTIONS):
                                        h = wp.vec3(planes[k, 0], planes[k, 1], planes[k, 2])
                                        needed = wp.max(
                                            wp.max(
                                                ratio(above_p, wp.dot(h, p) - supports[k], 0.1 * lift),
                                                ratio(above_q, wp.dot(h, q) - supports[k], 0.1 * lift),
                                            ),
                                            ratio(above_r, wp.dot(h, r) - supports[k], 0.1 * lift),
                                        )
                                        lowest = wp.min(lowest, needed)
                                    tangent = wp.float32(1.0e30)
                                    for k in range(8):
                                        out = passed[(k + 7) % 8] + passed[k] + passed[(k + 1) % 8] + passed[(k + 2) % 8]
                                        tangents[k] = wp.where(out == 0, wp.max(tangents[k], lowest), tangents[k])
                                        tangent = wp.min(tangent, tangents[k])
    most = wp.float32(0.0)
    for k in range(8):
        most = wp.max(most, tangents[k])
    pole = wp.sqrt(normal[0] * normal[0] + normal[1] * normal[1]) < POLE
    for k in range(8):
        # Sector k begins at k eighths of a turn; the order is horizon_sector's.
        angle = 0.78539816339 * (float(k) + 0.5)
        at = horizon_sector(normal, wp.cos(angle) * u + wp.sin(angle) * v)
        tangent_out[8 * f + at] = wp.where(pole, most, tangents[k])


def _source_of_face_horizon() -> str:
    assert int(GROUP) == int(SUPER) == 16  # the lanes of a vector
    folder = Path(__file__).parent
    constants = f"constexpr int DIRECTIONS = {int(DIRECTIONS)};\nconstexpr float STEEPEST = {float(STEEPEST)}f, POLE = {float(POLE)}f;\n"
    return constants + (folder / "rasterize_gbuffer" / "tile_vector.h").read_text() + (folder / "horizon.h").read_text()


@wp.func_native(_source_of_face_horizon())
def face_horizon(
    f: int, corners: wp.array(dtype=wp.vec3), lanes: wp.array(dtype=float), group_boxes: wp.array(dtype=float),
    super_boxes: wp.array(dtype=float), lift: float, tangent_out: wp.array(dtype=float),
): ...  # fmt: skip


@wp.kernel(enable_backward=False, module="unique")
def raise_horizons_simd(
    first: int,
    which: wp.array[int],
    corners: wp.array[wp.vec3],
    lanes: wp.array[float],
    group_boxes: wp.array[float],
    super_boxes: wp.array[float],
    lift: float,
    # outputs
    tangent_out: wp.array[float],
):
    """raise_horizons on the CPU."""
    face_horizon(which[first + wp.tid()], corners, lanes, group_boxes, super_boxes, lift, tangent_out)


def _curve_order(points: Tensor) -> Tensor:
    """Places of points (n, 3) along a Z-order curve of 1024 steps a side."""
    low, high = points.amin(0), points.amax(0)
    cell = ((points - low) / (high - low).clamp(min=1e-30) * 1023).long()
    for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):  # two empty bits behind each
        cell = (cell | (cell << shift)) & mask
    code = cell[:, 0] | (cell[:, 1] << 1) | (cell[:, 2] << 2)
    return torch.argsort(code)


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
    """The horizons of a mesh's faces, found a share at a time as rays show that they will be needed. Final.

    Rays pay for them, once as many were traced as TRIAL of the faces cost: after each pass as many faces are looked at as make up a fixed share of the pass's own cost. The first TRIAL of
    all faces come in a scattered order, and when they say that hardly a ray would be let off, the search ends; then those that rays
    start from, then the rest.
    """

    sine: Tensor
    """(face, SECTORS) sine of the elevation over each face's plane below which the mesh stays; BLOCKED where nothing is known."""

    def __init__(self, mesh: TriangleMesh, lift: float, stored: Tensor | None = None) -> None:
        """
        Args:
            lift: height above their triangle from which rays start [world units] (AbstractTracer.lift).
            stored: (face, SECTORS) uint8, stored_horizons of this very mesh: nothing is left to be found.
        """
        if stored is not None:
            self.sine = torch.where(stored == STORED_BLOCKED, BLOCKED, stored.float() / STORED_STEPS).contiguous()
            self.found = len(stored)
            self._open_sky = float((1 - self.sine.square()).clamp(min=0).sum())
            return
        device = mesh.vertices.device
        self.sine = torch.full((len(mesh.faces), SECTORS), BLOCKED, device=device)
        self.found = 0
        """Faces looked at so far."""
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
        """(face,) along a curve; places are those in it."""
        return _curve_order(self._corners_by_face.mean(1))

    @cached_property
    def _corners(self) -> Tensor:
        """(face, 3, 3) along the curve."""
        return self._corners_by_face[self._order].contiguous()

    @cached_property
    def _scattered(self) -> Tensor:
        """All places, neighbours far apart."""
        count = self.faces
        stride = next(s for s in range(max(1, int(0.618 * count)), count + 2) if math.gcd(s, count) == 1)
        return torch.arange(count, device=self.sine.device) * stride % count

    @cached_property
    def _place(self) -> Tensor:
        """(face,) its place along the curve."""
        place = torch.empty_like(self._order)
        place[self._order] = torch.arange(self.faces, device=place.device)
        return place

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
        """Look at as many faces as `rays` traced rays pay for.

        Args:
            starts: (point,) faces that the rays started from, -1 for none.
        """
        if self.found == self.faces or self._hopeless():
            return
        if self._waited < RAYS_A_FACE * TRIAL * self.faces:  # short renders and meshes that move with every frame would never earn it back
            self._waited += rays
            return
        self._rays += rays
        trial = math.ceil(TRIAL * self.faces) - self.found
        if trial > 0:
            which, price = self._ahead(trial), RAYS_A_FACE
        else:
            which, price = self._wanted(starts), RAYS_A_FACE
            if len(which) == 0:
                which, price = self._ahead(self.faces), RAYS_A_FACE_AHEAD
        due = which[: self._rays // price]
        if len(due) >= min(MIN_FACES, len(which)):
            # What is left over is kept within bounds: no frame shall wait for a burst.
            self._rays = min(self._rays - price * len(due), RAYS_A_FACE_AHEAD * MIN_FACES)
            self._look_at(due)

    def find(self, faces: int) -> None:
        """Look at the next `faces` faces."""
        self._look_at(self._ahead(faces))

    def _ahead(self, faces: int) -> Tensor:
        """The next places of unknown faces in the scattered order."""
        return self._scattered[~self._known[self._scattered]][:faces]

    def _wanted(self, starts: Tensor | None) -> Tensor:
        """Places of the unknown ones among faces."""
        if starts is None:
            return self._scattered[:0]
        places = self._place[starts[starts >= 0].long()]
        return torch.unique(places[~self._known[places]])

    def _look_at(self, which: Tensor) -> None:
        """Faces at places along the curve."""
        if len(which) == 0 or self._hopeless():
            return
        which = which.int()
        tangent = torch.empty(self.faces, SECTORS, device=self.sine.device)
        boxes = [warp_array(box, wp.vec3) for box in self._boxes]
        corners, device = [warp_array(which), warp_array(self._corners.view(-1, 3), wp.vec3)], warp_device(tangent)
        if tangent.is_cuda:
            launch(raise_horizons, len(which), [*corners, self.faces, *boxes, self._lift], [warp_array(tangent.view(-1))], device)
        else:
            lanes = [warp_array(values.view(-1)) for values in self._lanes]
            launch(raise_horizons_simd, len(which), [*corners, *lanes, self._lift], [warp_array(tangent.view(-1))], device)
        tangent = tangent[which.long()]
        sine = tangent / torch.sqrt(1 + tangent.square().clamp(max=1e12)) + MARGIN
        sine = torch.where(tangent < float(STEEPEST), sine, BLOCKED)
        self.sine[self._order[which.long()]] = sine
        self._open_sky += float((1 - sine.square()).clamp(min=0).sum())
        self._known[which.long()] = True
        self.found += len(which)

    def _hopeless(self) -> bool:
        return TRIAL * self.faces <= self.found < self.faces and self.spared() < WORTHWHILE

    def spared(self) -> float:
        """Share of cosine-weighted rays from the faces looked at that need no tracing (each face counting alike)."""
        return self._open_sky / (SECTORS * self.found) if self.found else 0.0


def usable_horizons(horizons: Horizons | None, blocked_share: float = 0.0) -> Tensor | None:
    """(face, SECTORS) horizons for shade; those of faces with at most `blocked_share` of the cosine-weighted sky are taken for nothing."""
    if horizons is None or horizons.found == 0:
        return None
    if blocked_share <= 0:
        return horizons.sine
    return torch.where(horizons.sine.square().mean(1, keepdim=True) <= blocked_share, -1.0, horizons.sine)


def stored_horizons(sine: Tensor) -> Tensor:
    """(face, SECTORS) uint8 of horizons, rounded up: an asset keeps them so."""
    steps = torch.ceil(sine * STORED_STEPS)
    return torch.where(steps < STORED_BLOCKED, steps, STORED_BLOCKED).to(torch.uint8)


def find_horizons(mesh: TriangleMesh, lift: float) -> Tensor:
    """(face, SECTORS) horizons of all faces at once."""
    horizons = Horizons(mesh, lift)
    while horizons.found < horizons.faces and not horizons._hopeless():
        horizons.find(horizons.faces)
    return horizons.sine
