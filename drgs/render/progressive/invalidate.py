"""What a change makes old: the one table by which a new frame takes over parts of the one before.

In: what two frames are made of. Out: in which inputs they differ, and which parts must be computed again. Tensors are compared by
identity: pose_scene gives the very same ones where an edit left them alone, and nothing here writes into a tensor.
"""

from dataclasses import dataclass
from typing import Literal, get_args

import torch

from drgs.render.integrate.plan import samples_per_pass
from drgs.render.records import FrameInputs
from drgs.scene.camera import Camera
from drgs.scene.posed_scene import PosedScene

Input = Literal["camera", "shape", "materials", "environment", "rotation", "intensity", "rays", "split", "bounces"]
"""rays: the settings that say which rays are shot, and the rows of the image that they are shot for. split: a sum is asked for that the frame before has not.
bounces: of these, how far light is followed. Exposure, background, denoiser,
samples and error wanted are no inputs: they change how the sums are shown, or how long they go on."""

Part = Literal[
    "tracer", "view", "materials", "environment_table", "light", "plan", "first_rays", "sums", "scale", "kept_direct", "kept_indirect"
]
PARTS: tuple[Part, ...] = get_args(Part)

MADE_FROM: dict[Part, frozenset[Input]] = {
    # The tree over the triangles, and what is known about their horizons.
    "tracer": frozenset({"shape"}),
    # Coverage, depth, position and normal of what the camera sees, and where its rays start. On a mesh: of the first pass.
    "view": frozenset({"camera", "shape", "rays"}),
    # Albedo, roughness, metallic of what the camera sees.
    "materials": frozenset({"camera", "shape", "rays", "materials"}),
    "environment_table": frozenset({"environment"}),
    # The table with its turn and strength; next to nothing.
    "light": frozenset({"environment", "rotation", "intensity"}),
    "plan": frozenset({"camera", "shape", "materials", "environment", "intensity", "rays"}),
    # What the first pass's rays met; rays that an edit turned elsewhere are traced again (ray_memory.py).
    "first_rays": frozenset({"camera", "shape", "rays"}),
    "sums": frozenset({"camera", "shape", "materials", "environment", "rotation", "rays", "split", "bounces"}),
    # Light is linear in the environment's strength: sums are multiplied.
    "scale": frozenset({"intensity"}),
    # Light kept on the mesh (kept_light/): the environment's own, and what other surfaces send, which wear their materials.
    "kept_direct": frozenset({"shape", "environment", "rotation"}),
    "kept_indirect": frozenset({"shape", "environment", "rotation", "materials", "bounces"}),
}


@dataclass(frozen=True)
class Invalidation:
    """What of the frame before is old, and why."""

    changed: frozenset[Input]
    old_parts: frozenset[Part]

    @property
    def only_camera_moved(self) -> bool:
        """Then the picture before is worth something, seen from the new place (reproject.py)."""
        return self.changed == {"camera"}

    @property
    def moving(self) -> bool:
        """Camera or shape: the next frame's rays will start elsewhere too, so what these meet is not worth remembering."""
        return bool(self.changed & {"camera", "shape"})


NOTHING_BEFORE = Invalidation(frozenset(), frozenset(PARTS))
"""Of a first frame: everything is computed, and nothing moves yet."""


def invalidate(before: FrameInputs, now: FrameInputs) -> Invalidation:
    """What of a frame made of `before` is old for one made of `now`."""
    changed = changed_in_scene(before.scene, now.scene)
    if not same_camera(before.camera, now.camera):
        changed |= {"camera"}
    if _rays_asked_for(before) != _rays_asked_for(now):
        changed |= {"rays"}
    if before.settings.bounces != now.settings.bounces:
        changed |= {"bounces"}
    if now.settings.split_indirect and not before.settings.split_indirect:
        changed |= {"split"}
    return Invalidation(changed, parts_made_from(changed))


def changed_in_scene(before: PosedScene, now: PosedScene) -> frozenset[Input]:
    """The inputs in which two posed scenes differ."""
    changed: set[Input] = set()
    if not _same_tensors(before.mesh, now.mesh, "vertices", "faces", "normals") or (before.surfels is None) != (now.surfels is None):
        changed.add("shape")
    if not _same_tensors(before.mesh, now.mesh, "albedo", "roughness", "metallic"):
        changed.add("materials")
    if before.surfels is not None and now.surfels is not None:
        if not _same_tensors(before.surfels, now.surfels, "centers", "tangents", "opacities"):
            changed.add("shape")
        if not _same_tensors(before.surfels.materials, now.surfels.materials, "albedo", "roughness", "metallic"):
            changed.add("materials")
    if before.environment.radiance is not now.environment.radiance:
        changed.add("environment")
    if before.environment_rotation_degrees != now.environment_rotation_degrees:
        changed.add("rotation")
    if before.environment_intensity != now.environment_intensity:
        # From or to darkness is another light, not a factor.
        changed.add("intensity" if before.environment_intensity > 0 and now.environment_intensity > 0 else "environment")
    return frozenset(changed)


def parts_made_from(changed: frozenset[Input]) -> frozenset[Part]:
    """The parts that are old once these inputs have changed."""
    return frozenset(part for part in PARTS if MADE_FROM[part] & changed)


def _rays_asked_for(inputs: FrameInputs) -> tuple:
    """The settings that say which rays are shot."""
    settings = inputs.settings
    return (inputs.primary, samples_per_pass(inputs), settings.bounces, settings.skip, settings.skip_error, settings.seed, inputs.rows)


def _same_tensors(a: object, b: object, *names: str) -> bool:
    return all(getattr(a, name) is getattr(b, name) for name in names)


def same_camera(a: Camera, b: Camera) -> bool:
    """Whether both see the same picture."""
    if a is b:
        return True
    return (a.width, a.height) == (b.width, b.height) and all(
        torch.equal(getattr(a, name).cpu(), getattr(b, name).cpu()) for name in ("camera_from_world", "intrinsics")
    )
