"""LPIPS of the tables' cells, from the pictures that they left: nothing is built or drawn for it.

In: a finished cell, and the network (benchmarks/measures/lpips.py). Out: the same cell with LPIPS among its figures, kept as a cell of its own. Pictures
count as the cell's while their PSNR is the one it has; where they are gone, or are of another run, the cell says that it lacks LPIPS.
"""

from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from benchmarks.measures.lpips import LpipsNetwork, lpips
from benchmarks.paper.cells import NotMade
from benchmarks.paper.tables import SceneEvidence, drawn_cameras
from benchmarks.paper.variant import AbstractVariant
from benchmarks.scenes.bench_scene import read_rgba
from drgs.evaluate.metrics import light_scale, on_white, psnr, scale_light

SAME_PSNR = 1e-6
"""[dB] by which figures of the same pictures may differ."""


def with_lpips(evidence: SceneEvidence, variant: AbstractVariant, kind: Literal["static", "deformed"], cell: dict) -> dict:
    """The cell with "lpips" (and "lpips_scaled" under a new light) in its figures, and under "lpips" what made it; as it is where none is asked."""
    network = evidence.lpips
    if network is None:
        return cell
    at_rest = kind == "static"
    figures = {Path("test"): cell["figures"]} if at_rest else {Path("deform", name): own for name, own in cell["figures"].items()}

    def make() -> dict:
        return {"figures": {str(folder): folder_lpips(evidence, variant, network, folder, own) for folder, own in figures.items()}}

    asked = {"network": network.source, "of": cell["figures"]}
    # Whoever makes nothing has pictures that are finished, and asks for their LPIPS.
    cells = replace(evidence.cells, finished_only=False)
    with suppress(NotMade):
        found = cells.cell(f"{evidence.scene.name}-{variant.name}-{kind}-lpips", asked, make)
        more = [own | found["figures"][str(folder)] for folder, own in figures.items()]
        merged = more[0] if at_rest else dict(zip(cell["figures"], more, strict=True))
        return cell | {"figures": merged, "lpips": {"network": network.source, "made": found["made"]}}
    return cell | {"lpips": None}


def folder_lpips(evidence: SceneEvidence, variant: AbstractVariant, network: LpipsNetwork, folder: Path, figures: dict) -> dict:
    """Means over a folder's pictures on white.

    Raises:
        NotMade: they are gone, or they are not those of the figures.
    """
    out, truth = evidence.pictures(variant) / folder, evidence.scene.folder / folder
    names = [f"{camera.name}.png" for camera in drawn_cameras(evidence, folder)]
    if not all((out / name).is_file() for name in names):
        raise NotMade(str(out))
    pairs = [(read_rgba(out / name), read_rgba(truth / name)) for name in names]
    white = [(on_white(ours), on_white(true)) for ours, true in pairs]
    if abs(float(np.mean([psnr(*pair) for pair in white])) - figures["psnr"]) > SAME_PSNR:
        raise NotMade(str(out))
    found = {"lpips": float(np.mean([lpips(network, *pair) for pair in white]))}
    if "psnr_scaled" in figures:
        scale = light_scale(pairs)
        scaled = [on_white(scale_light(ours, scale)) for ours, _ in pairs]
        found["lpips_scaled"] = float(np.mean([lpips(network, ours, true) for ours, (_, true) in zip(scaled, white, strict=True)]))
    return found
