"""An animation in a glTF or FBX file as a clip of an object: read, laid over the object at rest, bound, and evaluated at any time.

In: a file, the name of an animation, an asset and a `RigBinding`. Out: `ClipFrame`s. glTF's y up and metres become z up and world units
first, so that a rig made around an exported object lies where that object is. The rig moves the object's mesh; how far the surface really
turns and stretches, which normals and surfels must follow, is read from the moved mesh (drive_mesh.py).
"""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from drgs.deform.carry.carry_gaussians import carry_normals
from drgs.deform.carry.drive_mesh import drive_surfels
from drgs.deform.carry.surface_gradients import SurfaceAtRest, prepare_surface, surface_gradients
from drgs.deform.clip import ClipFrame
from drgs.deform.matter.simulate import limit_stretch
from drgs.deform.rig.proxy import ProxyBinding, bind_to_proxy, carry_points, closest_faces
from drgs.deform.rig.skeleton import RigPose, pose_rig, rig_gradients
from drgs.exchange.fbx_rig import read_fbx_rig
from drgs.exchange.gltf_rig import read_gltf_rig
from drgs.exchange.rig import Rig, RigAnimation
from drgs.maths.frames import rotation_from_quat_wxyz
from drgs.scene.asset import Asset
from drgs.scene.binding import Binding
from drgs.scene.edits import RigBinding

FARTHEST = 0.5
"""Median distance from the object to the rig, in diagonals of the object, beyond which they do not lie on each other."""
LARGEST_STRETCH = 4.0
"""Of a surfel: what a rig pulls apart farther is torn, and should show a gap rather than needles."""


@dataclass(frozen=True, eq=False)
class Alignment:
    """World from the rig file's axes and units: x -> matrix x + translation, float64."""

    matrix: Float[Tensor, "3 3"]
    """Rotation times scale."""
    translation: Float[Tensor, "3"]

    def place(self, pose: RigPose) -> RigPose:
        return replace(pose, vertices=pose.vertices @ self.matrix.T + self.translation)


@dataclass(frozen=True, eq=False)
class BoundRig:
    """An object that follows an animation."""

    rig: Rig
    animation: RigAnimation
    alignment: Alignment
    rest_pose: RigPose
    """In the file's axes: the rig as it stands when the object is at rest."""
    binding: ProxyBinding
    """Of the object's vertices to the rig's mesh."""
    rest: ClipFrame
    surface: SurfaceAtRest
    """The object's mesh."""
    surfels: Binding | None
    """Of the object's surfels to its mesh."""
    loop: bool

    def at(self, seconds: float) -> ClipFrame:
        """Where the object is at a time; the very tensors of its rest where the rig is at rest."""
        if self.loop and self.animation.duration > 0:
            seconds = math.fmod(seconds, self.animation.duration)
        pose = pose_rig(self.rig, self.animation, seconds)
        if torch.equal(pose.vertices, self.rest_pose.vertices):
            return self.rest
        moved = self.alignment.place(pose)
        rest = self.rest
        # float64 up to the gradients: edges are short, and their ends' rounding would turn normals.
        vertices = carry_points(self.binding, moved.vertices, rig_gradients(self.alignment.place(self.rest_pose), moved))
        gradient = limit_stretch(surface_gradients(self.surface, vertices).to(rest.vertices.dtype), LARGEST_STRETCH)
        vertices = vertices.to(rest.vertices.dtype)
        normals = carry_normals(rest.normals, gradient)
        if rest.centers is None or rest.tangents is None or self.surfels is None:
            return ClipFrame(vertices, normals, None, None)
        surfels = drive_surfels(rest.vertices, vertices, self.surface.faces, gradient, self.surfels, rest.centers, rest.tangents)
        return ClipFrame(vertices, normals, *surfels)


def bind_rig(path: Path, animation: str, asset: Asset, rest: ClipFrame, binding: RigBinding | None = None) -> BoundRig:
    """Bind an object to an animation of a file.

    Args:
        animation: its name, or its number if none has that name; "" for the file's only one.
        rest: the asset's own tensors.

    Raises:
        ValueError: one sentence that names the file: unreadable, no such animation, or a rig that does not lie on the object.
    """
    options = binding or RigBinding()
    rig = read_fbx_rig(path) if path.suffix.lower() == ".fbx" else read_gltf_rig(path)
    try:
        clip = find_animation(rig, animation)
        rest_pose = pose_rig(rig) if options.rest is None else pose_rig(rig, clip, options.rest)
        alignment = align_rig(rest_pose.vertices, rest.vertices, asset.meters_per_unit, options)
        placed = alignment.place(rest_pose)
        bound = bind_to_proxy(placed.vertices, placed.faces, rest.vertices, rest.normals, options.method)
        distance = float(bound.offset.norm(dim=-1).median())
        size = float((rest.vertices.amax(0) - rest.vertices.amin(0)).norm())
        if distance > FARTHEST * size:
            raise ValueError(
                f"the rig lies {distance:.3g} world units away from the object, whose size is {size:.3g}; "
                'move and scale it by the edit\'s "rig", or let "fit" do so'
            )
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    surfels = asset.binding
    if surfels is None and rest.centers is not None:
        # A surfel's normal may point either way: none is given, and the closest face is taken.
        mesh, centers = asset.mesh, rest.centers
        face, barycentric = closest_faces(mesh.vertices.double(), mesh.faces.long(), centers, torch.zeros_like(centers))
        surfels = Binding(face.int(), barycentric.float(), torch.zeros(len(centers), device=centers.device))
    return BoundRig(rig, clip, alignment, rest_pose, bound, rest, prepare_surface(rest.vertices, asset.mesh.faces), surfels, options.loop)


def find_animation(rig: Rig, name: str) -> RigAnimation:
    """An animation by name, else by number from 0; "" is the only one.

    Raises:
        ValueError: none is meant, or several might be.
    """
    if not rig.animations:
        raise ValueError("holds no animations")
    names = [animation.name for animation in rig.animations]
    if name == "" and len(names) == 1:
        return rig.animations[0]
    if name in names:
        return rig.animations[names.index(name)]
    if name.isdecimal() and int(name) < len(names):
        return rig.animations[int(name)]
    shown = ", ".join(repr(known[:40]) for known in names[:10])
    raise ValueError(
        f"holds {len(names)} animations ({shown}); name one after a #" if name == "" else f"has no animation {name!r}, but {shown}"
    )


def align_rig(
    rig_vertices: Float[Tensor, "rig_vertex 3"], object_vertices: Float[Tensor, "vertex 3"], meters_per_unit: float, options: RigBinding
) -> Alignment:
    """World from a rig's file: axes and units, then `turn`, then `fit` if wanted, then `scale` about the centre so far and `translation`."""
    world_from_file = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64) / meters_per_unit
    turn = torch.deg2rad(torch.tensor(options.turn, dtype=torch.float64))
    angle = turn.norm()
    quat = torch.cat([torch.cos(angle / 2)[None], turn / 2 * torch.sinc(angle / (2 * math.pi))])
    matrix = rotation_from_quat_wxyz(quat) @ world_from_file
    centre = torch.zeros(3, dtype=torch.float64)
    start = torch.zeros(3, dtype=torch.float64)
    if options.fit:
        turned = rig_vertices @ matrix.T
        low, high = turned.amin(0), turned.amax(0)
        target = object_vertices.detach().double().cpu()
        target_low, target_high = target.amin(0), target.amax(0)
        diagonal = (high - low).norm()
        if not diagonal > 0:
            raise ValueError("the rig's mesh is a single point, which fits nothing")
        matrix = matrix * ((target_high - target_low).norm() / diagonal)
        start, centre = (low + high) / 2 * ((target_high - target_low).norm() / diagonal), (target_low + target_high) / 2
    matrix = matrix * options.scale
    return Alignment(matrix, centre - start * options.scale + torch.tensor(options.translation, dtype=torch.float64))
