"""A build, pictures, edits, matter and what a server shows on a device that is pretended (pretended_cuda.py); ends with 0 if all went through.

    python -m tests.run_on_pretended_cuda FOLDER

In: an empty folder. Out: an asset in it, and of each part what it launched how often, as JSON.
"""

import json
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import torch
import warp as wp

from benchmarks.deform.carry import main as carry
from benchmarks.deform.simulate import main as simulate
from benchmarks.render.frame import moving, orbit
from drgs.deform.pose_scene import pose_scene
from drgs.reconstruct.build_asset import BuildSettings, build_asset
from drgs.reconstruct.presets import PRESETS
from drgs.render.film.resolve_frame import resolve_frame
from drgs.render.progressive.refine import refine_frame
from drgs.render.progressive.start_frame import start_frame
from drgs.render.records import Frame, RenderSettings
from drgs.scene.asset import load_asset, save_asset
from drgs.scene.edits import parse_edits
from drgs_server.live.messages import CameraMessage, Channel, Settings
from drgs_server.render.drgs_renderer import DrgsRenderer
from tests import pretended_cuda
from tests.reconstruct.test_build_asset import TINY
from tests.reconstruct.tiny_capture import FEW_VIEWS, sphere_views, write_nerf_synthetic

SIDE, MOST_DIFFERENCE = 48, 1e-6
"""Of the pictures [pixels]; and between those of the two devices [linear radiance], whose rays are the same but for rounding."""
EDITS: list[dict[str, Any]] = [
    {"op": "material", "select": {"all": True}, "set": {"roughness": 0.3}},
    {"op": "deform", "map": {"type": "twist", "rate": 0.5}},
    {
        "op": "deform",
        "handles": {
            "drag": [{"point": [0.1, -0.15, 0.7], "radius": 0.2, "target": [0.1, -0.15, 0.8]}],
            "pin": [{"point": [0.1, -0.15, -0.3]}],
        },
    },
]


def check_that_mixing_is_refused() -> None:
    """By what stands for a GPU: it would pass everything otherwise."""
    there, here = torch.ones(3, device="cuda"), torch.ones(3)
    for mixed in (lambda: there + here, lambda: here[there.long()], lambda: there.numpy(), lambda: torch.stack([here, there])):
        try:
            mixed()
        except (RuntimeError, TypeError):
            continue
        raise AssertionError("a tensor of the CPU passed for one of the pretended device")


def picture(folder: Path, device: torch.device) -> Frame:
    """Of the asset with the edits."""
    asset = load_asset(folder, device)
    settings = RenderSettings(primary="mesh")
    return resolve_frame(refine_frame(start_frame(pose_scene(asset, parse_edits(EDITS)), next(orbit(asset, SIDE)), settings), 2))


def show_as_a_server(folder: Path) -> None:
    """Every channel of the edited asset, a pick, a still, and all channels as layers of one file."""
    upright = ((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, -1.0, -4.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    camera = CameraMessage(type="camera", world_from_camera=upright, fov_y_degrees=40, width=SIDE, height=SIDE)
    pose = DrgsRenderer("cuda").load(folder, folder).pose(parse_edits(EDITS), None)
    seen = None
    for channel in get_args(Channel):
        seen = pose.begin(camera, Settings(channel=channel, spp_target=4), SIDE, SIDE, seen)
        seen.refine()
        assert seen.resolve().shape == (SIDE, SIDE, 4)
        if channel == "final" and seen.pick(0.5, 0.5) is None:
            raise AssertionError("nothing was picked in the middle of the picture")
    graded = Settings(spp_target=4, background="blurred", tone_curve="agx", exposure_stops=1)
    for work in (pose.still(camera, graded, SIDE, SIDE, linear=False), pose.layers(camera, Settings(spp_target=4), SIDE, SIDE)):
        while work.work():
            pass
        work.picture()


def main(folder: Path) -> None:
    pretended_cuda.enter()
    check_that_mixing_is_refused()
    launched: Counter[str] = Counter()
    launch = wp.launch

    def count_launches(kernel: Any, *args: Any, device: Any = None, **kwargs: Any) -> Any:
        launched[kernel.key] += str(device).startswith("cuda")
        return launch(kernel, *args, device=device, **kwargs)

    wp.launch = count_launches
    PRESETS["tiny"] = replace(TINY, surface=replace(TINY.surface, cameras_after=(1,)))
    capture = write_nerf_synthetic(folder / "capture", sphere_views(FEW_VIEWS, square=True))
    build_asset(capture, folder / "asset", BuildSettings(preset="tiny", device="cuda", light="object"))
    asset = load_asset(folder / "asset", pretended_cuda.CUDA)
    moving(asset, SIDE, 8, 3, None)
    moving(asset, SIDE, 8, 1, "gaussians")
    show_as_a_server(folder / "asset")
    save_asset(replace(asset, light_frame="camera"), folder / "turned")
    DrgsRenderer("cuda").load(folder / "turned", folder / "turned")
    simulate(["--particles", "64", "--frames", "1", "--device", "cuda", "--json"])
    carry(["--surfels", "200", "--particles", "64", "--repeats", "1", "--device", "cuda", "--json"])
    there, here = picture(folder / "asset", pretended_cuda.CUDA), picture(folder / "asset", pretended_cuda.CPU)
    difference = float((there.radiance_linear.cpu() - here.radiance_linear).abs().mean())
    if not difference <= MOST_DIFFERENCE:
        raise AssertionError(f"pictures of the two devices differ by {difference}, {MOST_DIFFERENCE} at most were expected")
    print(json.dumps({"difference": difference, "launched": launched}))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
