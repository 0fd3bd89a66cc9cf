"""An asset and its edits become the scene that a frame is rendered from.

Selections refer to the object at rest, so material, light and shape do not depend on each other: each is computed from its own
edits, in their order, and remembered for the asset. A scene posed again with one kind of edit changed therefore holds the very
same tensors for the rest, and a renderer sees by identity what it must rebuild.

What handles, rigs and simulations need is imported when an edit asks for it: most processes that pose a scene have none of them.
"""

import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

import torch
from jaxtyping import Float
from torch import Tensor

from drgs.deform.carry.carry_gaussians import carry_normals, carry_tangents
from drgs.deform.carry.drive_mesh import drive_surfels, vertex_gradients
from drgs.deform.clip import ClipFrame, Parted, frame_at, open_clip
from drgs.deform.displace.maps import check_map, evaluate_map
from drgs.deform.displace.vertex_sequence import vertices_at
from drgs.deform.sort_edits import EditFiles, EditSteps, ShapeEdit, SortedEdits, file_names, sort_edits
from drgs.scene.albedo_detail import worn_by
from drgs.scene.asset import Asset
from drgs.scene.edits import DeformEdit, Edit, MaterialEdit, PoseEdit, SimulateEdit, split_rig_clip
from drgs.scene.environment import Environment
from drgs.scene.gaussians import surfel_tangents
from drgs.scene.load_environment import load_environment
from drgs.scene.materials import Materials
from drgs.scene.posed_scene import PosedScene, PosedSurfels
from drgs.scene.select_vertices import read_weights, select_surfels, select_vertices

REMEMBERED = 4
"""Results kept of each kind for each asset."""
CHECKPOINT = 64
"""Edits after which what they have made so far is kept by itself, so that undoing many of a long list begins with the last of these."""
CHECKPOINTS = " checkpoints"
"""Behind a kind: those of it."""

Result = TypeVar("Result")
_lock = threading.Lock()
_memory: WeakKeyDictionary[Asset, OrderedDict[Any, Any]] = WeakKeyDictionary()


def pose_scene(
    asset: Asset,
    edits: Sequence[Edit],
    base_directory: Path | None = None,
    environments: Callable[[str], Environment] | None = None,
    confine: bool = False,
    go_on: Callable[[], None] | None = None,
) -> PosedScene:
    """Apply edits in order.

    Args:
        base_directory: what file names in edits are relative to; the working directory if None.
        environments: gives an environment by the name an edit calls it; without it, names are files.
        confine: refuse file names that lead out of base_directory. Set it where edits come from strangers.
        go_on: called between two steps of what may take long, such as a simulation's; what it raises ends the work.

    Raises:
        ValueError: one sentence: an edit that does not fit this asset, or a missing or damaged file.
    """
    files = EditFiles(base_directory, confine)
    by_kind = sort_edits(asset, edits, files)

    worn = _materials_after(asset, by_kind.material, files, go_on)
    shape = _shape_after(asset, by_kind.shape, files, go_on)

    mesh, surfels = asset.mesh, None
    if by_kind.material.count:
        mesh = replace(mesh, **vars(worn.of_vertices), detail=worn_by(mesh.detail, worn.detail_share))
    if by_kind.shape.count:
        mesh = replace(mesh, vertices=shape.vertices, normals=shape.normals)
    if worn.of_surfels is not None and shape.centers is not None and shape.tangents is not None:
        surfels = PosedSurfels(shape.centers, shape.tangents, _rest(asset).opacities, worn.of_surfels)
    environment, light = asset.environment, by_kind.light
    for name in light.files:
        environment = _environment(asset, name, files, environments)
    horizons = None if by_kind.shape.count else asset.horizons
    scene = PosedScene(surfels, mesh, environment, light.rotation_degrees, light.intensity, horizons, asset.primary)
    return scene if shape.parted is None else _with_grains(asset, scene, shape.parted, by_kind)


def _with_grains(asset: Asset, scene: PosedScene, parted: Parted, by_kind: SortedEdits) -> PosedScene:
    from drgs.deform.matter.show_grains import grains_of, show_grains

    shape, material = _key("shape", by_kind.shape), _key("material", by_kind.material)
    grains = _remembered(asset, ("grains", shape), lambda: grains_of(scene.mesh, scene.surfels, parted))
    # One tensor as long as shape and materials stay, by which a renderer sees that nothing has changed.
    shown = _remembered(asset, ("shown grains", shape, material), lambda: show_grains(scene, grains))
    return replace(scene, mesh=shown.mesh, surfels=shown.surfels, vertex_source=shown.vertex_source, surfel_source=shown.surfel_source)


def simulation_bytes(asset: Asset) -> int:
    """Of the frames that simulations of this asset have made, as far as they are remembered."""
    return sum(simulation.frame_bytes for simulation in _simulations(asset).values())


def forget_simulations(asset: Asset) -> None:
    """All but the one asked for last: frames of others are computed again when somebody asks for them."""
    unused = list(_simulations(asset))[:-1]
    with _lock:
        for key in unused:
            _memory.get(asset, OrderedDict()).pop(key, None)


def _simulations(asset: Asset) -> dict[tuple, Any]:
    with _lock:
        return {key: value for key, value in _memory.get(asset, OrderedDict()).items() if key[0] == "simulation"}


PoseParts = dict[str, Tensor]
"""Results behind a posed scene by name: mesh.albedo, mesh.vertices, surfel.tangents, ..."""


def known_parts(asset: Asset, by_kind: SortedEdits) -> PoseParts | None:
    """What these edits have made of the asset, where it is still remembered and hangs together."""
    materials: _Worn | None = _materials_at_rest(asset)
    shape: _Shape | None = _shape_at_rest(asset)
    with _lock:
        kept = _memory.get(asset, OrderedDict())
        if by_kind.material.count:
            materials = kept.get(_key("material", by_kind.material))
        if by_kind.shape.count:
            shape = kept.get(_key("shape", by_kind.shape))
    if materials is None or shape is None or shape.parted is not None:
        return None
    of_surfels = materials.of_surfels
    parts = {f"mesh.{name}": values for name, values in vars(materials.of_vertices).items()} | {
        "mesh.vertices": shape.vertices,
        "mesh.normals": shape.normals,
    }
    if of_surfels is not None:
        parts |= {f"surfel.{name}": values for name, values in vars(of_surfels).items()}
        parts |= {"surfel.centers": shape.centers, "surfel.tangents": shape.tangents}
    return parts if materials.detail_share is None else parts | {"mesh.detail_share": materials.detail_share}


def remember_parts(asset: Asset, counts: dict[str, int], by_kind: SortedEdits, parts: PoseParts) -> None:
    """Go on from there when these edits, or more, are posed next.

    Args:
        counts: how many of the edits of material and of shape made the parts.
    """

    def materials(of: str) -> Materials:
        return Materials(parts[f"{of}.albedo"], parts[f"{of}.roughness"], parts[f"{of}.metallic"])

    shape = _Shape(parts["mesh.vertices"], parts["mesh.normals"], parts.get("surfel.centers"), parts.get("surfel.tangents"))
    worn = _Worn(materials("mesh"), materials("surfel") if "surfel.albedo" in parts else None, parts.get("mesh.detail_share"))
    # Of no edits it is the asset's own tensors, by which a renderer sees that nothing has changed.
    if counts["material"]:
        _remembered(asset, _key("material", by_kind.material, counts["material"]), lambda: worn)
    if counts["shape"]:
        _remembered(asset, _key("shape", by_kind.shape, counts["shape"]), lambda: shape)


@dataclass(frozen=True, eq=False)
class _Shape:
    """Where everything is."""

    vertices: Float[Tensor, "vertex 3"]
    normals: Float[Tensor, "vertex 3"]
    centers: Float[Tensor, "surfel 3"] | None
    tangents: Float[Tensor, "surfel 3 2"] | None
    parted: Parted | None = None


@dataclass(frozen=True, eq=False)
class _Rest:
    """Surfels as the posed scene wants them, before any edit."""

    tangents: Float[Tensor, "surfel 3 2"]
    opacities: Float[Tensor, "surfel"]


def _rest(asset: Asset) -> _Rest:
    gaussians = asset.gaussians
    assert gaussians is not None
    return _remembered(asset, ("rest",), lambda: _Rest(surfel_tangents(gaussians), torch.sigmoid(gaussians.opacity_logits)))


@dataclass(frozen=True, eq=False)
class _Worn:
    """What everything is made of."""

    of_vertices: Materials
    of_surfels: Materials | None
    detail_share: Float[Tensor, "vertex"] | None
    """AlbedoDetail.share of the mesh's."""


def _materials_at_rest(asset: Asset) -> _Worn:
    mesh, gaussians = asset.mesh, asset.gaussians
    of_surfels = None if gaussians is None else Materials(gaussians.albedo, gaussians.roughness, gaussians.metallic)
    share = None if mesh.detail is None else mesh.detail.share
    return _Worn(Materials(mesh.albedo, mesh.roughness, mesh.metallic), of_surfels, share)


def _shape_at_rest(asset: Asset) -> _Shape:
    mesh, gaussians = asset.mesh, asset.gaussians
    centers, tangents = (None, None) if gaussians is None else (gaussians.centers, _rest(asset).tangents)
    return _Shape(mesh.vertices, mesh.normals, centers, tangents)


def _materials_after(asset: Asset, edits: EditSteps[MaterialEdit], files: EditFiles, go_on: Callable[[], None] | None) -> _Worn:
    mesh, gaussians = asset.mesh, asset.gaussians

    def apply(before: _Worn, index: int) -> _Worn:
        edit, of_surfels = edits.edit(index), before.of_surfels
        file = edit.select.weights_file
        weights = select_vertices(mesh, edit.select) if file is None else read_weights(files.path(file), mesh)
        if gaussians is not None and of_surfels is not None:
            of_surfels = _edited(of_surfels, edit, select_surfels(gaussians.centers, mesh, asset.binding, edit.select, weights))
        share = None if mesh.detail is None else _detail_left(before.detail_share, edit, weights)
        return _Worn(_edited(before.of_vertices, edit, weights), of_surfels, share)

    return _applied_in_turn(asset, "material", edits, _materials_at_rest(asset), apply, go_on)


def _edited(materials: Materials, edit: MaterialEdit, weights: Float[Tensor, "n"]) -> Materials:
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


def _detail_left(share: Tensor | None, edit: MaterialEdit, weights: Float[Tensor, "vertex"]) -> Tensor | None:
    """What is painted over loses its pattern; what is multiplied keeps it."""
    if edit.set.albedo is None or edit.mode == "multiply":
        return share
    return (torch.ones_like(weights) if share is None else share) * (1 - weights)


def _shape_after(asset: Asset, edits: EditSteps[ShapeEdit], files: EditFiles, go_on: Callable[[], None] | None) -> _Shape:
    def apply(before: _Shape, index: int) -> _Shape:
        edit = edits.edit(index)
        after = _deformed(asset, before, edit, edits.digest(index), files, go_on)
        if not all(torch.isfinite(values).all() for values in vars(after).values() if isinstance(values, Tensor)):
            raise ValueError(f"the {edit.op} edit {edit.model_dump_json()[:120]} moves parts of this object to infinity")
        return after

    return _applied_in_turn(asset, "shape", edits, _shape_at_rest(asset), apply, go_on)


def _deformed(
    asset: Asset, before: _Shape, edit: ShapeEdit, digest_before: bytes, files: EditFiles, go_on: Callable[[], None] | None
) -> _Shape:
    """
    Args:
        digest_before: of the edits that made `before`.
    """
    mesh, gaussians = asset.mesh, asset.gaussians
    vertices, normals, centers, tangents, parted = before.vertices, before.normals, before.centers, before.tangents, before.parted
    if isinstance(edit, PoseEdit | SimulateEdit):
        # Like a file of vertices, it says where everything is, whatever came before.
        frame = _moment(asset, edit, files, go_on)
        vertices, normals, centers, tangents, parted = frame.vertices, frame.normals, frame.centers, frame.tangents, frame.parted
    elif edit.map is not None:
        check_map(edit.map, vertices)
        vertices, gradient = evaluate_map(edit.map, vertices)
        normals = carry_normals(normals, gradient)
        if centers is not None and tangents is not None:
            centers, gradient = evaluate_map(edit.map, centers)
            tangents = carry_tangents(tangents, gradient)
        if parted is not None:
            parted = replace(parted, centers=evaluate_map(edit.map, parted.centers)[0])
    elif edit.vertices is not None:
        # The file says where the vertices are, whatever came before: everything is carried from rest.
        vertices = vertices_at(files.path(edit.vertices, or_folder=True), edit.time, edit.frames_per_second, mesh)
        gradient, parted = vertex_gradients(mesh.vertices, vertices, mesh.faces), None
        normals = carry_normals(mesh.normals, gradient)
        if gaussians is not None:
            if asset.binding is None:
                raise ValueError(f"{edit.vertices}: cannot deform this asset: its Gaussians are not bound to its mesh")
            rest_tangents = _rest(asset).tangents
            centers, tangents = drive_surfels(
                mesh.vertices, vertices, mesh.faces, gradient, asset.binding, gaussians.centers, rest_tangents
            )
    elif edit.handles is not None and edit.handles.drag:
        handles, places = edit.handles, [vertices, centers, None if parted is None else parted.centers]
        points, sizes = torch.cat([part for part in places if part is not None]), [0 if part is None else len(part) for part in places]
        from drgs.deform.displace.hold_handles import HeldObject

        # What is held is prepared once for all targets that a drag passes through.
        grips = ("handles", digest_before, _text_of_grips(edit))
        hold = partial(HeldObject, mesh.vertices, vertices, mesh.faces, handles, points)
        held: HeldObject = _remembered(asset, grips, hold)
        positions, gradient = held.pull(handles)
        (vertices, of_centers, of_grains), turned = positions.split(sizes), gradient.split(sizes)
        vertices, normals = vertices.contiguous(), carry_normals(normals, turned[0])
        if centers is not None and tangents is not None:
            centers, tangents = of_centers.contiguous(), carry_tangents(tangents, turned[1])
        if parted is not None:
            parted = replace(parted, centers=of_grains.contiguous())
    return _Shape(vertices, normals, centers, tangents, parted)


def _moment(asset: Asset, edit: PoseEdit | SimulateEdit, files: EditFiles, go_on: Callable[[], None] | None) -> ClipFrame:
    """What a clip, a rig or a simulation shows at the edit's time; at rest, the asset's own tensors."""
    centers, tangents = (None, None) if asset.gaussians is None else (asset.gaussians.centers, _rest(asset).tangents)
    rest = ClipFrame(asset.mesh.vertices, asset.mesh.normals, centers, tangents)
    if isinstance(edit, SimulateEdit):
        from drgs.deform.matter.simulation_scene import parse_simulation_scene

        scene = parse_simulation_scene(edit.scene)
        if edit.time == 0:
            return rest
        from drgs.deform.matter.simulate import Simulation

        scene_key = ("simulation", scene.model_dump_json(), *map(files.stamp, file_names(edit)))
        simulation = _remembered(asset, scene_key, lambda: Simulation(asset, scene, lambda name: files.path(name, or_folder=True), go_on))
        frame = simulation.at(edit.time, go_on)
    elif (rig := split_rig_clip(edit.clip)) is not None:
        from drgs.deform.rig.rig_clip import bind_rig

        rig_key = ("rig", files.stamp(rig[0]), edit.model_dump_json(exclude={"time"}))
        bound = _remembered(asset, rig_key, lambda: bind_rig(files.path(rig[0]), rig[1], asset, rest, edit.rig))
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
        if frame.parted is not None and len(frame.parted.cut) != len(asset.mesh.faces):
            raise ValueError(
                f"the clip {edit.clip} was made for another object: it has {len(frame.parted.cut)} faces, this one {len(asset.mesh.faces)}"
            )
    return frame


def _environment(asset: Asset, name: str, files: EditFiles, environments: Callable[[str], Environment] | None) -> Environment:
    if environments is not None:
        return environments(name)
    device = asset.environment.radiance.device

    def load() -> Environment:
        return Environment(load_environment(files.path(name)).radiance.to(device))

    return _remembered(asset, ("environment", files.stamp(name)), load)


def _text_of_grips(edit: DeformEdit) -> str:
    """What is held, whatever the targets."""
    return edit.model_dump_json(exclude={"handles": {"drag": {"__all__": {"target", "turn"}}}})


def _is_optimised(asset: Asset) -> bool:
    columns = [*vars(asset.gaussians).values()] if asset.gaussians is not None else []
    return any(value.requires_grad for value in [*columns, *asset.mesh.columns.values()])


def _applied_in_turn(
    asset: Asset, kind: str, edits: EditSteps, first: Result, apply: Callable[[Result, int], Result], go_on: Callable[[], None] | None
) -> Result:
    """What edits make of `first`, one after the other. One edit more on a long list costs one edit, and so do a few less.

    Args:
        apply: the result of edit number `index` on what those before it have made.
    """
    if edits.count == 0:
        return first

    def make() -> Result:
        done, result = _longest_remembered(asset, kind, edits, first)
        for index in range(done, edits.count):
            if go_on is not None:
                go_on()
            result = apply(result, index)
            if (index + 1) % CHECKPOINT == 0:
                result = _remembered(asset, _key(kind + CHECKPOINTS, edits, index + 1), _constant(result))
        return result

    return _remembered(asset, _key(kind, edits), make)


def _key(kind: str, edits: EditSteps, count: int | None = None) -> tuple[str, int, bytes]:
    """Of what the first edits, all where None, have made."""
    count = edits.count if count is None else count
    return kind, count, edits.digest(count)


def _constant(value: Result) -> Callable[[], Result]:
    return lambda: value


def _longest_remembered(asset: Asset, kind: str, edits: EditSteps, first: Result) -> tuple[int, Result]:
    """How many of the first edits are those of a result that is remembered, and that; or 0 and `first`."""
    if _is_optimised(asset):
        return 0, first
    with _lock:
        kept = _memory.get(asset, OrderedDict())
        alike = [key for key in kept if key[0] in (kind, kind + CHECKPOINTS) and key[1] <= edits.count]
        longest = max((key for key in alike if key[2] == edits.digest(key[1])), key=lambda key: key[1], default=None)
        return (0, first) if longest is None else (longest[1], kept[longest])


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
