"""The renderer of the service: drgs' own progressive frames, with everything kept that a change leaves as it was.

What an edit makes old is drgs/render/progressive/invalidate.py's table; frames are handed on from picture to picture, so that a new environment keeps
what the camera sees, a new exposure all samples, and a moving camera what its last picture showed of the same places.

Imported only on the render thread, and torch only inside functions: the API process must start fast.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from drgs.maths.color_numpy import linear_from_srgb
from drgs.scene.edits import Edit
from drgs_server.live.messages import NO_CERTAINTY, CameraMessage, Channel, Settings
from drgs_server.render.channels import channel_pixels, linear_channel
from drgs_server.render.environment_memory import EnvironmentMemory
from drgs_server.render.interface import (
    AbstractLoadedAsset,
    AbstractPicture,
    AbstractPose,
    AbstractRenderer,
    AbstractStill,
    Bounds,
    Explanation,
    LinearPixels,
    Picked,
    Pixels,
    Positions,
    Rotation,
    view_of_bounds,
)
from drgs_server.render.layers import LayeredStill, certainty_layers, light_layers, visibility_layers
from drgs_server.render.still import SLICE_SECONDS, Still, SurfelStill
from drgs_server.render.surfel_picture import SurfelPicture

if TYPE_CHECKING:
    from torch import Tensor

    from drgs.render.intersect.tracer import AbstractTracer
    from drgs.render.progressive.frame_state import FrameState
    from drgs.render.records import GBuffer
    from drgs.render.render_bands import Band
    from drgs.scene.asset import Asset
    from drgs.scene.camera import Camera
    from drgs.scene.environment import Environment
    from drgs.scene.posed_scene import PosedScene

SAMPLES_PER_PASS = 4
"""Rays a pixel of the first, quick picture: two cosine, one GGX, one towards the environment."""
REFINE_SECONDS = 0.03
"""A refinement lasts about this long, so that a new input need not wait; never less than one pass."""
CHANNEL_SAMPLES = 32
"""Behind a picture of albedo, normals ...: passes are its antialiasing."""
TURNS_KEPT = 4
"""Lights as cameras turn them, that a pose keeps: of as many viewers, who then find their own again while their cameras rest."""

LIGHT_CHANNELS = ("final", "visibility", "indirect", "variance")
"""Channels of Picture that are summed over rays; the others are known once the surface is."""


class DrgsRenderer(AbstractRenderer):
    """Final."""

    def __init__(self, device: str = "auto") -> None:
        self._device = device
        self._light = EnvironmentMemory()

    def load(self, folder: Path, environments: Path) -> "LoadedAsset":
        from drgs.scene.asset import load_asset
        from drgs.warp_torch import device_from_name

        return LoadedAsset(load_asset(folder, device_from_name(self._device)), environments, self._light)

    def environment_bytes(self) -> int:
        return self._light.bytes()

    def forget_environments(self) -> None:
        self._light.forget_unused()

    def prepare(self) -> None:
        from drgs.deform import pose_scene  # noqa: F401 -- the first drag shall not wait for it and these
        from drgs.deform.displace import hold_handles  # noqa: F401
        from drgs.deform.matter import simulate  # noqa: F401
        from drgs.deform.rig import rig_clip  # noqa: F401
        from drgs.render import render_frame  # noqa: F401
        from drgs.scene import asset  # noqa: F401


class LoadedAsset(AbstractLoadedAsset):
    """Final."""

    def __init__(self, asset: "Asset", environments: Path, light: EnvironmentMemory | None = None) -> None:
        self.asset = asset
        self._environments = environments
        self._light = light or EnvironmentMemory()
        low, high = asset.mesh.vertices.amin(0).tolist(), asset.mesh.vertices.amax(0).tolist()
        self.bounds = Bounds(tuple(low), tuple(high))
        self.start_view = view_of_bounds(self.bounds)
        self.light_camera = _light_camera(asset)

    def pose(self, edits: Sequence[Edit], previous: AbstractPose | None, go_on: Callable[[], None] | None = None) -> "Pose":
        from drgs.deform.pose_scene import pose_scene
        from drgs.render.progressive.start_frame import tracer_of

        scene = pose_scene(self.asset, edits, self._environments, environments=self._environment, confine=True, go_on=go_on)
        before = (previous.scene, previous.tracer) if isinstance(previous, Pose) else None
        return Pose(self.asset, scene, tracer_of(scene, before))

    def keep(self, edits: Sequence[Edit], path: Path) -> None:
        from drgs.deform.keep_pose import save_pose

        save_pose(self.asset, edits, path, self._environments)

    def recall(self, edits: Sequence[Edit], path: Path) -> bool:
        from drgs.deform.keep_pose import recall_pose

        return recall_pose(self.asset, edits, path, self._environments) > 0

    def simulation_bytes(self) -> int:
        from drgs.deform.pose_scene import simulation_bytes

        return simulation_bytes(self.asset)

    def forget_simulations(self) -> None:
        from drgs.deform.pose_scene import forget_simulations

        forget_simulations(self.asset)

    def _environment(self, name: str) -> "Environment":
        return self._light.get(self._environments / name, self.asset.mesh.vertices.device)


@dataclass(frozen=True, eq=False)
class Pose(AbstractPose):
    """Final."""

    asset: "Asset"
    scene: "PosedScene"
    tracer: "AbstractTracer"

    def vertex_at(self, position_world: "Tensor") -> int:
        """Selections refer to the object at rest, whose vertices have the numbers of the moved ones."""
        nearest = (self.scene.mesh.vertices - position_world).square().sum(-1).argmin()
        return int(nearest if self.scene.vertex_source is None else self.scene.vertex_source[nearest])

    def region_of(self, vertex: int) -> int:
        return int(self._regions[vertex])

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
        from drgs.render.progressive.start_frame import start_frame

        if isinstance(previous, SurfelPicture):
            previous = previous.before
        known = previous if isinstance(previous, Picture) else None
        if settings.channel == "surfels":
            maps = settings.model_copy(update={"channel": "depth"})
            return SurfelPicture(self.scene, _camera(camera, width, height), known, lambda: self.begin(camera, maps, width, height, known))
        before = None if known is None else known.state
        seen = _camera(camera, width, height)
        scene, tracer = self._shown(settings, seen)
        state = start_frame(scene, seen, _render_settings(settings), tracer, previous=before)
        return Picture(self, state, settings, known if state.computed_parts == () else None)

    def still(self, camera: CameraMessage, settings: Settings, width: int, height: int, linear: bool) -> AbstractStill:
        from drgs.render.render_bands import render_bands

        seen = _camera(camera, width, height)
        if settings.channel == "surfels":
            return SurfelStill(self.scene, seen)
        if settings.channel == "certainty" and self.certainty is None:
            raise ValueError(NO_CERTAINTY)
        scene, tracer = self._shown(settings, seen)
        rendered = replace(_render_settings(settings), samples_per_pixel=_samples_wanted(settings, self.scene.primary))
        bands = render_bands(scene, seen, rendered, tracer, SLICE_SECONDS)
        return Still(bands, height, width, settings, linear)

    def vertices(self) -> Positions:
        # Of the asset's own: who asks knows no grains.
        return self.scene.mesh.vertices[: len(self.asset.mesh.vertices)].detach().cpu().numpy().astype("<f4")

    def layers(self, camera: CameraMessage, settings: Settings, width: int, height: int) -> AbstractStill:
        from drgs.render.render_bands import render_bands

        seen = _camera(camera, width, height)

        def bands(channel: Channel) -> "Iterator[Band | None]":
            shown = settings.model_copy(update={"channel": channel, "background": "transparent"})
            scene, tracer = self._shown(shown, seen)
            samples = _samples_wanted(shown, self.scene.primary)
            rendered = replace(_render_settings(shown), samples_per_pixel=samples, split_indirect=channel == "final")
            return render_bands(scene, seen, rendered, tracer, SLICE_SECONDS)

        parts = [(bands("final"), light_layers), (bands("visibility"), visibility_layers)]
        if self.certainty is not None:
            parts.append((bands("certainty"), certainty_layers))
        return LayeredStill(parts, None if self.scene.surfels is None else SurfelStill(self.scene, seen))

    def _shown(self, settings: Settings, camera: "Camera") -> tuple["PosedScene", "AbstractTracer"]:
        """What a picture of this channel is made of."""
        if settings.channel == "certainty" and self.certainty is not None:
            return self.certainty
        if settings.channel == "visibility":
            return self._under_white_sky, self.tracer
        return self._lit(settings, camera), self.tracer

    def _lit(self, settings: Settings, camera: "Camera") -> "PosedScene":
        """The scene, its light as the camera turns it where that was asked for."""
        from drgs.scene.asset import light_from_world

        own = self.scene.environment.radiance is self.asset.environment.radiance
        turn = light_from_world(self.asset, [])(camera) if settings.turn_light and own else None
        return self.scene if turn is None else self._turned(tuple(turn.flatten().tolist()))

    @cached_property
    def _turned(self) -> "Callable[[tuple[float, ...]], PosedScene]":
        """Of a rotation of directions in the world to the light's: the very same scene for the same one, so that a picture's sums go on."""
        import torch

        from drgs.scene.environment import turned_environment

        @lru_cache(maxsize=TURNS_KEPT)
        def turned(rotation: tuple[float, ...]) -> "PosedScene":
            turn = torch.tensor(rotation).view(3, 3)
            return replace(self.scene, environment=turned_environment(self.scene.environment, turn))

        return turned

    @cached_property
    def certainty(self) -> "tuple[PosedScene, AbstractTracer] | None":
        """The scene that wears it as its albedo; None where the asset holds none."""
        from drgs.render.visible.paint_certainty import paint_certainty

        scene = paint_certainty(self.scene, self.asset.mesh.faces, self.asset.certainty, self.asset.binding)
        return None if scene is None else (scene, self.tracer.with_materials(scene.mesh))


class Picture(AbstractPicture):
    """Final. Wraps the frozen states of drgs.render.progressive."""

    def __init__(self, pose: Pose, state: "FrameState", settings: Settings, continued: "Picture | None" = None) -> None:
        """
        Args:
            continued: the picture whose sums go on: how many passes fit into a refinement is known of it.
        """
        self.pose = pose
        self.state = state
        self.width, self.height = state.inputs.camera.width, state.inputs.camera.height
        self._settings = settings
        self._passes_at_once: int = 1 if continued is None else continued._passes_at_once
        self._samples_a_pass = _samples_a_pass(state)
        self._nothing_known = settings.channel == "certainty" and pose.certainty is None

    @property
    def notes(self) -> tuple[str, ...]:  # type: ignore[override]
        return (NO_CERTAINTY,) if self._nothing_known else tuple(f"{skip.what} left out: {skip.why}" for skip in self.state.plan.skips)

    @property
    def samples(self) -> int:  # type: ignore[override]
        # A moving picture is not finished, however few samples are asked for.
        return min(self.state.samples, self.samples_target - 1) if self.state.is_quick else self.state.samples

    @property
    def samples_target(self) -> int:  # type: ignore[override]
        return max(_samples_wanted(self._settings, self.state.inputs.primary), self._samples_a_pass)

    def refine(self) -> None:
        """Add samples for about REFINE_SECONDS."""
        from drgs.render.progressive.refine import refine_frame

        if self.samples >= self.samples_target:
            return
        left = -(-(self.samples_target - self.samples) // self._samples_a_pass)
        passes = min(self._passes_at_once, left)
        start = time.perf_counter()
        self.state = refine_frame(self.state, passes)
        seconds = (time.perf_counter() - start) / passes
        self._passes_at_once = max(1, min(int(REFINE_SECONDS / max(seconds, 1e-4)), 2 * self._passes_at_once))

    def resolve(self) -> Pixels:
        from drgs.render.film.resolve_frame import resolve_frame

        if self._nothing_known:
            return np.zeros((self.height, self.width, 4), np.uint8)
        return channel_pixels(resolve_frame(self.state), self._settings)

    def linear(self) -> LinearPixels:
        return linear_channel(self.state, self._settings.channel).cpu().numpy()

    def pick(self, x: float, y: float) -> Picked | None:
        maps = self._maps()
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

    def _maps(self) -> "GBuffer":
        """What the camera sees, in its own colours."""
        from drgs.render.film.resolve_frame import resolve_frame
        from drgs.render.progressive.refine import refine_frame
        from drgs.render.progressive.start_frame import start_frame

        state, pose, inputs = self.state, self.pose, self.state.inputs
        if inputs.scene.mesh is not pose.scene.mesh:
            state = refine_frame(start_frame(pose.scene, inputs.camera, inputs.settings, pose.tracer, previous=state), 1)
        return resolve_frame(state).gbuffer

    def explain(self) -> Explanation:
        from drgs.render.film.resolve_frame import resolve_frame

        spent = resolve_frame(self.state).metadata["milliseconds"]
        skips = tuple((skip.what, skip.why, skip.bound) for skip in self.state.plan.skips)
        return Explanation({step: value / 1000 for step, value in spent.items()}, skips)


def _samples_wanted(settings: Settings, primary: str) -> int:
    """Rays a pixel behind a finished picture."""
    if settings.channel in LIGHT_CHANNELS:
        return settings.spp_target
    # Maps of Gaussians are exact from the first pass on.
    return 1 if primary == "gaussians" else min(CHANNEL_SAMPLES, settings.spp_target)


def _samples_a_pass(state: "FrameState") -> int:
    from drgs.render.integrate.plan import samples_per_pass

    return samples_per_pass(state.inputs).total


def _camera(message: CameraMessage, width: int, height: int):
    import torch

    from drgs.scene.camera import camera_from_opengl

    focal = height / 2 / np.tan(np.radians(message.fov_y_degrees) / 2)
    # Rounding may change the aspect of a reduced picture by a pixel: the full one's horizontal angle is kept.
    focal_x = focal * (width / height) * (message.height / message.width)
    intrinsics = torch.tensor([[focal_x, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return camera_from_opengl(torch.tensor(message.world_from_camera, dtype=torch.float64), intrinsics, width, height)


def _light_camera(asset: "Asset") -> Rotation | None:
    """Of ServerHello."""
    from drgs.scene.camera import opengl_from_camera

    if asset.light_frame == "object":
        return None
    rows = opengl_from_camera(asset.cameras[0])[:3, :3].tolist()
    return (tuple(rows[0]), tuple(rows[1]), tuple(rows[2]))


def _bounces(settings: Settings) -> int:
    if settings.channel == "indirect":
        return max(1, settings.bounces)  # with none there would be nothing to see
    return settings.bounces if settings.channel in ("final", "variance") else 0


def _render_settings(settings: Settings):
    from drgs.render.records import RenderSettings, SampleCounts

    background: Any = settings.background
    channel = settings.channel
    if channel != "final":
        background = "transparent"
    elif isinstance(background, tuple):
        background = tuple(linear_from_srgb(np.clip(background, 0, 1)).tolist())
    return RenderSettings(
        samples_per_pixel=settings.spp_target,
        samples_per_pass=SAMPLES_PER_PASS,
        counts=SampleCounts(SAMPLES_PER_PASS, 0, 0) if channel == "visibility" else None,
        bounces=_bounces(settings),
        split_indirect=channel == "indirect",
        keep_light=True,
        denoise="svgf" if settings.denoise and channel == "final" else "none",
        exposure=settings.exposure_stops,
        tone_curve=settings.tone_curve,
        background=background,
    )
