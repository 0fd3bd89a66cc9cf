"""Time the material point method: a cube of 1 m falls onto a floor; one frame is 1/24 s.

    python -m benchmarks simulate [--particles 20000] [--law fixed_corotated] [--young 1e5] [--frames 6] [--json] [--sweep]

--sweep runs the same fall with time steps from half the default to twice it, and prints how much of the energy is left and how far the
particles end from where the smallest step leads. For extremes see `stability_deformation`.
"""

import argparse
import json
import statistics
import time

import torch

from drgs.deform.matter.mpm import (
    LAWS,
    Condition,
    GridSettings,
    Material,
    Model,
    MpmSettings,
    Plane,
    advance,
    make_model,
    measure_balance,
    rest_state,
)
from drgs.warp_torch import device_from_name, thread_count

FRAME = 1 / 24


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks simulate", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--particles", type=int, default=20_000)
    parser.add_argument("--law", choices=LAWS, default="fixed_corotated")
    parser.add_argument("--young", type=float, default=1e5, help="E [Pa]; the bulk modulus of a fluid")
    parser.add_argument("--frames", type=int, default=6)
    parser.add_argument("--device", default="cpu", choices=["auto", "cpu", "cuda"])
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--dx", type=float, help="Cell size [m]; by default eight particles a cell.")
    parser.add_argument("--sweep", action="store_true")
    given = parser.parse_args(arguments)
    if given.particles < 1 or given.frames < 1:
        raise ValueError(f"--particles and --frames are {given.particles} and {given.frames}; expected at least 1 of each")
    material = Material(given.law, young_modulus=given.young, bulk_modulus=given.young, yield_stress=1e3)
    model = falling_cube(given.particles, material, given.device, dx=given.dx)
    result = sweep(model) if given.sweep else measure(model, given.frames)
    print(json.dumps(result, indent=None if given.json else 1))


def falling_cube(particles: int, material: Material, device: str = "cpu", drop: float = 0.05, dx: float | None = None) -> Model:
    """A cube of 1 m, eight particles a cell, `drop` metres above the floor."""
    side = max(1, round(particles ** (1 / 3)))
    steps = (torch.arange(side) + 0.5) / side
    points = torch.stack(torch.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3) + torch.tensor([0, 0, drop])
    dx = dx or min(2 / side, 0.25)
    grid = GridSettings((-1, -1, -5 * dx), (2, 2, 3), dx)
    volumes = torch.full((len(points),), 1 / len(points))
    floor = Condition(Plane((0, 0, 0), (0, 0, 1)), friction=0.3)
    chosen = device_from_name(device)
    return make_model(
        points.to(chosen), volumes.to(chosen), (material,), torch.zeros(len(points), dtype=torch.int32), grid, (0, 0, -9.81), (floor,)
    )


def measure(model: Model, frames: int) -> dict:
    """Median wall time a frame, after one that compiles."""
    state = rest_state(model)
    advance(model, state, FRAME / 10)
    times, substeps, busy = [], 0, time.process_time()
    for _ in range(frames):
        start = time.perf_counter()
        state, report = advance(model, state, FRAME)
        state.positions.sum().item()  # waits for a GPU
        times.append(1e3 * (time.perf_counter() - start))
        substeps += report.substeps
    median, busy = statistics.median(times), time.process_time() - busy
    return {
        "particles": len(model.rest),
        "ms_per_frame": round(median, 3),
        "substeps_per_frame": round(substeps / frames, 1),
        "ns_per_particle_step": round(1e6 * sum(times) / substeps / len(model.rest), 1),
        "fastest_ms_per_frame": round(min(times), 3),
        "cpu_ms_per_frame": round(1e3 * busy / frames, 3),
        "threads": thread_count(),
        "device": str(model.rest.device),
    }


def sweep(model: Model, seconds: float = 0.25) -> dict:
    """Time steps at parts of the limit C = 1: where the particles end, against C = 0.1, and the energy left."""
    start = rest_state(model)
    energy = measure_balance(model, start).energy
    rows, truth = [], None
    for courant in (0.1, 0.2, 0.4, 0.6, 0.8, 0.9):
        clock = time.perf_counter()
        state, report = advance(model, start, seconds, MpmSettings(courant=courant))
        clock = time.perf_counter() - clock
        truth = state.positions if truth is None else truth
        rows.append(
            {
                "courant": courant,
                "substeps": report.substeps,
                "retries": report.retries,
                "seconds": round(clock, 3),
                "position_rms": float((state.positions - truth).square().sum(-1).mean().sqrt()),
                "energy_left": measure_balance(model, state).energy / energy,
            }
        )
    return {"particles": len(model.rest), "sweep": rows}


if __name__ == "__main__":
    import sys

    main(sys.argv[1:])
