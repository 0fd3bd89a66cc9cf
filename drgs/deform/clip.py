"""Baked motion: a folder of frames with what a posed scene needs of an asset's shape, to be played, scrubbed and relit.

clip.json names the format, the frames' rate and count, and the asset's counts; frame_00000.safetensors and so on hold float32 arrays
vertices, normals, and for an asset with Gaussians centers and tangents; of frames in which matter has come apart also what Parted holds, as
parted.centers and so on. Writing is atomic; a clip of another asset is refused.
"""

import json
import math
import os
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path

import safetensors
import safetensors.torch
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

FORMAT, VERSION = "drgs clip", 1
MOST_FRAMES = 100_000
MANIFEST = "clip.json"
MAKING = ".making"
"""Ends the name of a folder where a clip grows frame by frame, beside its place: it can be read at any time, up to the newest frame."""


PARTED = "parted."
"""Before the names of Parted's arrays, in a frame's file."""


@dataclass(frozen=True, eq=False)
class Parted:
    """Matter that has come apart: faces that are not shown, and particles that are, each as a grain."""

    centers: Float[Tensor, "grain 3"]
    """World; also of grains that are not shown."""
    volumes: Float[Tensor, "grain"]
    """World units cubed."""
    vertex: Int[Tensor, "grain"]
    """The asset's vertex whose material the grain has."""
    shown: Bool[Tensor, "grain"]
    cut: Bool[Tensor, "face"]
    """Of the asset's mesh."""
    gone: Bool[Tensor, "surfel"] | None
    """Of the asset's surfels: a grain stands in its place. None for an asset without."""


@dataclass(frozen=True, eq=False)
class ClipFrame:
    """Where an asset's parts are at one time."""

    vertices: Float[Tensor, "vertex 3"]
    """World."""
    normals: Float[Tensor, "vertex 3"]
    """Unit."""
    centers: Float[Tensor, "surfel 3"] | None
    tangents: Float[Tensor, "surfel 3 2"] | None
    parted: Parted | None = None
    """None: everything hangs together."""

    @property
    def arrays(self) -> dict[str, Tensor]:
        """What there is, by its name in a file."""
        own = {name: values for name, values in vars(self).items() if isinstance(values, Tensor)}
        return own | {PARTED + name: values for name, values in vars(self.parted).items() if values is not None} if self.parted else own


@dataclass(frozen=True)
class Clip:
    """A clip on disk; frames are read when they are asked for."""

    folder: Path
    fps: float
    frame_count: int
    vertices: int
    surfels: int
    """0 for an asset without Gaussians."""

    @property
    def duration(self) -> float:
        """Seconds from the first frame to the last."""
        return (self.frame_count - 1) / self.fps


def blend_frames(first: ClipFrame, second: ClipFrame, share: float) -> ClipFrame:
    """Between two frames: `share` of the second. Where both hold the same tensor, it stays the same.

    What has parted in either is parted; before the first frame in which anything has, the mesh is whole.
    """

    def mix(a: Tensor | None, b: Tensor | None) -> Tensor | None:
        return a if a is b or a is None or b is None else torch.lerp(a, b, share)

    vertices, normals = mix(first.vertices, second.vertices), mix(first.normals, second.normals)
    assert vertices is not None and normals is not None
    if normals is not first.normals:
        normals = torch.nn.functional.normalize(normals, dim=-1, eps=1e-20)
    return ClipFrame(
        vertices,
        normals,
        mix(first.centers, second.centers),
        mix(first.tangents, second.tangents),
        _blend_parted(first.parted, second.parted, share),
    )


def _blend_parted(first: Parted | None, second: Parted | None, share: float) -> Parted | None:
    if first is None or second is None or first is second:
        return first if first is second else None
    gone = None if first.gone is None or second.gone is None else first.gone | second.gone
    centers = torch.lerp(first.centers, second.centers, share)
    return replace(first, centers=centers, shown=first.shown | second.shown, cut=first.cut | second.cut, gone=gone)


def save_clip(folder: Path, frames: list[ClipFrame], fps: float, details: dict) -> None:
    """Write frames to a new folder, or in place of another clip.

    Raises:
        ValueError: the path is taken by something that is no clip.
    """
    folder = Path(folder)
    if folder.exists() and not (folder / MANIFEST).is_file() and (not folder.is_dir() or any(folder.iterdir())):
        raise ValueError(f"{folder}: exists, and is no clip")
    folder.parent.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
    try:
        for index, frame in enumerate(frames):
            arrays = {name: value.detach().cpu().contiguous() for name, value in frame.arrays.items()}
            # Two tensors of one frame never share memory, which the format would refuse.
            safetensors.torch.save_file(arrays, partial / _name(index))
        write_manifest(partial, frames[0], len(frames), fps, details)
        os.chmod(partial, 0o755)
        if folder.exists():
            shutil.rmtree(folder)
        os.replace(partial, folder)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise


def write_manifest(folder: Path, first: ClipFrame, frames: int, fps: float, details: dict) -> None:
    """Say what lies in a folder of frames; whoever reads it meanwhile finds the old words or the new ones.

    Args:
        first: frame 0.
        frames: how many there are.
    """
    counts = {"vertices": len(first.vertices), "surfels": 0 if first.centers is None else len(first.centers)}
    manifest = {"format": FORMAT, "version": VERSION, "fps": fps, "frames": frames, "counts": counts} | details
    draft = folder / f"{MANIFEST}.part"
    draft.write_text(json.dumps(manifest, indent=1))
    os.replace(draft, folder / MANIFEST)


def growing_clip(folder: Path) -> Path:
    """Where the clip of a folder is while it is being made."""
    return folder.with_name(folder.name + MAKING)


def open_clip(folder: Path) -> Clip:
    """Read a clip's manifest.

    Raises:
        ValueError: one sentence: no clip, or a damaged or newer one.
    """
    try:
        manifest = json.loads((Path(folder) / MANIFEST).read_text())
        if manifest["format"] != FORMAT:
            raise ValueError(f"its format is {manifest['format']!r}")
        if manifest["version"] > VERSION:
            raise ValueError(f"it has version {manifest['version']}; this program reads up to {VERSION}")
        fps, frames = float(manifest["fps"]), int(manifest["frames"])
        if not (0 < fps < math.inf and 1 <= frames <= MOST_FRAMES):
            raise ValueError(f"it has {frames} frames at {fps} a second")
        return Clip(Path(folder), fps, frames, int(manifest["counts"]["vertices"]), int(manifest["counts"]["surfels"]))
    except (OSError, KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        raise ValueError(f"{folder}: is not a readable clip ({error})") from error


def read_frame(clip: Clip, index: int, device: torch.device | str = "cpu") -> ClipFrame:
    """One frame.

    Raises:
        ValueError: missing, damaged, of other sizes, or with values that are not finite.
    """
    path = clip.folder / _name(min(max(index, 0), clip.frame_count - 1))
    shapes: dict[str, tuple[int, ...]] = {"vertices": (clip.vertices, 3), "normals": (clip.vertices, 3)}
    if clip.surfels:
        shapes |= {"centers": (clip.surfels, 3), "tangents": (clip.surfels, 3, 2)}
    try:
        arrays = safetensors.torch.load_file(path)
    except (OSError, safetensors.SafetensorError) as error:
        raise ValueError(f"{path}: is not a readable frame ({error})") from error
    for name, shape in shapes.items():
        values = arrays.get(name)
        if values is None or tuple(values.shape) != shape or values.dtype != torch.float32:
            found = None if values is None else (tuple(values.shape), str(values.dtype))
            raise ValueError(f"{path}: {name} is {found}; expected {shape} of float32")
        if not torch.isfinite(values).all():
            raise ValueError(f"{path}: {name} holds values that are not finite")
    try:
        parted = parted_of_arrays(arrays, clip.vertices, clip.surfels)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    if parted is not None:
        parted = replace(parted, **{name: values.to(device) for name, values in vars(parted).items() if values is not None})
    vertices, normals = arrays["vertices"].to(device), arrays["normals"].to(device)
    if not clip.surfels:
        return ClipFrame(vertices, normals, None, None, parted)
    return ClipFrame(vertices, normals, arrays["centers"].to(device), arrays["tangents"].to(device), parted)


def parted_of_arrays(arrays: Mapping[str, Tensor], vertices: int, surfels: int) -> Parted | None:
    """What a frame's file holds of matter that has parted; None where it holds nothing of it.

    Args:
        vertices, surfels: how many the asset has.

    Raises:
        ValueError: arrays are missing, of other sizes or kinds, or not finite.
    """
    if PARTED + "centers" not in arrays:
        return None
    grains, one = len(arrays[PARTED + "centers"]), (torch.float32, torch.int64, torch.bool)
    wanted = {"centers": ((grains, 3), one[0]), "volumes": ((grains,), one[0]), "vertex": ((grains,), one[1]), "shown": ((grains,), one[2])}
    wanted |= {"gone": ((surfels,), one[2])} if surfels else {}
    found = {name: arrays.get(PARTED + name) for name in [field.name for field in fields(Parted)]}
    for name, (shape, kind) in wanted.items():
        values = found[name]
        if values is None or tuple(values.shape) != shape or values.dtype != kind:
            raise ValueError(
                f"{PARTED}{name} is {None if values is None else (tuple(values.shape), str(values.dtype))}; expected {shape} of {kind}"
            )
    centers, volumes, vertex, cut = (found[name] for name in ("centers", "volumes", "vertex", "cut"))
    assert centers is not None and volumes is not None and vertex is not None
    if cut is None or cut.ndim != 1 or cut.dtype != torch.bool:
        raise ValueError(f"{PARTED}cut is missing or no row of truths; expected one for each face")
    if not (torch.isfinite(centers).all() and torch.isfinite(volumes).all() and (volumes >= 0).all()):
        raise ValueError(f"{PARTED}centers and {PARTED}volumes hold values that are not finite, or below zero")
    if grains and not 0 <= int(vertex.min()) <= int(vertex.max()) < vertices:
        raise ValueError(
            f"{PARTED}vertex names vertices {int(vertex.min())} to {int(vertex.max())}; the mesh has {vertices}, counted from 0"
        )
    return Parted(**found)  # type: ignore[arg-type]


def frame_at(clip: Clip, seconds: float, device: torch.device | str = "cpu") -> ClipFrame:
    """What a clip shows at a time; its last frame after its end."""
    position = min(max(seconds, 0.0) * clip.fps, clip.frame_count - 1)
    first = math.floor(position + 1e-6)
    share = position - first
    frame = read_frame(clip, first, device)
    return frame if share <= 1e-6 else blend_frames(frame, read_frame(clip, first + 1, device), share)


def _name(index: int) -> str:
    return f"frame_{index:05d}.safetensors"
