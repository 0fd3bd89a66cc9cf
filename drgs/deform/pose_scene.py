"""An asset and its edits become the scene that a frame is rendered from.

Selections refer to the object at rest, so material, light and shape do not depend on each other: each is computed from its own
edits, in their order, and remembered for the asset. A scene posed again with one kind of edit changed therefore holds the very
same tensors for the rest, and a renderer sees by identity what it must rebuild.
"""

import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from drgs.deform.carry_gaussians import carry_normals, carry_tangents
from drgs.deform.clip import ClipFrame, frame_at, open_clip
from drgs.deform.drive_mesh import drive_surfels, vertex_gradients
from drgs.deform.hold_handles import HeldObject
from drgs.deform.maps import check_map, evaluate_map
from drgs.deform.rig_clip import bind_rig
from drgs.deform.simulate import Simulation
from drgs.deform.simulation_scene import mesh_files, parse_simulation_scene
from drgs.deform.vertex_sequence import vertices_at
from drgs.scene.asset import Asset
from drgs.scene.edits import DeformEdit, Edit, EnvironmentEdit, MaterialEdit, PoseEdit, SimulateEdit, split_rig_clip
from drgs.scene.environment import Environment
from drgs.scene.gaussians import surfel_tangents
from drgs.scene.load_environment import load_environment
from drgs.scene.materials import Materials
from drgs.scene.posed_scene import PosedScene, PosedSurfels
from drgs.scene.select_vertices import select_surfels, select_vertices

REMEMBERED = 4
"""Results kept of each kind for each asset."""

ShapeEdit = DeformEdit | PoseEdit | SimulateEdit
"""Edits that move things."""

Result = TypeVar("Result")
_lock = threading.Lock()
_memory: WeakKeyDictionary[Asset, OrderedDict[Any, Any]] = WeakKeyDictionary()


def pose_scene(
    asset: Asset,
    edits: Sequence[Edit],
    base_directory: Path | None = None,
    environments: Callable[[str], Environment] | None = None,
    confine: bool = False,
) -> PosedScene:
    """Apply edits in order.

    Args:
        base_directory: what file names in edits are relative to; the working directory if None.
        environments: gives an environment by the name an edit calls it; without it, names are files.
        confine: refuse file names that lead out of base_directory. Set it where edits come from strangers.

    Raises:
        ValueError: one sentence: an edit that does not fit this asset, or a missing or damaged file.
    """
    files = _Files(base_directory, confine)
    material = [edit for edit in edits if isinstance(edit, MaterialEdit)]
    deform = [edit for edit in edits if isinstance(edit, ShapeEdit)]

    material_key = ("material", *map(_text, material))
    vertex_materials, surfel_materials = _remembered(asset, material_key, lambda: _apply_materials(asset, material, material_key))
    shape_key = ("shape", *_shape_texts(deform, files))
    shape = _remembered(asset, shape_key, lambda: _apply_deformations(asset, deform, files))

    mesh, surfels = asset.mesh, None
    if material:
        mesh = replace(mesh, albedo=vertex_materials.albedo, roughness=vertex_materials.roughness, metallic=vertex_materials.metallic)
    if deform:
        mesh = replace(mesh, vertices=shape.vertices, normals=shape.normals)
    if surfel_materials is not None and shape.centers is not None and shape.tangents is not None:
        surfels = PosedSurfels(shape.centers, shape.tangents, _rest(asset).opacities, surfel_materials)
    environment, rotation, intensity = asset.environment, 0.0, 1.0
    for edit in edits:
        if isinstance(edit, EnvironmentEdit):
            rotation, intensity = edit.rotation, edit.intensity
            if edit.file is not None:
                environment = _environment(asset, edit.file, files, environments)
    return PosedScene(surfels, mesh, environment, rotation, intensity, None if deform else asset.horizons)


@dataclass(frozen=True, eq=False)
class _Shape:
    """Where everything is."""

    vertices: Tensor
    normals: Tensor
    centers: Tensor | None
    tangents: Tensor | None


@dataclass(frozen=True, eq=False)
class _Rest:
    """Surfels as the posed scene wants them, before any edit."""

    tangents: Tensor
    opacities: Tensor


@dataclass(frozen=True)
class _Files:
    """Turns the names in edits into paths."""

    base_directory: Path | None
    confine: bool

    def path(self, name: str, or_folder: bool = False) -> Path:
        base = Path.cwd() if self.base_directory is None else Path(self.base_directory)
        path = (base / name).resolve()
        if self.confine and not path.is_relative_to(base.resolve()):
            raise ValueError(f"the file {name!r} lies outside the folder that edits may read")
        if not path.is_file() and not (or_folder and path.is_dir()):
            raise ValueError(f"{path}: does not exist")
        return path

    def stamp(self, name: str | None) -> tuple | None:
        """Changes when the file does."""
        if name is None:
            return None
        path = self.path(name, or_folder=True)
        states = [(file.name, file.stat()) for file in (sorted(path.iterdir()) if path.is_dir() else [path])]
        return str(path), tuple((file, state.st_mtime_ns, state.st_size) for file, state in states)


def _rest(asset: Asset) -> _Rest:
    gaussians = asset.gaussians
    assert gaussians is not None
    return _remembered(asset, ("rest",), lambda: _Rest(surfel_tangents(gaussians), torch.sigmoid(gaussians.opacity_logits)))


def _apply_materials(asset: Asset, edits: list[MaterialEdit], key: tuple) -> tuple[Materials, Materials | None]:
    """Materials of the mesh's vertices and of the surfels. One edit more on a long list costs one edit.

    Args:
        key: of these edits; results of the first few of them may be remembered.
    """
    mesh, gaussians = asset.mesh, asset.gaussians
    of_vertices = Materials(mesh.albedo, mesh.roughness, mesh.metallic)
    of_surfels = None if gaussians is None else Materials(gaussians.albedo, gaussians.roughness, gaussians.metallic)
    done, known = _longest_remembered(asset, key)
    if known is not None:
        of_vertices, of_surfels = known
    for edit in edits[done:]:
        weights = select_vertices(mesh, edit.select)
        of_vertices = _edited(of_vertices, edit, weights)
        if gaussians is not None and of_surfels is not None:
            of_surfels = _edited(of_surfels, edit, select_surfels(gaussians.centers, mesh, asset.binding, edit.select, weights))
    return of_vertices, of_surfels


def _edited(materials: Materials, edit: MaterialEdit, weights: Tensor) -> Materials:
    """Values move by their weight from what they are towards the new value, or the multiplied one."""

    def changed(old: Tensor, value: tuple[float, ...] | float | None) -> Tensor:
        if value is None:
            return old
        weight = weights[:, None] if old.ndim == 2 else weights
        new = torch.as_tensor(value, dtype=old.dtype, device=old.device)
        new = (old * new).clamp(0, 1) if edit.mode == "multiply" else new
        return old * (1 - weight) + new * weight  # exact at weights 0 and 1

    values = edit.set
    return Materials(
        changed(materials.albedo, values.albedo),
        changed(materials.roughness, values.roughness),
        changed(materials.metallic, values.metallic),
    )


def _apply_deformations(asset: Asset, edits: list[ShapeEdit], files: _Files) -> _Shape:
    mesh, gaussians = asset.mesh, asset.gaussians
    vertices, normals = mesh.vertices, mesh.normals
    centers, tangents = (None, None) if gaussians is None else (gaussians.centers, _rest(asset).tangents)
    for index, edit in enumerate(edits):
        if isinstance(edit, PoseEdit | SimulateEdit):
            # Like a file of vertices, it says where everything is, whatever came before.
            frame = _moment(asset, edit, files)
            vertices, normals, centers, tangents = frame.vertices, frame.normals, frame.centers, frame.tangents
        elif edit.map is not None:
            check_map(edit.map, vertices)
            vertices, gradient = evaluate_map(edit.map, vertices)
            normals = carry_normals(normals, gradient)
            if centers is not None and tangents is not None:
                centers, gradient = evaluate_map(edit.map, centers)
                tangents = carry_tangents(tangents, gradient)
        elif edit.vertices is not None:
            # The file says where the vertices are, whatever came before: everything is carried from rest.
            vertices = vertices_at(files.path(edit.vertices, or_folder=True), edit.time, edit.frames_per_second, mesh)
            gradient = vertex_gradients(mesh.vertices, vertices, mesh.faces)
            normals = carry_normals(mesh.normals, gradient)
            if gaussians is not None:
                if asset.binding is None:
                    raise ValueError(f"{edit.vertices}: cannot deform this asset: its Gaussians are not bound to its mesh")
                rest_tangents = _rest(asset).tangents
                centers, tangents = drive_surfels(
                    mesh.vertices, vertices, mesh.faces, gradient, asset.binding, gaussians.centers, rest_tangents
                )
        elif edit.handles is not None and edit.handles.drag:
            handles, points = edit.handles, vertices if centers is None else torch.cat([vertices, centers])
            # What is held is prepared once for all targets that a drag passes through.
            grips = ("handles", *_shape_texts(edits[:index], files), _text_of_grips(edit))
            held = _remembered(asset, grips, lambda h=handles, v=vertices, p=points: HeldObject(mesh.vertices, v, mesh.faces, h, p))
            positions, gradient = held.pull(handles)
            count = len(vertices)
            vertices, normals = positions[:count].contiguous(), carry_normals(normals, gradient[:count])
            if centers is not None and tangents is not None:
                centers, tangents = positions[count:].contiguous(), carry_tangents(tangents, gradient[count:])
        if not all(torch.isfinite(values).all() for values in (vertices, normals, centers, tangents) if values is not None):
            raise ValueError(f"the {edit.op} edit {_text(edit)[:120]} moves parts of this object to infinity")
    return _Shape(vertices, normals, centers, tangents)


def _moment(asset: Asset, edit: PoseEdit | SimulateEdit, files: _Files) -> ClipFrame:
    """What a clip, a rig or a simulation shows at the edit's time; at rest, the asset's own tensors."""
    centers, tangents = (None, None) if asset.gaussians is None else (asset.gaussians.centers, _rest(asset).tangents)
    rest = ClipFrame(asset.mesh.vertices, asset.mesh.normals, centers, tangents)
    if isinstance(edit, SimulateEdit):
        scene = parse_simulation_scene(edit.scene)
        if edit.time == 0:
            return rest
        key = ("simulation", scene.model_dump_json(), _stamps(edit, files))
        frame = _remembered(asset, key, lambda: Simulation(asset, scene, lambda name: files.path(name, or_folder=True))).at(edit.time)
    elif (rig := split_rig_clip(edit.clip)) is not None:
        key = ("rig", files.stamp(rig[0]), edit.model_dump_json(exclude={"time"}))
        bound = _remembered(asset, key, lambda: bind_rig(files.path(rig[0]), rig[1], asset, rest, edit.rig))
        frame = bound.at(edit.time)
    else:
        clip = open_clip(files.path(f"{edit.clip}/clip.json").parent)
        surfels = 0 if asset.gaussians is None else len(asset.gaussians.centers)
        if (clip.vertices, clip.surfels) != (len(asset.mesh.vertices), surfels):
            raise ValueError(
                f"the clip {edit.clip} was made for another object: it has {clip.vertices} vertices and {clip.surfels} surfels, "
                f"this one {len(asset.mesh.vertices)} and {surfels}"
            )
        frame = frame_at(clip, edit.time, asset.mesh.vertices.device)
    return frame


def _file(edit: ShapeEdit) -> str | None:
    """The file that an edit reads, whose change must be noticed."""
    if isinstance(edit, PoseEdit):
        rig = split_rig_clip(edit.clip)
        return f"{edit.clip}/clip.json" if rig is None else rig[0]
    return edit.vertices if isinstance(edit, DeformEdit) else None


def _environment(asset: Asset, name: str, files: _Files, environments: Callable[[str], Environment] | None) -> Environment:
    if environments is not None:
        return environments(name)
    device = asset.environment.radiance.device

    def load() -> Environment:
        return Environment(load_environment(files.path(name)).radiance.to(device))

    return _remembered(asset, ("environment", files.stamp(name)), load)


def _shape_texts(edits: list[ShapeEdit], files: _Files) -> tuple:
    """Differ where shapes may."""
    return tuple((_text(edit), _stamps(edit, files)) for edit in edits)


def _stamps(edit: ShapeEdit, files: _Files) -> tuple:
    """Of all files that the edit reads: whoever changes one must be noticed."""
    if isinstance(edit, SimulateEdit):
        return tuple(map(files.stamp, mesh_files(parse_simulation_scene(edit.scene))))
    return (files.stamp(_file(edit)),)


def _text_of_grips(edit: DeformEdit) -> str:
    """What is held, whatever the targets."""
    return edit.model_dump_json(exclude={"handles": {"drag": {"__all__": {"target", "turn"}}}})


def _text(edit: Edit) -> str:
    return edit.model_dump_json()


def _is_optimised(asset: Asset) -> bool:
    return any(value.requires_grad for record in (asset.gaussians, asset.mesh) if record is not None for value in vars(record).values())


def _longest_remembered(asset: Asset, key: tuple) -> tuple[int, Any]:
    """How many words after the first of this key, fewer than all, are those of a key whose result is remembered, and that; or 0 and None."""
    if _is_optimised(asset):
        return 0, None
    with _lock:
        kept = _memory.get(asset, OrderedDict())
        begun = [other for other in kept if len(other) < len(key) and other == key[: len(other)]]
        longest = max(begun, key=len, default=None)
        return (0, None) if longest is None else (len(longest) - 1, kept[longest])


def _remembered(asset: Asset, key: tuple, make: Callable[[], Result]) -> Result:
    """The result of `make` for this key, the same object as long as it is among the last few of its kind (the key's first word).

    An asset is frozen, so nothing here goes stale; while its tensors are being optimised, nothing is remembered.
    """
    if _is_optimised(asset):
        return make()
    with _lock:
        kept = _memory.setdefault(asset, OrderedDict())
        if key in kept:
            kept.move_to_end(key)
            return kept[key]
    result = make()
    with _lock:
        result = kept.setdefault(key, result)
        alike = [other for other in kept if other[0] == key[0]]
        for other in alike[:-REMEMBERED]:
            del kept[other]
    return result
