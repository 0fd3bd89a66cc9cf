"""Matter moves an asset: particles from its mesh, the material point method, and where that takes vertices and surfels, frame by frame.

In: an asset and a SimulationScene. Out: ClipFrames, which pose_scene shows and `save_clip` writes; frame 0 is the object at rest, the very
tensors of the asset. The simulation runs in coordinates about the object's centre, so that distance from the world's origin costs no
digits.
"""

import math
import shutil
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from drgs.deform.carry.carry_gaussians import carry_normals, carry_tangents
from drgs.deform.carry.drive_mesh import vertex_gradients
from drgs.deform.carry.gmls import GmlsSettings, Weights, build_weights, interpolate
from drgs.deform.clip import ClipFrame, blend_frames, save_clip
from drgs.deform.matter.checkpoint_simulation import read_progress, save_progress
from drgs.deform.matter.fill_particles import SPACINGS_A_CELL, FillSettings, Particles, fill_particles
from drgs.deform.matter.measure_solid import distances_from_solid, solid_around
from drgs.deform.matter.mpm import (
    LAWS,
    Box,
    Condition,
    GridSettings,
    Material,
    Model,
    MpmSettings,
    Plane,
    Solid,
    Sphere,
    State,
    advance,
    make_model,
    rest_state,
)
from drgs.deform.matter.mpm.records import Triple
from drgs.deform.matter.part_matter import bonds_at_rest, part_matter
from drgs.deform.matter.simulation_progress import SimulationProgress
from drgs.deform.matter.simulation_scene import Files, SimulationScene, make_condition, make_material, make_shape, refuse_files
from drgs.scene.asset import Asset
from drgs.scene.gaussians import surfel_tangents

LOOK_SECONDS = 0.1
"""Between two questions whether to go on, of who waits for a frame that another thread computes."""
LARGEST_STRETCH = 10.0
"""Of a surfel; and 1/10 the least. Matter may stretch further, its picture would only smear."""
LARGEST_LOOSE_STRETCH = 3.0
"""The same of surfels on sand and fluids: where those part, the mesh between them is drawn out and would pull needles."""
STILL = 1e-4
"""Cells a frame: below it, matter is at rest."""
STILL_FRAMES = 3
"""Frames at rest after which nothing is computed until something acts again."""
MOST_PARTS_NAMED = 3
"""Of those that may tear, in a warning."""
PINNED_CELLS = 1.5
"""How far from pinned vertices the grid stands still: as far as the matter there feels the grid [cells]."""
DOMAIN_MARGIN = 3.0
"""How far the simulated domain reaches beyond the object on every side, in sizes of the object."""


@dataclass(frozen=True)
class SimulationReport:
    """How a simulation went; what `drgs simulate --json` prints, and clip.json keeps."""

    particles: int
    dx: float
    """World units."""
    substeps: int
    retries: int
    frozen: int
    frames: int
    sleeping_frames: int
    """Frames in which nothing was computed because everything was at rest."""
    reached_wall: bool
    cut_faces: int
    """Faces of the mesh that would span matter that has come apart, and are not shown; the most of any frame."""
    grains: int
    """Particles that are shown in their place, each as a grain; the most of any frame."""
    warnings: tuple[str, ...]


class Simulation:
    """Frames of one asset in one scene, computed as far as somebody has asked, and kept. Final; safe to use from several threads."""

    def __init__(self, asset: Asset, scene: SimulationScene, find: Files = refuse_files, go_on: Callable[[], None] | None = None) -> None:
        """Fill the mesh and bind vertices and surfels; nothing moves yet. With many particles that takes seconds.

        Args:
            find: the files that the scene names. go_on: as of `frame`, between steps of this.

        Raises:
            ValueError: one sentence: the mesh encloses nothing, or the scene does not fit the object.
        """
        self.scene = scene
        self.frame_count = math.floor(scene.duration * scene.fps + 1e-6) + 1
        self._asset = asset
        self._lock = threading.Lock()
        mesh = asset.mesh
        self._center = ((mesh.vertices.amin(0).double() + mesh.vertices.amax(0).double()) / 2).cpu()
        local = (mesh.vertices.double() - self._center.to(mesh.vertices.device)).float()
        fill = FillSettings(scene.particles, surface="particles" if scene.variant == "paper" else "tracers", seed=scene.seed)
        filled = fill_particles(local, mesh.faces, fill, go_on)
        self.model = _make_model(asset, scene, filled, self._center, find)
        self._settings = MpmSettings(
            courant=scene.courant,
            transfer="pic" if scene.variant == "paper" else "apic",
            velocity_damping=scene.damping,
        )
        points = local
        if asset.gaussians is not None:
            centers = (asset.gaussians.centers.double() - self._center.to(local.device)).float()
            points = torch.cat([local, centers])
        if go_on is not None:
            go_on()
        gmls = GmlsSettings(isolated=3 * self.model.grid.dx, variant="paper_centred" if scene.variant == "paper" else "taylor")
        self._weights: Weights = build_weights(self.model.rest, points, gmls, (local, mesh.faces))
        self._bonds = bonds_at_rest(
            self.model, filled.interior, local, mesh.faces, points[len(local) :] if len(points) > len(local) else None
        )
        # Sand and fluids mix: what their particles have turned says nothing about the surface, which the moved mesh still tells.
        mixes = (self.model.laws == LAWS.index("drucker_prager")) | (self.model.laws == LAWS.index("fluid"))
        self._loose = mixes[self._weights.neighbours[:, 0].long()]
        self.warnings = _warnings(filled, self._center, scene.particles, holds=not bool(mixes.all()))
        _, nearest = cKDTree(local.cpu().numpy()).query(points.cpu().numpy()) if bool(self._loose.any()) else (None, [])
        self._nearest_vertex = torch.as_tensor(nearest, device=local.device)
        self._state = _first_state(self.model, scene)
        self._totals: dict[str, int | bool] = {
            "substeps": 0,
            "retries": 0,
            "frozen": 0,
            "sleeping": 0,
            "wall": False,
            "cut": 0,
            "grains": 0,
        }
        self._still = 0
        tangents = None if asset.gaussians is None else surfel_tangents(asset.gaussians)
        self._rest_tangents = tangents
        rest_centers = None if asset.gaussians is None else asset.gaussians.centers
        self._frames = [ClipFrame(mesh.vertices, mesh.normals, rest_centers, tangents)]
        self._frame_bytes = 0

    @property
    def report(self) -> SimulationReport:
        totals = self._totals
        return SimulationReport(
            len(self.model.rest), self.model.grid.dx, totals["substeps"], totals["retries"], totals["frozen"], len(self._frames),
            totals["sleeping"], bool(totals["wall"]), totals["cut"], totals["grains"], self.warnings,
        )  # fmt: skip

    @property
    def state(self) -> State:
        """Matter at the last frame computed, about the object's centre."""
        return self._state

    @property
    def frame_bytes(self) -> int:
        """Memory of the frames that were computed; the first, at rest, is the asset's own."""
        return self._frame_bytes

    def _append(self, frame: ClipFrame) -> None:
        before = {id(values) for values in self._frames[-1].arrays.values()}
        self._frame_bytes += sum(values.nbytes for values in frame.arrays.values() if id(values) not in before)
        self._frames.append(frame)

    @property
    def progress(self) -> SimulationProgress:
        """What was computed so far."""
        with self._lock:
            return SimulationProgress(tuple(self._frames), self._state, dict(self._totals), self._still)

    def go_on_from(self, progress: SimulationProgress) -> None:
        """As if what another run of the same asset and scene had made had been computed here."""
        with self._lock:
            self._frames, self._frame_bytes, self._state = list(progress.frames[:1]), 0, progress.state
            for frame in progress.frames[1:]:
                self._append(frame)
            self._totals, self._still = self._totals | progress.totals, progress.still

    def frame(self, index: int, go_on: Callable[[], None] | None = None) -> ClipFrame:
        """Frame `index`, or the last of the scene if it has fewer; computed now if need be.

        Args:
            go_on: called between two steps; what it raises ends the work, of which whole frames stay.
        """
        index = min(index, self.frame_count - 1)
        while True:
            # One frame at a time, so that who waits for an earlier one gets it, and who waits at all can give up.
            while not self._lock.acquire(timeout=-1 if go_on is None else LOOK_SECONDS):
                assert go_on is not None
                go_on()
            try:
                if len(self._frames) > index:
                    return self._frames[index]
                self._append(self._next_frame(go_on))
            finally:
                self._lock.release()
            if go_on is not None:
                go_on()

    def at(self, seconds: float, go_on: Callable[[], None] | None = None) -> ClipFrame:
        """What is seen at a time: between two frames, their mean by time; `go_on` as of `frame`."""
        position = min(max(seconds, 0.0) * self.scene.fps, self.frame_count - 1)
        first = math.floor(position + 1e-6)
        share = position - first
        if share <= 1e-6:
            return self.frame(first, go_on)
        return blend_frames(self.frame(first, go_on), self.frame(first + 1, go_on), share)

    def _next_frame(self, go_on: Callable[[], None] | None) -> ClipFrame:
        before, seconds = self._state, 1 / self.scene.fps
        if self._still >= STILL_FRAMES and not _acts_later(self.model.conditions, before.time):
            self._totals["sleeping"] += 1
            self._state = replace(before, time=before.time + seconds)
            return self._frames[-1]
        self._state, report = advance(self.model, before, seconds, self._settings, go_on)
        self._totals["substeps"] += report.substeps
        self._totals["retries"] += report.retries
        self._totals["frozen"] = report.frozen
        self._totals["wall"] |= report.at_wall
        moved = float((self._state.positions - before.positions).norm(dim=-1).max()) / self.model.grid.dx
        self._still = self._still + 1 if moved < STILL else 0
        if report.skipped:
            return self._frames[-1]
        return self._carry(self._state)

    def _carry(self, state: State) -> ClipFrame:
        mesh, vertices = self._asset.mesh, len(self._asset.mesh.vertices)
        positions, gradients = interpolate(self._weights, state.positions, state.total)
        if bool(self._loose.any()):
            of_mesh = vertex_gradients(mesh.vertices, positions[:vertices], mesh.faces)
            of_mesh = limit_stretch(of_mesh, LARGEST_LOOSE_STRETCH)
            gradients = torch.where(self._loose[:, None, None], of_mesh[self._nearest_vertex], gradients)
        parted = part_matter(self._bonds, state.positions, positions[:vertices], self._center)
        positions = (positions.double() + self._center.to(positions.device)).float()
        gradients = limit_stretch(gradients)
        if parted is not None:
            self._totals["cut"] = max(self._totals["cut"], int(parted.cut.sum()))
            self._totals["grains"] = max(self._totals["grains"], int(parted.shown.sum()))
        normals = carry_normals(mesh.normals, gradients[:vertices])
        if self._rest_tangents is None:
            return ClipFrame(positions, normals, None, None, parted)
        tangents = carry_tangents(self._rest_tangents, gradients[vertices:])
        return ClipFrame(positions[:vertices].contiguous(), normals, positions[vertices:].contiguous(), tangents, parted)


def simulate(
    asset: Asset,
    scene: SimulationScene,
    out: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
    find: Files = refuse_files,
    checkpoint: Path | None = None,
    warn: Callable[[str], None] | None = None,
) -> tuple[list[ClipFrame], SimulationReport]:
    """Simulate a whole scene, and write it as a clip if `out` says where.

    Args:
        progress: told of each finished frame and of how many there will be.
        find: the files that the scene names.
        checkpoint: folder that keeps every finished frame, and from which an interrupted run goes on, to the same clip; a clip that can be played meanwhile; removed in the end.
        warn: told of what will not look right before the first frame is computed; the report has it too.

    Raises:
        ValueError: one sentence: the mesh encloses nothing, the scene does not fit, or `out` is taken.
    """
    simulation = Simulation(asset, scene, find)
    if warn is not None:
        for sentence in simulation.warnings:
            warn(sentence)
    if checkpoint is not None:
        simulation.go_on_from(read_progress(checkpoint, simulation.progress, scene.model_dump_json()))
    found, kept = len(simulation.progress.frames), []
    for index in range(simulation.frame_count):
        kept.append(simulation.frame(index))
        if checkpoint is not None and index >= found:
            save_progress(checkpoint, simulation.progress, scene.model_dump_json(), scene.fps)
        if progress is not None and index >= found - 1:  # those that a killed run had told are not news
            progress(index + 1, simulation.frame_count)
    if out is not None:
        details = {
            "scene": scene.model_dump(mode="json"),
            "report": vars(simulation.report) | {"warnings": list(simulation.report.warnings)},
        }
        save_clip(out, kept, scene.fps, details)
    if checkpoint is not None:
        shutil.rmtree(checkpoint, ignore_errors=True)
    return kept, simulation.report


def limit_stretch(gradients: Float[Tensor, "n 3 3"], largest: float = LARGEST_STRETCH) -> Float[Tensor, "n 3 3"]:
    """(n, 3, 3) with singular values from 1 / largest to largest; matrices that have such values are returned as they were."""
    # sigma_1 <= |F|, and sigma_3 >= J / sigma_1^2.
    size = gradients.flatten(1).norm(dim=1)
    volume = (torch.linalg.cross(gradients[..., 0], gradients[..., 1]) * gradients[..., 2]).sum(-1)
    suspect = (size > largest) | (volume < size.square() / largest)
    if not bool(suspect.any()):
        return gradients
    u, s, vt = torch.linalg.svd(gradients[suspect].double())
    limited = gradients.clone()
    limited[suspect] = (u @ torch.diag_embed(s.clamp(1 / largest, largest)) @ vt).to(gradients.dtype)
    return limited


def _make_model(asset: Asset, scene: SimulationScene, filled: Particles, center: Float[Tensor, "3"], find: Files) -> Model:
    """Everything in world units, about the centre."""
    interior = filled.positions[: filled.interior]
    low, high = filled.positions.amin(0).double().cpu(), filled.positions.amax(0).double().cpu()
    size = float((high - low).max())
    axis = "xyz".index(scene.up)
    dx = SPACINGS_A_CELL * filled.spacing
    materials: list[Material] = [make_material(scene.matter, size, asset.meters_per_unit)]
    material_of = torch.zeros(len(filled.positions), dtype=torch.int64, device=interior.device)
    for region in scene.regions:
        held = _inside(_moved(make_shape(region.shape, dx, find), -center), filled.positions)
        if not bool(held.any()):
            raise ValueError(f"the region {str(region.shape.model_dump(exclude_none=True))[:200]} holds no part of the object")
        material_of[held] = len(materials)
        materials.append(make_material(region.matter, size, asset.meters_per_unit))
    if scene.room is not None:
        domain_low = torch.tensor(scene.room.minimum, dtype=torch.float64) - center
        domain_high = torch.tensor(scene.room.maximum, dtype=torch.float64) - center
    else:
        domain_low, domain_high = low - DOMAIN_MARGIN * size, high + DOMAIN_MARGIN * size
    conditions = [replace(c, shape=_moved(c.shape, -center)) for c in (make_condition(act, dx, find) for act in scene.acts)]
    if scene.floor is not None:
        height = float(low[axis]) if scene.floor.height is None else scene.floor.height - float(center[axis])
        conditions.append(Condition(Plane(_along(axis, height), _along(axis, 1.0)), scene.floor.effect, scene.floor.friction))
        domain_low[axis] = min(float(domain_low[axis]), height - 4 * dx)
    if scene.pins:
        if max(scene.pins) >= len(asset.mesh.vertices):
            raise ValueError(f"pins name vertex {max(scene.pins)}; the mesh has {len(asset.mesh.vertices)}, counted from 0")
        held = asset.mesh.vertices[torch.tensor(sorted(set(scene.pins)), device=interior.device)].double().cpu() - center
        # Last, so that nothing moves what is held.
        conditions.append(Condition(solid_around(held, PINNED_CELLS * dx, dx), "sticky"))
    gravity = _along(axis, -scene.gravity / asset.meters_per_unit)
    grid = GridSettings(_triple(domain_low), _triple(domain_high), dx)
    return make_model(filled.positions, filled.volumes, tuple(materials), material_of, grid, gravity, tuple(conditions))


def _along(axis: int, length: float) -> Triple:
    """A vector along a coordinate axis."""
    return (length if axis == 0 else 0.0, length if axis == 1 else 0.0, length if axis == 2 else 0.0)


def _triple(vector: Tensor) -> Triple:
    x, y, z = vector.tolist()
    return x, y, z


def _first_state(model: Model, scene: SimulationScene) -> State:
    weight = model.masses[:, None] / model.masses.sum()
    arm = model.rest - (weight * model.rest).sum(0)
    spin = model.rest.new_tensor(scene.spin).expand_as(model.rest)
    state = rest_state(model, (torch.linalg.cross(spin, arm) + model.rest.new_tensor(scene.velocity)).contiguous())
    x, y, z = scene.spin
    turning = model.rest.new_tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return replace(state, affine=turning.expand_as(state.affine).contiguous())


def _moved(shape: Plane | Sphere | Box | Solid, shift: Tensor) -> Plane | Sphere | Box | Solid:
    def place(point: Triple) -> Triple:
        x, y, z = shift.tolist()
        return point[0] + x, point[1] + y, point[2] + z

    if isinstance(shape, Plane):
        return Plane(place(shape.point), shape.normal)
    if isinstance(shape, Sphere):
        return Sphere(place(shape.center), shape.radius)
    if isinstance(shape, Solid):
        return Solid(place(shape.minimum), shape.spacing, shape.distances)
    return Box(place(shape.minimum), place(shape.maximum))


def _inside(shape: Plane | Sphere | Box | Solid, points: Tensor) -> Tensor:
    if isinstance(shape, Plane):
        return (points - points.new_tensor(shape.point)) @ points.new_tensor(shape.normal) <= 0
    if isinstance(shape, Sphere):
        return (points - points.new_tensor(shape.center)).norm(dim=-1) <= shape.radius
    if isinstance(shape, Solid):
        return distances_from_solid(shape, points) <= 0
    return ((points >= points.new_tensor(shape.minimum)) & (points <= points.new_tensor(shape.maximum))).all(-1)


def _acts_later(conditions: tuple[Condition, ...], time: float) -> bool:
    """Whether something moves, pushes, begins or ends from now on."""
    return any(time < c.start or (math.isfinite(c.end) and time < c.end) or (any(c.velocity) and time < c.end) for c in conditions)


def _warnings(filled: Particles, center: Float[Tensor, "3"], particles: int, holds: bool) -> tuple[str, ...]:
    """
    Args:
        center: of the object, where the particles have their origin.
        particles: that were asked for.
        holds: some of the matter is not sand and no fluid.
    """
    if filled.torn_parts and holds:
        cell, shown = SPACINGS_A_CELL * filled.spacing, []
        for part in filled.torn_parts[:MOST_PARTS_NAMED]:
            middle = (center + torch.tensor(part.middle, dtype=torch.float64)).tolist()
            place = ", ".join(f"{round(value, 2) + 0.0:.2f}" for value in middle)
            shown.append(f"{part.thickness:.3g} about ({place})")
        # Cells shrink with the cube root of the number of particles.
        enough = particles * (cell / min(part.thickness for part in filled.torn_parts)) ** 3
        return (
            f"{sum(part.share for part in filled.torn_parts):.0%} of the surface belongs to parts thinner than one grid cell ({cell:.3g}), "
            f"which may tear: {', '.join(shown)}; some {float(f'{enough:.1e}'):,.0f} particles would give each of them a cell",
        )
    if filled.thin_share > 0.1:
        return (
            f"{filled.thin_share:.0%} of the surface belongs to parts thinner than three grid cells, which bend too easily: "
            "use more particles",
        )
    return ()
