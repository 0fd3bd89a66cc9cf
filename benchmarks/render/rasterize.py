"""Time the rasteriser forward and backward on one fixed workload: projection, binning, blending, gradients of every input.

    python -m benchmarks rasterize --scene FILE.npz [--json] [--dump image.npy] [--repeats N] [--device cpu] [--depth]

FILE.npz holds centers (N, 3), tangents_u and tangents_v (N, 3, unit), scales (N, 2), opacities (N), features (N, C), K, camera_from_world
(OpenCV) and size (width, height). --dump writes the blended features, (height, width, C) float32, not divided by coverage.
"""

import argparse
import json
import statistics
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from drgs.render.visible.rasterize import PUBLISHED_FILTER_SIGMA, RasterSettings, rasterize
from drgs.scene.camera import Camera
from drgs.warp_torch import device_from_name, thread_count

MIN_REPEATS = 7


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks rasterize", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scene", type=Path, required=True)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--dump", type=Path)
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--device", default="cpu", choices=["auto", "cpu", "cuda"])
    parser.add_argument("--check", action="store_true", help="compare the image with the float64 twin (some minutes)")
    parser.add_argument("--depth", action="store_true", help="blend the depth as well")
    given = parser.parse_args(arguments)
    if given.repeats < MIN_REPEATS:
        raise ValueError(f"--repeats is {given.repeats}; a median of fewer than {MIN_REPEATS} means little")
    camera, surfels = load_workload(given.scene, device_from_name(given.device))
    settings = RasterSettings(depth=given.depth, filter_sigma=PUBLISHED_FILTER_SIGMA)
    if given.dump:
        with torch.no_grad():
            np.save(given.dump, rasterize(*surfels, camera, settings).features.permute(1, 2, 0).contiguous().cpu().numpy())
    result = measure(camera, surfels, settings, given.repeats)
    if given.check:
        result |= difference_from_twin(camera, surfels)
    print(json.dumps(result, indent=None if given.json else 1))


class Workload(NamedTuple):
    """What is blended, as leaves that want gradients."""

    centers: Tensor
    tangents: Tensor
    opacities: Tensor
    features: Tensor


def load_workload(path: Path, device: torch.device) -> tuple[Camera, Workload]:
    """A stored scene."""
    with np.load(path, allow_pickle=False) as stored:
        arrays = {name: torch.from_numpy(stored[name]) for name in stored.files}
    width, height = (int(x) for x in arrays["size"])
    camera = Camera(arrays["camera_from_world"].float(), arrays["K"].float(), width, height).to(device)
    tangents = torch.stack([arrays["tangents_u"], arrays["tangents_v"]], -1) * arrays["scales"][:, None, :]

    def leaf(values: Tensor) -> Tensor:
        return values.float().to(device).contiguous().requires_grad_()

    return camera, Workload(leaf(arrays["centers"]), leaf(tangents), leaf(arrays["opacities"]), leaf(arrays["features"]))


def difference_from_twin(camera: Camera, surfels: Workload, tile: int = 20) -> dict:
    """Largest and mean absolute difference of the image from drgs/reference, tile by tile, each with the surfels whose sphere it may see."""
    from drgs.reference.rasterize_gbuffer import rasterize as rasterize_reference

    with torch.no_grad():
        image = rasterize(*surfels, camera, RasterSettings(depth=False, filter_sigma=PUBLISHED_FILTER_SIGMA)).features.double().cpu()
        centers, tangents, opacities, features = (tensor.detach().double().cpu() for tensor in surfels)
        camera = camera.to("cpu")
        inside = centers @ camera.camera_from_world[:3, :3].double().T + camera.camera_from_world[:3, 3].double()
        pixel = inside @ camera.intrinsics.double().T
        pixel = pixel[:, :2] / pixel[:, 2:]
        reach = 3.4 * tangents.norm(dim=1).amax(1)  # beyond it alpha < 1/255 whatever the opacity
        nearest = inside[:, 2] - reach
        margin = 2 * reach * float(camera.intrinsics[0, 0]) / nearest.clamp(min=1e-3) + 4
        margin = torch.where(nearest > 1e-3, margin, torch.full_like(margin, torch.inf))
        worst, total = 0.0, 0.0
        for top in range(0, camera.height, tile):
            for left in range(0, camera.width, tile):
                seen = (pixel[:, 0] > left - margin) & (pixel[:, 0] < left + tile + margin)
                seen &= (pixel[:, 1] > top - margin) & (pixel[:, 1] < top + tile + margin)
                shifted = camera.intrinsics.double().clone()
                shifted[0, 2] -= left
                shifted[1, 2] -= top
                width, height = min(tile, camera.width - left), min(tile, camera.height - top)
                window = Camera(camera.camera_from_world, shifted.float(), width, height)
                chosen = Workload(centers[seen], tangents[seen], opacities[seen], features[seen])
                truth = rasterize_reference(
                    *chosen, window, RasterSettings(depth=False, filter_sigma=PUBLISHED_FILTER_SIGMA), depth_origin=0.0
                ).features
                difference = (image[:, top : top + height, left : left + width] - truth).abs()
                worst, total = max(worst, float(difference.max())), total + float(difference.sum())
    return {"twin_max_difference": worst, "twin_mean_difference": total / image.numel()}


def measure(camera: Camera, surfels: Workload, settings: RasterSettings, repeats: int) -> dict:
    """Medians [ms] over the repeats, after two that compile and warm up."""
    device = surfels.centers.device
    generator = torch.Generator().manual_seed(0)
    image_gradient = torch.randn(surfels.features.shape[1], camera.height, camera.width, generator=generator).to(device)
    depth_gradient = torch.randn(camera.height, camera.width, generator=generator).to(device)

    def clock() -> float:
        if device.type != "cpu":
            torch.cuda.synchronize(device)
        return 1e3 * time.perf_counter()

    times: list[tuple[float, float]] = []
    for _ in range(repeats + 2):
        for tensor in surfels:
            tensor.grad = None
        start = clock()
        maps = rasterize(*surfels, camera, settings)
        middle = clock()
        if maps.depth_sum is None:
            maps.features.backward(image_gradient)
        else:
            torch.autograd.backward([maps.features, maps.depth_sum], [image_gradient, depth_gradient])
        times.append((middle - start, clock() - middle))
    times = times[2:]
    return {
        "forward_ms": round(statistics.median(forward for forward, _ in times), 3),
        "backward_ms": round(statistics.median(backward for _, backward in times), 3),
        "forward_backward_ms": round(statistics.median(forward + backward for forward, backward in times), 3),
        "threads": thread_count(),
        "repeats": repeats,
        "fastest_forward_backward_ms": round(min(forward + backward for forward, backward in times), 3),
        "surfels": len(surfels.centers),
        "channels": surfels.features.shape[1],
        "size": [camera.width, camera.height],
        "device": str(device),
    }
