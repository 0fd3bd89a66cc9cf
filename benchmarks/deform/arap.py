"""Time a dragged handle: an object held at one end, its other end drawn along a path, everything else following.

    python -m benchmarks arap [--faces 20000] [--surfels 40000] [--updates 20] [--asset ASSET] [--json]

updates_per_second counts the drag with the carrying of all vertices and surfels (no rendering), the median of the updates; each brings
targets not seen before. `faces` is what the control mesh has. unconverged: mean and largest distance, in sizes of the object, between the
last pose found so and the same with ten times the iterations.
"""

import argparse
import json
import math
import statistics
import time
from pathlib import Path

import numpy as np
import torch
import trimesh
from torch import Tensor

from drgs.deform.displace.arap import ArapHandles, ArapSettings
from drgs.warp_torch import thread_count


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks arap", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--faces", type=int, default=20_000, help="of the control mesh")
    parser.add_argument("--surfels", type=int, default=40_000, help="carried along, besides the object's own vertices")
    parser.add_argument("--updates", type=int, default=20)
    parser.add_argument("--asset", type=Path, help="a built asset instead of the bumpy ball; its surfels are carried")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args(arguments)
    if min(given.faces, given.updates) < 1 or given.surfels < 0:
        raise ValueError("--faces and --updates are at least 1, --surfels at least 0")
    result = measure(*_object(given.asset, given.faces, given.surfels), ArapSettings(control_faces=given.faces), given.updates)
    print(json.dumps(result, indent=None if given.json else 1))


def measure(vertices: Tensor, faces: Tensor, points: Tensor, settings: ArapSettings, updates: int) -> dict:
    """A drag of the upper end around a quarter circle, the lower one pinned."""
    height = vertices[:, 2]
    low, high = float(height.min()), float(height.max())
    top, bottom = (torch.nonzero(side).flatten() for side in (height > high - 0.1 * (high - low), height < low + 0.1 * (high - low)))
    handles = torch.cat([top, bottom])
    clock = time.perf_counter()
    grip = ArapHandles(vertices, faces, handles, points, settings)
    prepare = time.perf_counter() - clock
    size = float((vertices.amax(0) - vertices.amin(0)).max())

    def targets(share: float) -> Tensor:
        angle = share * math.pi / 2
        moved = vertices[handles].clone()
        moved[: len(top)] += 0.4 * size * torch.tensor([math.sin(angle), 0.0, math.cos(angle) - 1])
        return moved

    grip.drag(targets(0.01))  # compiles
    times, busy = [], time.process_time()
    for update in range(updates):
        start = time.perf_counter()
        position, _ = grip.drag(targets((update + 1) / updates))
        times.append(time.perf_counter() - start)
    busy = time.process_time() - busy
    patient = ArapHandles(
        vertices, faces, handles, points,
        ArapSettings(settings.control_faces, settings.coarse_faces, settings.steps, 10 * settings.coarse_iterations, 10 * settings.iterations),
    )  # fmt: skip
    converged, _ = patient.drag(targets(1.0))
    distance = (converged - position).norm(dim=-1)
    return {
        "faces": grip.control_faces,
        "updates_per_second": round(1 / statistics.median(times), 2),
        "slowest_ms": round(1e3 * max(times), 1),
        "fastest_ms": round(1e3 * min(times), 1),
        "cpu_ms": round(1e3 * busy / updates, 1),
        "prepare_seconds": round(prepare, 2),
        "points": len(points),
        "handles": len(handles),
        "unconverged": [round(float(part) / size, 4) for part in (distance.mean(), distance.max())],
        "threads": thread_count(),
    }


def _object(asset: Path | None, faces: int, surfels: int) -> tuple[Tensor, Tensor, Tensor]:
    """Vertices, faces, and the points to carry: all vertices, then surfels."""
    if asset is not None:
        from drgs.scene.asset import load_asset

        loaded = load_asset(asset)
        vertices = loaded.mesh.vertices
        return vertices, loaded.mesh.faces, vertices if loaded.gaussians is None else torch.cat([vertices, loaded.gaussians.centers])
    level = max(2, math.ceil(math.log(faces / 20, 4)))
    ball = trimesh.creation.icosphere(subdivisions=level)
    bumps = 1 + 0.15 * np.sin(5 * ball.vertices).prod(1, keepdims=True)
    vertices = torch.tensor(ball.vertices * bumps * [0.5, 0.5, 1.0], dtype=torch.float32)
    triangles = torch.tensor(ball.faces, dtype=torch.int32)
    chosen = torch.randint(len(triangles), (surfels,), generator=torch.Generator().manual_seed(0))
    return vertices, triangles, torch.cat([vertices, vertices[triangles[chosen].long()].mean(1)])
