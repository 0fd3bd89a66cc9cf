"""Render a scene from several cameras into a folder: <name>.png (RGBA, straight alpha, sRGB) and, if asked, <name>.exr with the maps."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from drgs.exchange.exr import encode_maps
from drgs.render.film.denoise.oidn import oidn_filter
from drgs.render.intersect.trace_rays import build_tracer
from drgs.render.records import Frame, RenderSettings
from drgs.render.render_frame import render_frame
from drgs.scene.camera import Camera
from drgs.scene.environment import turned_environment
from drgs.scene.posed_scene import PosedScene


def render_cameras(
    scene: PosedScene,
    cameras: Iterable[Camera],
    out: Path,
    settings: RenderSettings,
    aov: bool = False,
    done: Callable[[str], None] = lambda name: None,
    light_from_world: Callable[[Camera], Float[Tensor, "3 3"] | None] = lambda camera: None,
) -> list[dict]:
    """One picture a camera, named after it.

    Args:
        done: called with the name of each finished picture.
        light_from_world: of each camera, the rotation of directions in the world to those of the scene's environment; None: the same.

    Returns:
        For each camera its name and the frame's metadata (samples, seconds per step, what was skipped and why).

    Raises:
        ValueError: the denoiser oidn is asked for and not installed.
    """
    if settings.denoise == "oidn":
        oidn_filter()  # complain before the first ray
    out.mkdir(parents=True, exist_ok=True)
    device = scene.mesh.vertices.device
    tracer = build_tracer(scene.mesh)
    report = []
    for camera in cameras:
        turn = light_from_world(camera)
        lit = scene if turn is None else replace(scene, environment=turned_environment(scene.environment, turn))
        frame = render_frame(lit, camera.to(device), settings, tracer)
        write_png(frame, out / f"{camera.name}.png")
        if aov:
            (out / f"{camera.name}.exr").write_bytes(maps_of_frame(frame))
        report.append({"name": camera.name, **frame.metadata})
        done(camera.name)
    return report


def write_png(frame: Frame, path: Path) -> None:
    """8-bit RGBA, straight alpha, sRGB."""
    pixels = (frame.rgba_srgb.clamp(0, 1) * 255).round().to(torch.uint8)
    Image.fromarray(pixels.cpu().numpy()).save(path)


def maps_of_frame(frame: Frame) -> bytes:
    """The EXR of `drgs render --aov`."""
    maps = frame.gbuffer
    tensors = (
        frame.radiance_linear,
        maps.coverage,
        maps.albedo,
        maps.normal_world,
        maps.depth,
        maps.roughness,
        maps.metallic,
        frame.radiance.visibility,
    )
    return encode_maps(*(tensor.cpu().numpy() for tensor in tensors))
