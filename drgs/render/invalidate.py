"""What an edit makes old: the one table by which a new frame takes over parts of the one before.

In: two frames' scene, camera and settings. Out: which inputs differ, and which parts must be made again. Tensors are compared by
identity: pose_scene gives the very same ones where an edit left them alone, and nothing here writes into a tensor.
"""

from dataclasses import dataclass
from typing import Literal, get_args

import torch

from drgs.scene.camera import Camera
from drgs.scene.posed_scene import PosedScene

Input = Literal["camera", "shape", "materials", "environment", "rotation", "intensity", "rays"]
"""rays: the settings that say which rays are shot. Exposure, background, denoiser, samples and error wanted are no inputs: they
change how the sums are shown, or how long they go on."""

Part = Literal["tracer", "view", "materials", "environment_table", "light", "plan", "first_rays", "sums", "scale"]
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
    "sums": frozenset({"camera", "shape", "materials", "environment", "rotation", "rays"}),
    # Light is linear in the environment's strength: sums are multiplied.
    "scale": frozenset({"intensity"}),
}


@dataclass(frozen=True, eq=False)
class FrameInputs:
    """All that a frame's light depends on."""

    scene: PosedScene
    camera: Camera
    rays: tuple
    """Settings that change which rays are shot; compared by value."""


def changed_inputs(old: FrameInputs, new: FrameInputs) -> frozenset[Input]:
    """The inputs in which two frames differ."""
    a, b = old.scene, new.scene
    changed: set[Input] = set()
    if not _same_camera(old.camera, new.camera):
        changed.add("camera")
    if not _same_tensors(a.mesh, b.mesh, "vertices", "faces", "normals") or (a.surfels is None) != (b.surfels is None):
        changed.add("shape")
    if not _same_tensors(a.mesh, b.mesh, "albedo", "roughness", "metallic"):
        changed.add("materials")
    if a.surfels is not None and b.surfels is not None:
        if not _same_tensors(a.surfels, b.surfels, "centers", "tangents", "opacities"):
            changed.add("shape")
        if not _same_tensors(a.surfels.materials, b.surfels.materials, "albedo", "roughness", "metallic"):
            changed.add("materials")
    if a.environment.radiance is not b.environment.radiance:
        changed.add("environment")
    if a.environment_rotation_degrees != b.environment_rotation_degrees:
        changed.add("rotation")
    if a.environment_intensity != b.environment_intensity:
        # From or to darkness is another light, not a factor.
        changed.add("intensity" if a.environment_intensity > 0 and b.environment_intensity > 0 else "environment")
    if old.rays != new.rays:
        changed.add("rays")
    return frozenset(changed)


def parts_to_make(changed: frozenset[Input]) -> frozenset[Part]:
    """The parts that are old once these inputs have changed."""
    return frozenset(part for part in PARTS if MADE_FROM[part] & changed)


def _same_tensors(a: object, b: object, *names: str) -> bool:
    return all(getattr(a, name) is getattr(b, name) for name in names)


def _same_camera(a: Camera, b: Camera) -> bool:
    if a is b:
        return True
    return (a.width, a.height) == (b.width, b.height) and all(
        torch.equal(getattr(a, name).cpu(), getattr(b, name).cpu()) for name in ("camera_from_world", "intrinsics")
    )
