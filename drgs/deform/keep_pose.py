"""What a long list of edits has made of an asset so far, as a file, so that who opens the list again need not apply all of it.

The file is a cache: one that is missing, damaged or of other edits is as good as none. It holds the results behind PosedScene, to the bit, and
digests of the edits that made them.
"""

import os
from collections.abc import Sequence
from pathlib import Path

import safetensors
import safetensors.torch
import torch
from torch import Tensor

from drgs.deform.pose_scene import PoseParts, known_parts, remember_parts
from drgs.deform.sort_edits import EditFiles, SortedEdits, sort_edits
from drgs.scene.asset import Asset
from drgs.scene.edits import Edit

KINDS = ("material", "shape")
"""Of edits that change tensors."""


def save_pose(asset: Asset, edits: Sequence[Edit], path: Path, base_directory: Path | None = None) -> bool:
    """Write what was made of these edits, which pose_scene must have posed a moment ago; returns whether it was still known.

    Args:
        base_directory: as of pose_scene.

    Raises:
        OSError: it cannot be written; an older file stays.
        ValueError: a file that an edit names is missing.
    """
    by_kind = sort_edits(asset, edits, EditFiles(base_directory, confine=False))
    parts = known_parts(asset, by_kind)
    if parts is None:
        return False
    said = _said(by_kind, {"material": by_kind.material.count, "shape": by_kind.shape.count})
    arrays = {name: values.detach().cpu().contiguous() for name, values in parts.items()}
    draft = path.with_suffix(".new")
    draft.write_bytes(safetensors.torch.save(arrays, said))
    os.replace(draft, path)
    return True


def recall_pose(asset: Asset, edits: Sequence[Edit], path: Path, base_directory: Path | None = None) -> int:
    """Let pose_scene go on from a file of save_pose; returns how many of the edits need not be applied any more."""
    device = asset.mesh.vertices.device
    try:
        by_kind = sort_edits(asset, edits, EditFiles(base_directory, confine=False))
        with safetensors.safe_open(path, framework="pt") as file:
            said = file.metadata() or {}
            counts = {kind: int(said[kind].split()[0]) for kind in KINDS}
            if any(not 0 <= count <= getattr(by_kind, kind).count for kind, count in counts.items()) or said != _said(by_kind, counts):
                return 0
            names = file.keys()  # no mapping: it cannot be gone through itself
            parts: PoseParts = {name: file.get_tensor(name).to(device) for name in names}
    except (OSError, KeyError, ValueError, IndexError, safetensors.SafetensorError):
        return 0
    if not _fits(asset, parts):
        return 0
    remember_parts(asset, counts, by_kind, parts)
    return sum(counts.values())


def _fits(asset: Asset, parts: dict[str, Tensor]) -> bool:
    """Whether the arrays are this object's, finite, and all there."""
    sizes = {"mesh": len(asset.mesh.vertices), "surfel": 0 if asset.gaussians is None else len(asset.gaussians.centers)}
    tails = {"albedo": (3,), "roughness": (), "metallic": (), "vertices": (3,), "normals": (3,), "centers": (3,), "tangents": (3, 2)}
    tails |= {"detail_share": ()}
    wanted = {f"mesh.{name}" for name in ("albedo", "roughness", "metallic", "vertices", "normals")}
    wanted |= {f"surfel.{name}" for name in ("albedo", "roughness", "metallic", "centers", "tangents")} if sizes["surfel"] else set()
    # All of a detail is worn where nothing was painted over.
    optional = set() if asset.mesh.detail is None else {"mesh.detail_share"}
    if set(parts) - optional != wanted:
        return False
    return all(
        values.shape == (sizes[name.split(".")[0]], *tails[name.split(".")[1]])
        and values.dtype == torch.float32
        and bool(values.isfinite().all())
        for name, values in parts.items()
    )


def _said(by_kind: SortedEdits, counts: dict[str, int]) -> dict[str, str]:
    """What the file says of the edits that made it: how many of each kind, and their digest."""
    return {kind: f"{counts[kind]} {getattr(by_kind, kind).digest(counts[kind]).hex()}" for kind in KINDS}
