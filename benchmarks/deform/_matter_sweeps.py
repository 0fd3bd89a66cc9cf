"""Deformation and simulation at their extremes: what `stability_deformation` writes down at length, and tests/stress asks of smaller sweeps."""

import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

import torch
import trimesh
from torch import Tensor

from benchmarks.deform.simulate import falling_cube
from drgs.deform.carry.carry_gaussians import carry_normals, carry_tangents, decompose_tangents
from drgs.deform.carry.drive_mesh import vertex_gradients
from drgs.deform.carry.gmls import build_weights, interpolate
from drgs.deform.displace.arap import ArapHandles
from drgs.deform.matter.mpm import LAWS, Material, Model, MpmSettings, State, advance, measure_balance, rest_state
from drgs.deform.matter.mpm.records import Law

DETERMINANTS = (-1.0, -1e-3, -1e-6, 0.0, 1e-6, 1e-3, 1.0, 1e3)
SPACING = 1 / 16
"""Of particles in the sweeps of neighbourhoods."""


@dataclass(frozen=True)
class Row:
    """One case and what became of it."""

    case: str
    values: dict[str, float | int] = field(default_factory=dict)
    not_finite: int = 0
    """NaN or infinite values in what came out."""
    refused: str | None = None
    """The sentence, where the case is refused."""


def count_not_finite(*tensors: Tensor) -> int:
    return sum(int((~torch.isfinite(values)).sum()) for values in tensors)


def gradients_of_determinant(determinant: float, count: int) -> Tensor:
    """(4 count, 3, 3) float32: even, along one axis, sheared and stretched at once, and with two axes gone but for the last."""
    side = math.copysign(abs(determinant) ** (1 / 3), determinant)
    diagonals = [[side, side, side], [1.0, 1.0, determinant], [30.0, 0.1, determinant / 3.0], [1e-3, 1.0, 1e3 * determinant]]
    return torch.cat(
        [_rotations(count, 0) @ torch.diag(torch.tensor(d, dtype=torch.float64)) @ _rotations(count, 1) for d in diagonals]
    ).float()


def surfel_rows(count: int) -> list[Row]:
    """Surfels pushed forward by F of every determinant: the smallest and largest that a length of 1 becomes, and the files' form of it."""
    rows = []
    for determinant in DETERMINANTS:
        gradient = gradients_of_determinant(determinant, count)
        tangents = 0.01 * torch.randn(len(gradient), 3, 2, generator=torch.Generator().manual_seed(2))
        normals = torch.nn.functional.normalize(torch.linalg.cross(tangents[..., 0], tangents[..., 1]), dim=-1)
        carried, turned = carry_tangents(tangents, gradient), carry_normals(normals, gradient)
        quaternions, scales = decompose_tangents(carried)
        ratio = torch.linalg.svdvals(carried.double()) / torch.linalg.svdvals(tangents.double())
        values = {
            "least_stretch": float(ratio.min()),
            "most_stretch": float(ratio.max()),
            "normal_length_error": float((turned.norm(dim=-1) - 1).abs().max()),
        }
        rows.append(Row(f"det F = {determinant:g}", values, count_not_finite(carried, turned, quaternions, scales)))
    return rows


def strained_rows(particles: int, seconds: float, determinants: Iterable[float] = DETERMINANTS, laws: Iterable[Law] = LAWS) -> list[Row]:
    """A cube of which one corner is let go with an elastic F of every determinant, in every law: how much of it must be stopped."""
    rows = []
    for law in laws:
        for determinant in determinants:
            model = falling_cube(particles, Material(law, yield_stress=1e3))
            state = rest_state(model, (0.0, 0.0, -1.0))
            corner = (model.rest - model.rest.amin(0)).amax(1) < 0.3 * (model.rest.amax(0) - model.rest.amin(0)).max()
            gradient, volume = state.elastic.clone(), state.plastic.clone()
            gradient[corner] = _shuffled(gradients_of_determinant(determinant, len(model.rest)))[: int(corner.sum())]
            if law == "fluid":
                volume[corner] = max(determinant, 0.05)
            rows.append(
                _fall(
                    f"{law}, det F = {determinant:g}",
                    model,
                    replace(state, elastic=gradient, total=gradient.clone(), plastic=volume),
                    seconds,
                )
            )
    return rows


def neighbourhood_rows() -> list[Row]:
    """Points carried by particles that lie in a plane, a line, a place, or nowhere near: the error of rigid motions, and of affine ones."""
    steps = SPACING * torch.arange(-4, 5)
    line = torch.stack([steps, 0.5 * steps, torch.zeros(9)], -1)
    generator = torch.Generator().manual_seed(3)
    shapes = {
        "full": torch.stack(torch.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3),
        "coplanar": torch.stack(torch.meshgrid(steps, steps, torch.zeros(1), indexing="ij"), -1).reshape(-1, 3),
        "coplanar but for 1e-6": torch.stack(torch.meshgrid(steps, steps, torch.zeros(1), indexing="ij"), -1).reshape(-1, 3)
        + 1e-6 * torch.randn(81, 3, generator=generator),
        "collinear": line,
        "pair": line[:2],
        "one": torch.zeros(1, 3),
        "twenty in one place": torch.zeros(20, 3),
        "isolated, 1e3 spacings away": line + 1e3 * SPACING,
    }
    points = torch.tensor([[0.1, 0.05, 0.0], [0.2, -0.1, 0.08], [-0.3, 0.2, -0.2], [0.0, 0.0, 0.0]])
    rows = []
    for name, particles in shapes.items():
        for offset in (0.0, 1e3):
            shift = torch.tensor([offset, -offset, offset]) * SPACING
            values, bad = {}, 0
            for kind in ("rigid", "affine"):
                matrix = _rotations(1, 4)[0] if kind == "rigid" else torch.eye(3, dtype=torch.float64) + 0.4 * _rotations(1, 5)[0]
                x, y = (particles + shift).double(), (points + shift).double()
                moved = ((x - shift) @ matrix.T + shift).float()
                weights = build_weights(x.float(), y.float())
                position, gradient = interpolate(weights, moved, matrix.float().expand(len(x), 3, 3).contiguous())
                truth = (y - shift) @ matrix.T + shift
                values[f"{kind}_error"] = float((position.double() - truth).norm(dim=-1).max() / SPACING)
                bad += count_not_finite(position, gradient)
            rows.append(Row(f"{name}, {offset:g} spacings off the origin", values, bad))
    return rows


def stiffness_rows(particles: int, seconds: float) -> list[Row]:
    return [
        _cube(f"E = 1e{n} Pa", particles, Material(young_modulus=10.0**n), seconds * min(1.0, 10 ** (3.5 - n / 2))) for n in range(2, 10)
    ]


def poisson_rows(particles: int, seconds: float) -> list[Row]:
    laws = [law for law in LAWS if law != "fluid"]
    rows = [
        _cube(f"nu = {nu}, {law}", particles, Material(law, poisson_ratio=nu, yield_stress=1e3), seconds)
        for nu in (0.0, 0.45, 0.49)
        for law in laws
    ]
    return [*rows, _refused("nu = 0.499", lambda: Material(poisson_ratio=0.499))]


def speed_rows(particles: int, seconds: float) -> list[Row]:
    return [_cube(f"{law}, 10 m/s", particles, Material(law, yield_stress=1e3), seconds, (0.0, 0.0, -10.0)) for law in LAWS]


def time_step_rows(particles: int, seconds: float) -> list[Row]:
    """Half the limit to twice it. The settings refuse more than 0.9; beyond, the model is told that waves are slower than they are.

    Stiff matter, whose waves and not its speed decide on the time step.
    """
    rows = []
    for share in (0.2, 0.4, 0.5, 0.8, 0.9, 1.0, 1.25, 1.5, 2.0):
        model = falling_cube(particles, Material(young_modulus=1e7))
        slower = replace(model, wave_speed=model.wave_speed * min(1.0, 0.9 / share))
        what = f"C = {share:g}" + ("" if share <= 0.9 else ", past the settings' limit")
        rows.append(
            _fall(what, slower, rest_state(model, (0.0, 0.0, -3.0)), seconds, MpmSettings(courant=min(share, 0.9), max_substeps=100_000))
        )
    return [*rows, _refused("C = 0.95", lambda: MpmSettings(courant=0.95))]


def count_rows(counts: Iterable[int], seconds: float) -> list[Row]:
    return [_cube(f"{count} particles asked for", count, Material(young_modulus=1e4), seconds) for count in counts]


def room_rows(particles: int, seconds: float) -> list[Row]:
    """Particles that would leave the room, and one that starts outside."""
    rows = [
        _cube("out of the room at 100 m/s", particles, Material(), seconds, (100.0, 60.0, 80.0)),
        _cube("out of the room at 1e4 m/s", particles, Material(), min(seconds, 0.01), (1e4, -1e4, 1e4)),
    ]
    model = falling_cube(particles, Material())
    scattered = rest_state(model, 300 * torch.randn(model.rest.shape, generator=torch.Generator().manual_seed(6)))
    rows.append(_fall("blown apart at 300 m/s", model, scattered, min(seconds, 0.03)))
    outside = model.rest.clone()
    outside[0, 0] = 50.0

    def build() -> Model:
        from drgs.deform.matter.mpm import make_model

        return make_model(outside, model.volumes, (Material(),), torch.zeros(len(outside), dtype=torch.int32), model.grid)

    long = falling_cube(4096, Material(young_modulus=1e9))
    return [
        *rows,
        _refused("one particle outside the room", build),
        _refused("E = 1e9 Pa, 4096 particles, 1/6 s in one call", lambda: advance(long, rest_state(long, (0.0, 0.0, -3.0)), 1 / 6)),
    ]


def handle_rows() -> list[Row]:
    """Targets that no shape can follow: the object stays finite, and what is held goes where it can."""
    bar = trimesh.creation.cylinder(radius=0.5, height=4.0, sections=24).subdivide().subdivide()
    vertices, faces = torch.tensor(bar.vertices, dtype=torch.float32), torch.tensor(bar.faces, dtype=torch.int32)
    ends = [torch.nonzero(side).flatten() for side in (vertices[:, 2] < -1.9, vertices[:, 2] > 1.9)]
    held = torch.cat(ends)
    grip = ArapHandles(vertices, faces, held, vertices)
    rest = vertices[held]
    top = torch.cat([torch.zeros(len(ends[0])), torch.ones(len(ends[1]))])[:, None]
    half_turn = torch.tensor([-1.0, -1.0, 1.0])
    cases = {
        "at rest": rest,
        "750 lengths away": rest + top * torch.tensor([3000.0, 0.0, 0.0]),
        "one end through the other": rest - top * torch.tensor([0.0, 0.0, 6.0]),
        "a half turn of one end": torch.where(top > 0, rest * half_turn, rest),
        "all in one place": torch.zeros_like(rest),
        "mirrored": rest * torch.tensor([-1.0, 1.0, 1.0]),
        "noise of a length": rest + 4 * torch.randn(rest.shape, generator=torch.Generator().manual_seed(7)),
    }
    rows = []
    for name, targets in cases.items():
        position, gradient = grip.drag(targets)
        missed = float((position[held] - targets).norm(dim=-1).mean())
        carried = carry_tangents(torch.eye(3)[:, :2].expand(len(gradient), 3, 2), gradient)
        values = {"missed": missed, "most_stretch": float(torch.linalg.svdvals(carried).max())}
        rows.append(Row(name, values, count_not_finite(position, gradient, carried)))
    return [*rows, _refused("1e6 lengths away", lambda: grip.drag(rest + 4e6 * top)), _refused("NaN", lambda: grip.drag(rest * math.nan))]


def mesh_rows() -> list[Row]:
    """Meshes moved so that faces vanish or fold: F of their vertices, and surfels on them."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    vertices, faces = torch.tensor(ball.vertices, dtype=torch.float32), torch.tensor(ball.faces, dtype=torch.int32)
    generator = torch.Generator().manual_seed(8)
    cases = {
        "flattened": vertices * torch.tensor([1.0, 1.0, 0.0]),
        "into a line": vertices * torch.tensor([1.0, 0.0, 0.0]),
        "into one place": vertices * 0.0,
        "turned inside out": -vertices,
        "shuffled": vertices[torch.randperm(len(vertices), generator=generator)],
        "1e6 times as large": vertices * 1e6,
        "1e-6 times as large": vertices * 1e-6,
    }
    rows = []
    for name, moved in cases.items():
        gradient = vertex_gradients(vertices, moved, faces)
        carried = carry_tangents(0.01 * torch.eye(3)[:, :2].expand(len(gradient), 3, 2), gradient)
        normals = carry_normals(vertices, gradient)
        stretch = torch.linalg.svdvals(carried.double()) / 0.01
        values = {"least_stretch": float(stretch.min()), "most_stretch": float(stretch.max())}
        rows.append(Row(name, values, count_not_finite(gradient, carried, normals)))
    return rows


def _cube(case: str, particles: int, material: Material, seconds: float, velocity: tuple = (0.0, 0.0, -3.0)) -> Row:
    model = falling_cube(particles, material)
    return _fall(case, model, rest_state(model, velocity), seconds)


def _fall(case: str, model: Model, state: State, seconds: float, settings: MpmSettings | None = None) -> Row:
    before = measure_balance(model, state).energy
    clock = time.perf_counter()
    try:
        after, report = advance(model, state, seconds, settings or MpmSettings(max_substeps=20_000))
    except ValueError as error:
        return Row(case, {"particles": len(model.rest)}, refused=str(error))
    clock = time.perf_counter() - clock
    low, high = (after.positions.new_tensor(corner) for corner in (model.grid.minimum, model.grid.maximum))
    cell = model.grid.dx
    values = {
        "particles": len(model.rest),
        "simulated_seconds": seconds,
        "substeps": report.substeps,
        "retries": report.retries,
        "frozen": report.frozen,
        "energy_left": measure_balance(model, after).energy / before,
        "fastest": float(after.velocities.norm(dim=-1).max()),
        "outside_the_room": int(((after.positions < low - cell) | (after.positions > high + cell)).any(1).sum()),
        "wall_seconds": clock,
    }
    return Row(case, values, count_not_finite(after.positions, after.velocities, after.total, after.elastic, after.stress))


def _refused(case: str, attempt: Callable[[], object]) -> Row:
    try:
        attempt()
    except ValueError as error:
        return Row(case, refused=str(error))
    return Row(case)


def _shuffled(values: Tensor) -> Tensor:
    return values[torch.randperm(len(values), generator=torch.Generator().manual_seed(9))]


def _rotations(count: int, seed: int) -> Tensor:
    q, r = torch.linalg.qr(torch.randn(count, 3, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64))
    q = q * torch.sign(torch.diagonal(r, dim1=-2, dim2=-1))[:, None]
    return q * torch.linalg.det(q)[:, None, None]
