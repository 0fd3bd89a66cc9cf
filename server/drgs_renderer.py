"""The renderer of the service: drgs' own progressive frames, with everything kept that a change leaves as it was.

What an edit makes old is drgs/render/invalidate.py's table; frames are handed on from picture to picture, so that a new environment keeps
what the camera sees, a new exposure all samples, and a moving camera what its last picture showed of the same places.

Imported only on the render thread, and torch only inside functions: the API process must start fast.
"""

import copy
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from drgs.scene.edits import Edit
from server.channels import channel_pixels
from server.indirect_picture import IndirectPicture
from server.messages import CameraMessage, Settings
from server.render_session import (
    AbstractLoadedAsset,
    AbstractPicture,
    AbstractPose,
    AbstractRenderer,
    Bounds,
    Explanation,
    LinearPixels,
    Picked,
    Pixels,
    view_of_bounds,
)
from server.surfel_picture import SurfelPicture

if TYPE_CHECKING:
    from torch import Tensor

    from drgs.render.accumulate import FrameState
    from drgs.render.records import Frame
    from drgs.render.tracer import AbstractTracer
    from drgs.scene.asset import Asset
    from drgs.scene.environment import Environment
    from drgs.scene.posed_scene import PosedScene

SAMPLES_PER_PASS = 4
"""Rays a pixel of the first, quick picture: two cosine, one GGX, one towards the environment."""
REFINE_SECONDS = 0.03
"""A refinement lasts about this long, so that a new input need not wait; never less than one pass."""
CHANNEL_SAMPLES = 32
"""Behind a picture of albedo, normals ...: passes are its antialiasing."""
_MAPS = {"normal": "normal_world"}
"""Names that the G-buffer has for channels, where they differ."""


LIGHT_CHANNELS = ("final", "visibility", "variance")
"""Channels of Picture that are summed over rays; the others are known once the surface is."""


class DrgsRenderer(AbstractRenderer):
    """Final."""

    def __init__(self, device: str = "auto") -> None:
        self._device = device

    def load(self, folder: Path, environments: Path) -> "LoadedAsset":
        from drgs.scene.asset import load_asset
        from drgs.warp_torch import device_from_name

        return LoadedAsset(load_asset(folder, device_from_name(self._device)), environments)

    def prepare(self) -> None:
        from drgs.deform import pose_scene  # noqa: F401
        from drgs.render import accumulate, trace_rays  # noqa: F401
        from drgs.scene import asset  # noqa: F401


class LoadedAsset(AbstractLoadedAsset):
    """Final."""

    def __init__(self, asset: "Asset", environments: Path) -> None:
        self.asset = asset
        self._environments = environments
        self._light: dict[str, tuple[int, Environment]] = {}
        low, high = asset.mesh.vertices.amin(0).tolist(), asset.mesh.vertices.amax(0).tolist()
        self.bounds = Bounds(tuple(low), tuple(high))
        self.start_view = view_of_bounds(self.bounds)

    def pose(self, edits: Sequence[Edit], previous: AbstractPose | None) -> "Pose":
        from drgs.deform.pose_scene import pose_scene

        scene = pose_scene(self.asset, edits, self._environments, environments=self._environment, confine=True)
        return Pose(self.asset, scene, self._tracer(scene, previous))

    def _tracer(self, scene: "PosedScene", previous: AbstractPose | None) -> "AbstractTracer":
        from drgs.render.trace_rays import build_tracer

        if not isinstance(previous, Pose) or previous.scene.mesh.vertices is not scene.mesh.vertices:
            return build_tracer(scene.mesh)
        if previous.scene.mesh is scene.mesh:
            return previous.tracer
        tracer = copy.copy(previous.tracer)  # shares the tree; hits look materials up in `mesh`
        tracer.mesh = scene.mesh
        return tracer

    def _environment(self, name: str) -> "Environment":
        """A stored environment, read once for each version of its file."""
        import torch

        from drgs.exchange.exr import decode_environment
        from drgs.scene.environment import Environment

        path = self._environments / name
        try:
            stamp = path.stat().st_mtime_ns
        except FileNotFoundError as error:
            raise ValueError(f"The environment {name} is no longer stored here.") from error
        known = self._light.get(name)
        if known is None or known[0] != stamp:
            radiance = torch.from_numpy(np.ascontiguousarray(decode_environment(path.read_bytes(), name)))
            self._light[name] = known = (stamp, Environment(radiance.to(self.asset.mesh.vertices.device)))
        return known[1]


@dataclass(frozen=True, eq=False)
class Pose(AbstractPose):
    """Final."""

    asset: "Asset"
    scene: "PosedScene"
    tracer: "AbstractTracer"

    def vertex_at(self, position_world: "Tensor") -> int:
        """Selections refer to the object at rest, whose vertices have the numbers of the moved ones."""
        return int((self.scene.mesh.vertices - position_world).square().sum(-1).argmin())

    def region_of(self, vertex: int) -> int:
        return int(self._regions[vertex])

    def _begin_indirect(
        self, camera: CameraMessage, settings: Settings, width: int, height: int, previous: AbstractPicture | None
    ) -> IndirectPicture:
        light = settings.model_copy(update={"channel": "final", "denoise": False, "background": "transparent"})
        before = (previous.whole, previous.direct) if isinstance(previous, IndirectPicture) else (previous, None)
        bounces = (max(1, settings.bounces), 0)  # with none there would be nothing to see
        pictures = [
            self.begin(camera, light.model_copy(update={"bounces": count}), width, height, known)
            for count, known in zip(bounces, before, strict=True)
        ]
        whole, direct = (picture for picture in pictures if isinstance(picture, Picture))
        return IndirectPicture(whole, direct, settings)

    @cached_property
    def _under_white_sky(self) -> "PosedScene":
        """Where every direction is asked about: under the true sky rays towards black texels are not."""
        import torch

        from drgs.scene.environment import Environment

        white = Environment(torch.ones(8, 16, 3, device=self.scene.mesh.vertices.device))
        return replace(self.scene, environment=white, environment_rotation_degrees=0.0, environment_intensity=1.0)

    @cached_property
    def _regions(self) -> "Tensor":
        from drgs.scene.select_vertices import mesh_regions

        return mesh_regions(self.asset.mesh)

    def begin(
        self, camera: CameraMessage, settings: Settings, width: int, height: int, previous: AbstractPicture | None
    ) -> AbstractPicture:
        from drgs.render.accumulate import start_frame

        if settings.channel == "indirect":
            return self._begin_indirect(camera, settings, width, height, previous)
        if isinstance(previous, SurfelPicture):
            previous = previous.before
        if isinstance(previous, IndirectPicture):
            previous = previous.whole
        known = previous if isinstance(previous, Picture) else None
        if settings.channel == "surfels":
            maps = settings.model_copy(update={"channel": "depth"})
            return SurfelPicture(self.scene, _camera(camera, width, height), known, lambda: self.begin(camera, maps, width, height, known))
        same_view = known is not None and known.view_key == _view_key(camera, width, height)
        if known is not None and same_view and known.pose is self and known.rays_key == _rays_key(settings):
            return known.shown_with(settings)
        before = None if known is None else known._state
        scene = self._under_white_sky if settings.channel == "visibility" else self.scene
        state = start_frame(scene, _camera(camera, width, height), _render_settings(settings), self.tracer, previous=before)
        return Picture(self, state, settings, _view_key(camera, width, height))


class Picture(AbstractPicture):
    """Final. Wraps the frozen states of drgs.render.accumulate."""

    def __init__(self, pose: Pose, state: "FrameState", settings: Settings, view_key: tuple) -> None:
        self.pose = pose
        self.view_key = view_key
        self.rays_key = _rays_key(settings)
        self.width, self.height = state.camera.width, state.camera.height
        self._state = state
        self._settings = settings
        self._passes_at_once = 1
        self._samples_a_pass = _samples_a_pass(state)
        self.notes = tuple(f"{skip.what} left out: {skip.why}" for skip in state.plan.skips)

    @property
    def samples(self) -> int:  # type: ignore[override]
        return self._state.passes * self._samples_a_pass

    @property
    def samples_target(self) -> int:  # type: ignore[override]
        of_light = self._settings.channel in LIGHT_CHANNELS
        wanted = self._settings.spp_target if of_light else min(CHANNEL_SAMPLES, self._settings.spp_target)
        if not of_light and self._state.fixed is not None:
            wanted = 1  # maps of Gaussians are exact from the first pass on
        return max(wanted, self._samples_a_pass)

    def shown_with(self, settings: Settings) -> "Picture":
        """The same sums under another exposure, background, channel or target."""
        picture = Picture(self.pose, replace(self._state, settings=_render_settings(settings)), settings, self.view_key)
        picture._passes_at_once = self._passes_at_once
        return picture

    def refine(self, up_to: int | None = None) -> None:
        """Add samples for about REFINE_SECONDS; no more than `up_to` in all, where somebody keeps two pictures in step."""
        from drgs.render.accumulate import refine_frame

        if self.samples >= self.samples_target:
            return
        target = self.samples_target if up_to is None else up_to
        left = -(-(target - self.samples) // self._samples_a_pass)
        passes = min(self._passes_at_once, left)
        start = time.perf_counter()
        self._state = refine_frame(self._state, passes)
        seconds = (time.perf_counter() - start) / passes
        self._passes_at_once = max(1, min(int(REFINE_SECONDS / max(seconds, 1e-4)), 2 * self._passes_at_once))

    def resolve(self) -> Pixels:
        from drgs.render.accumulate import resolve_frame

        return channel_pixels(resolve_frame(self._state), self._settings)

    def frame(self) -> "Frame":
        """With everything that is known so far."""
        from drgs.render.accumulate import resolve_frame

        return resolve_frame(self._state)

    def linear(self) -> LinearPixels:
        import torch

        from drgs.render.accumulate import linear_picture, resolve_frame

        channel = self._settings.channel
        if channel == "final":
            return linear_picture(self._state).cpu().numpy()
        maps = resolve_frame(self._state).gbuffer
        values = getattr(maps, _MAPS.get(channel, channel))
        values = (values if values.ndim == 3 else values[..., None]).expand(-1, -1, 3)
        nothing = torch.inf if channel == "depth" else 0.0
        covered = maps.coverage[..., None] > 0
        return torch.cat([torch.where(covered, values, nothing), maps.coverage.clamp(0, 1)[..., None]], -1).cpu().numpy()

    def pick(self, x: float, y: float) -> Picked | None:
        from drgs.render.accumulate import resolve_frame

        maps = resolve_frame(self._state).gbuffer
        column, row = min(int(x * self.width), self.width - 1), min(int(y * self.height), self.height - 1)
        if float(maps.coverage[row, column]) < 0.5:
            return None
        vertex = self.pose.vertex_at(maps.position_world[row, column])
        return Picked(
            position=tuple(maps.position_world[row, column].tolist()),
            normal=tuple(maps.normal_world[row, column].tolist()),
            albedo=tuple(maps.albedo[row, column].clamp(0, 1).tolist()),
            roughness=float(maps.roughness[row, column]),
            metallic=float(maps.metallic[row, column]),
            region=self.pose.region_of(vertex),
            rest=tuple(self.pose.asset.mesh.vertices[vertex].tolist()),
        )

    def explain(self) -> Explanation:
        from drgs.render.accumulate import resolve_frame

        spent = resolve_frame(self._state).metadata["milliseconds"]
        skips = tuple((skip.what, skip.why, skip.bound) for skip in self._state.plan.skips)
        return Explanation({step: value / 1000 for step, value in spent.items()}, skips)


def _samples_a_pass(state: "FrameState") -> int:
    from drgs.render.accumulate import samples_a_pass

    return samples_a_pass(state.settings, state.fixed is None).total


def _view_key(camera: CameraMessage, width: int, height: int) -> tuple:
    return (camera.world_from_camera, camera.fov_y_degrees, width, height)


def _rays_key(settings: Settings) -> tuple:
    """What of the settings changes the light that is summed, not only how it is shown."""
    if settings.channel in ("final", "variance"):
        return (settings.bounces, "all")
    return (0, "sky" if settings.channel == "visibility" else "none")


def _camera(message: CameraMessage, width: int, height: int):
    import torch

    from drgs.scene.camera import camera_from_opengl

    focal = height / 2 / np.tan(np.radians(message.fov_y_degrees) / 2)
    # Rounding may change the aspect of a reduced picture by a pixel: the full one's horizontal angle is kept.
    focal_x = focal * (width / height) * (message.height / message.width)
    intrinsics = torch.tensor([[focal_x, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return camera_from_opengl(torch.tensor(message.world_from_camera, dtype=torch.float64), intrinsics, width, height)


def _render_settings(settings: Settings):
    from drgs.render.accumulate import RenderSettings
    from drgs.render.sample_rays import SampleCounts

    background: Any = settings.background
    channel = settings.channel
    if channel != "final":
        background = "transparent"
    elif isinstance(background, tuple):
        background = tuple(_linear(value) for value in background)
    return RenderSettings(
        samples_per_pixel=settings.spp_target,
        samples_per_pass=SAMPLES_PER_PASS,
        counts=SampleCounts(SAMPLES_PER_PASS, 0, 0) if channel == "visibility" else None,
        bounces=_rays_key(settings)[0],
        denoise="svgf" if settings.denoise and channel == "final" else "none",
        exposure=settings.exposure_stops,
        tone_curve=settings.tone_curve,
        background=background,
    )


def _linear(srgb: float) -> float:
    srgb = min(max(srgb, 0.0), 1.0)
    return srgb / 12.92 if srgb <= 0.04045 else ((srgb + 0.055) / 1.055) ** 2.4
