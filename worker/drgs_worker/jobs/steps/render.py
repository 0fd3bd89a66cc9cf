"""Batch renders: an asset under every variant of edits and every environment, from every camera, to pictures and MP4.

One durable step a variant and environment; inside a step every finished picture counts, so a crash costs one of them at most.
torch is imported inside functions: the API process lists jobs without it.
"""

import math
import os
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import simplejpeg

from drgs.reconstruct.progress import Progress
from drgs.scene.edits import EnvironmentEdit, PoseEdit
from drgs_worker.jobs.camera_path import path_views
from drgs_worker.jobs.progress import JobStopped
from drgs_worker.jobs.requests import FILM_FPS, OWN_LIGHT, RenderRequest, RenderVariant
from drgs_worker.jobs.start_view import FOV_Y_DEGREES, start_view, turntable_view
from drgs_worker.jobs.steps.job_run import AbstractJobRun, JobContext
from drgs_worker.jobs.write_video import over_grey, write_video

if TYPE_CHECKING:
    from drgs.render.intersect.tracer import AbstractTracer
    from drgs.scene.asset import Asset
    from drgs.scene.camera import Camera
    from drgs.scene.posed_scene import PosedScene

SLICE_SECONDS = 0.4
"""Of rendering between two looks at the cancel flag."""
PREVIEW_SIDE = 256


class RenderRun(AbstractJobRun):
    """Final."""

    def __init__(self, job: JobContext) -> None:
        self._job = job
        self._asked = RenderRequest.model_validate(job.parameters)
        variants = self._asked.variants or [RenderVariant(name="asset")]
        self._pairs = {
            f"render {variant.name} {environment}": (variant, environment)
            for variant in variants
            for environment in self._asked.environments or [""]
        }
        self.steps = tuple(self._pairs)
        self._asset: Asset | None = None
        self._started = time.monotonic()
        self._made = 0

    def run(self, step: str) -> None:
        variant, environment = self._pairs[step]
        self._job.files.mkdir(exist_ok=True)
        done_before = list(self._pairs).index(step)
        cameras = self._cameras()
        paths = [self._path(variant, environment, camera.name) for camera in cameras]
        renderer = _Renderer(self._job, self._asked, self._open(), variant, environment)
        for index, (camera, path) in enumerate(zip(cameras, paths, strict=True)):
            picture = None if path.exists() else renderer.picture(index, camera, path)
            self._made += picture is not None
            self._report(done_before * len(cameras) + index + 1, len(self._pairs) * len(cameras), path.name, picture)
        if self._asked.video_fps is not None:
            video = self._path(variant, environment, "").with_suffix(".mp4")
            write_video(paths, video, self._asked.video_fps, self._job.should_stop)

    def _open(self) -> "Asset":
        if self._asset is None:
            from drgs.scene.asset import load_asset
            from drgs.warp_torch import device_from_name

            self._asset = load_asset(self._job.fetch_asset(self._asked.asset), device_from_name(self._job.device))
        return self._asset

    def _path(self, variant: RenderVariant, environment: str, camera: str) -> Path:
        parts = [variant.name, environment.removesuffix(".exr") or "light", *([camera] if camera else [])]
        return self._job.files / ("-".join(parts) + ".png")

    def _cameras(self) -> "list[Camera]":
        import torch

        from drgs.scene.camera import camera_from_opengl

        asked, mesh = self._asked, self._open().mesh
        low, high = mesh.vertices.amin(0).tolist(), mesh.vertices.amax(0).tolist()
        if asked.turntable is not None:
            table = asked.turntable
            turned = [
                (f"{k:04d}", turntable_view(low, high, 360 * table.turns * k / table.frames, table.elevation_degrees), FOV_Y_DEGREES)
                for k in range(table.frames)
            ]
        elif asked.path is not None:
            views = path_views(asked.path, asked.video_fps or FILM_FPS)
            turned = [(f"{k:04d}", matrix, fov) for k, (matrix, fov) in enumerate(views)]
        elif asked.cameras:
            turned = [(camera.name, np.array(camera.world_from_camera), camera.fov_y_degrees) for camera in asked.cameras]
        else:
            turned = [("start", start_view(low, high), FOV_Y_DEGREES)]
        cameras = []
        for name, matrix, fov in turned:
            focal = asked.height / 2 / math.tan(math.radians(fov) / 2)
            intrinsics = torch.tensor([[focal, 0, asked.width / 2], [0, focal, asked.height / 2], [0, 0, 1]])
            cameras.append(camera_from_opengl(torch.from_numpy(matrix), intrinsics, asked.width, asked.height, name))
        return cameras

    def _report(self, done: int, total: int, name: str, picture: np.ndarray | None) -> None:
        left = None
        if self._made:
            left = (time.monotonic() - self._started) / self._made * (total - done)
        preview = None
        if picture is not None:
            step = max(1, math.ceil(max(picture.shape[:2]) / PREVIEW_SIDE))
            preview = simplejpeg.encode_jpeg(np.ascontiguousarray(over_grey(picture[::step, ::step])), quality=85, colorspace="RGB")
        self._job.progress(Progress("render", done, total, done / total, None, name, left, preview))


class _Renderer:
    """One variant under one environment."""

    def __init__(self, job: JobContext, asked: RenderRequest, asset: "Asset", variant: RenderVariant, environment: str) -> None:
        self._job, self._asked, self._asset = job, asked, asset
        self._edits = list(variant.edits)
        if environment == OWN_LIGHT:
            self._edits = [edit for edit in self._edits if not isinstance(edit, EnvironmentEdit)]
        elif environment:
            self._edits.append(EnvironmentEdit(op="environment", file=environment))
        self._still: tuple[PosedScene, AbstractTracer] | None = None

    def picture(self, index: int, camera: "Camera", path: Path) -> np.ndarray:
        """Render and write it. Returns (height, width, 4) uint8, sRGB, straight alpha."""
        import torch
        from PIL import Image

        from drgs.render.film.resolve_frame import resolve_frame
        from drgs.render.progressive.frame_state import passes_needed
        from drgs.render.progressive.refine import refine_frame
        from drgs.render.progressive.start_frame import start_frame
        from drgs.render.records import RenderSettings

        asked = self._asked
        scene, tracer = self._scene(index)
        settings = RenderSettings(
            samples_per_pixel=asked.spp,
            bounces=asked.bounces,
            exposure=asked.exposure_stops,
            denoise="svgf" if asked.denoise else "none",
            tone_curve=asked.tone_curve,
            background=asked.background,
        )
        state = start_frame(scene, camera.to(scene.mesh.vertices.device), settings, tracer)
        left, passes = passes_needed(state), 1
        while left > 0:
            if self._job.should_stop():
                raise JobStopped
            passes = min(passes, left)
            start = time.monotonic()
            state = refine_frame(state, passes)
            left -= passes
            passes = max(1, min(4 * passes, int(SLICE_SECONDS / max((time.monotonic() - start) / passes, 1e-4))))
        pixels = (resolve_frame(state).rgba_srgb.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
        draft = path.with_suffix(".part")
        with draft.open("wb") as file:
            Image.fromarray(pixels).save(file, format="PNG")
        os.replace(draft, path)
        return pixels

    def _scene(self, index: int) -> "tuple[PosedScene, AbstractTracer]":
        from drgs.deform.pose_scene import pose_scene
        from drgs.render.intersect.trace_rays import build_tracer

        if self._still is not None:
            return self._still
        edits, clip = list(self._edits), self._asked.clip
        if clip is not None:
            edits.append(PoseEdit(op="pose", clip=clip, time=index / (self._asked.video_fps or FILM_FPS)))
        self._job.fetch_edit_files(edits)
        scene = pose_scene(self._asset, edits, self._job.directory.environments, confine=True)
        made = scene, build_tracer(scene.mesh)
        if clip is None:
            self._still = made
        return made
