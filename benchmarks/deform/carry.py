"""Time and error of what moves surfels: particles' motion interpolated, tangents pushed forward.

    python -m benchmarks carry [--surfels 100000] [--particles 20000] [--repeats 9] [--json] [--errors | --sweep]

`ms` is one frame with the weights built: positions and F of every surfel, then B' = F B. --errors prints tables instead: the
interpolation (ours, the paper's) on a bend, at a growing distance from the origin; the surfel rule (exact, the paper's Eq. 7) under
known gradients. --sweep prints the interpolation's error against its time: every variant with 8 to 32 neighbours, at half and full spacing.
"""

import argparse
import json
import math
import statistics
import time
from dataclasses import replace

import torch
from torch import Tensor

from drgs.deform.carry.carry_gaussians import carry_normals, carry_tangents
from drgs.deform.carry.gmls import GmlsSettings, build_weights, interpolate
from drgs.deform.displace.maps import evaluate_map
from drgs.scene.edits import BendMap
from drgs.warp_torch import device_from_name, thread_count

BEND = BendMap(type="bend", curvature=0.8)


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks carry", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--surfels", type=int, default=100_000)
    parser.add_argument("--particles", type=int, default=20_000)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--device", default="cpu", choices=["auto", "cpu", "cuda"])
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--errors", action="store_true")
    parser.add_argument("--sweep", action="store_true")
    given = parser.parse_args(arguments)
    if min(given.surfels, given.particles, given.repeats) < 1:
        raise ValueError("--surfels, --particles and --repeats are at least 1")
    if given.sweep:
        result = sweep(given.surfels, given.particles, given.repeats)
    else:
        result = errors() if given.errors else measure(given.surfels, given.particles, given.repeats, given.device)
    print(json.dumps(result, indent=None if given.json else 1))


def cloud(particles: int, surfels: int) -> tuple[Tensor, Tensor]:
    """Particles in a jittered lattice of a unit cube, surfels on a sphere inside it."""
    generator = torch.Generator().manual_seed(0)
    side = max(2, round(particles ** (1 / 3)))
    steps = (torch.arange(side) + 0.5) / side - 0.5
    lattice = torch.stack(torch.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3)
    lattice = lattice + 0.2 / side * (2 * torch.rand(lattice.shape, generator=generator) - 1)
    return lattice, 0.4 * torch.nn.functional.normalize(torch.randn(surfels, 3, generator=generator), dim=-1)


def measure(surfels: int, particles: int, repeats: int, device: str) -> dict:
    """Medians [ms] after one run that compiles."""
    chosen = device_from_name(device)
    rest, points = (values.to(chosen) for values in cloud(particles, surfels))
    moved, gradients = evaluate_map(BEND, rest)
    tangents = 0.01 * torch.randn(surfels, 3, 2, device=chosen)
    clock = time.perf_counter()
    weights = build_weights(rest, points)
    built = time.perf_counter() - clock
    gather, whole, busy = [], [], 0.0
    for repeat in range(repeats + 1):
        if repeat == 1:
            busy = time.process_time()
        start = time.perf_counter()
        position, gradient = interpolate(weights, moved, gradients)
        position.sum().item()
        middle = time.perf_counter()
        carry_tangents(tangents, gradient).sum().item()
        gather.append(1e3 * (middle - start))
        whole.append(1e3 * (time.perf_counter() - start))
    busy = time.process_time() - busy
    return {
        "surfels": surfels,
        "ms": round(statistics.median(whole[1:]), 3),
        "interpolation_ms": round(statistics.median(gather[1:]), 3),
        "fastest_ms": round(min(whole[1:]), 3),
        "cpu_ms": round(1e3 * busy / repeats, 3),
        "build_seconds": round(built, 3),
        "particles": len(rest),
        "threads": thread_count(),
        "device": str(chosen),
    }


def errors() -> dict:
    """Both tables."""
    return {"interpolation": interpolation_errors(), "surfels": surfel_errors()}


def interpolation_errors() -> list[dict]:
    """Largest position error on a bend, in particle spacings, with its cause kept at the object while the object lies off the origin."""
    rows = []
    for offset in (0.0, 1.0, 10.0, 100.0):
        rest, points = cloud(4096, 500)
        moved, gradients = evaluate_map(BEND, rest)
        truth, _ = evaluate_map(BEND, points)
        shift = torch.tensor([offset, -offset, offset])
        row = {"offset": offset}
        for variant in ("taylor", "paper_centred", "paper"):
            weights = build_weights(rest + shift, points + shift, GmlsSettings(variant=variant))
            found, _ = interpolate(weights, moved + shift, gradients)
            row[variant] = float((found - shift - truth).norm(dim=-1).max() * 16)
        rows.append(row)
    return rows


def sweep(surfels: int, particles: int, repeats: int) -> dict:
    """Error against time on a bend: position errors in spacings of the fewer particles, F errors as they are, medians of the times.

    The paper's are Algorithm 3 with linear and quadratic bases at the point, not at the origin as printed; ours see SWEPT.
    """
    rows, spacing = [], particles ** (-1 / 3)
    for count in (particles, 8 * particles):
        rest, points = cloud(count, surfels)
        moved, gradients = evaluate_map(BEND, rest)
        truth, truth_gradient = evaluate_map(BEND, points)
        for title, settings in SWEPT.items():
            for neighbours in (8, 12, 16, 24, 32):
                clock = time.perf_counter()
                told = torch.eye(3).expand_as(gradients).contiguous() if (settings.variant, settings.order) == ("taylor", 1) else gradients
                weights = build_weights(rest, points, replace(settings, neighbours=neighbours))
                built, times = time.perf_counter() - clock, []
                for _ in range(repeats + 1):
                    clock = time.perf_counter()
                    found, _ = interpolate(weights, moved, told)
                    times.append(1e3 * (time.perf_counter() - clock))
                gradient = interpolate(weights, moved, gradients)[1]
                distance = (found - truth).norm(dim=-1)
                rows.append(
                    {
                        "particles": len(rest),
                        "variant": title,
                        "neighbours": neighbours,
                        "position_rms": float(distance.square().mean().sqrt() / spacing),
                        "position_max": float(distance.max() / spacing),
                        "gradient_rms": float((gradient - truth_gradient).square().sum((1, 2)).mean().sqrt()),
                        "build_seconds": round(built, 3),
                        "ms": round(statistics.median(times[1:]), 3),
                    }
                )
    return {"surfels": surfels, "threads": thread_count(), "sweep": rows}


SWEPT = {
    "paper, p = 1": GmlsSettings(variant="paper_centred", order=1),
    "paper, p = 2": GmlsSettings(variant="paper_centred", order=2),
    "ours, p = 1": GmlsSettings(variant="taylor", order=1),
    "ours, p = 2": GmlsSettings(variant="taylor", order=2),
}
"""ours: weights that reproduce affine maps; p = 1 with the positions alone, p = 2 as in use, where F of the particles corrects them."""


def surfel_errors() -> list[dict]:
    """Relative covariance error, normal error [degrees] and ratio of areas of the paper's Eq. 7, for scales (1, 0.5), n = z."""
    tangents = torch.tensor([[[1.0, 0.0], [0.0, 0.5], [0.0, 0.0]]], dtype=torch.float64)
    normal = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    cases = {
        "uniform 1.5": torch.diag(torch.tensor([1.5, 1.5, 1.5])),
        "x2 along t_u": torch.diag(torch.tensor([2.0, 1.0, 1.0])),
        "x2 along n": torch.diag(torch.tensor([1.0, 1.0, 2.0])),
        "shear x += 0.5 z": torch.tensor([[1.0, 0, 0.5], [0, 1, 0], [0, 0, 1]]),
        "shear x += 1.0 z": torch.tensor([[1.0, 0, 1.0], [0, 1, 0], [0, 0, 1]]),
        "in-plane shear 0.5": torch.tensor([[1.0, 0.5, 0], [0, 1, 0], [0, 0, 1]]),
    }
    rows = []
    for name, matrix in cases.items():
        gradient = matrix.double()[None]
        exact = carry_tangents(tangents, gradient)
        row: dict[str, str | float] = {"gradient": name}
        for order in ("ascending", "descending"):
            paper = carry_tangents(tangents, gradient, variant="paper", order=order)
            covariance, other = exact @ exact.mT, paper @ paper.mT
            row[f"covariance_{order}"] = float((covariance - other).norm() / covariance.norm())
            row[f"area_{order}"] = float(_area(paper) / _area(exact))
        turned = torch.nn.functional.normalize(torch.linalg.cross(paper[..., 0], paper[..., 1]), dim=-1)
        cosine = (carry_normals(normal, gradient) * turned).sum().clamp(-1, 1)
        row["normal_degrees"] = math.degrees(math.acos(float(cosine)))
        rows.append(row)
    return rows


def _area(tangents: Tensor) -> Tensor:
    return torch.linalg.cross(tangents[..., 0], tangents[..., 1]).norm()


if __name__ == "__main__":
    import sys

    main(sys.argv[1:])
