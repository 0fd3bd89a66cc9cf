"""The other systems' ways danced beside ours: the captured object's own mesh, moved by its skeleton, moves what each way has bound to it.

In: a dance, whose frames are drawn already (dances.py). Out: a sheet of one frame, and a row a way: how near it comes to the truth in those frames that are
drawn standing as well, after one factor a channel. Every way gets the motion of the surface's closest point, with its gradient.
"""

from pathlib import Path

import numpy as np
import torch

from benchmarks.paper.dances import HELD_EVERY, Dance, Pictures, asked_of_dance, frame_cell, posed_pair, rig_facts, scored
from benchmarks.paper.fields import field_of_moved_mesh
from benchmarks.paper.sheets import object_window, sheet
from benchmarks.paper.tables import SceneEvidence, read_bound, write_picture
from benchmarks.paper.variant import AbstractVariant, SplatVariant
from drgs.evaluate.metrics import light_scale
from drgs.scene.environment import rotate_environment

SHOWN = 7 * HELD_EVERY
"""The frame of the sheet: one leg lifted and the arms apart, under a light that is turned by more than a half."""
OURS = {"ours": "ours (M)"}


def dance_ways(evidence: SceneEvidence, variants: list[AbstractVariant], path: Path) -> dict:
    """drgs2026, Fig. 7, by the ways of its Fig. 3."""
    facts = rig_facts(evidence)
    assert facts is not None
    shown = Dance(evidence, facts)
    for place in shown.held:
        frame_cell(shown, place)
    ways = [variant for variant in variants if isinstance(variant, SplatVariant)]
    for variant in ways:
        danced_cell(shown, variant)
    rows, drawn, alphas = [], [], []
    for owner, title in ({variant.name: variant.title for variant in ways} | OURS).items():
        pairs = [shown.read_pair("dancing", place, owner) for place in shown.held]
        pictures = Pictures(shown, "dancing", light_scale(pairs), owner)
        scores = {place: scored(*pictures.on_white(place)) for place in shown.held}
        psnrs = [score.psnr for score in scores.values()]
        ssim = float(np.mean([score.ssim for score in scores.values()]))
        rows.append({"way": title, "PSNR": f"{np.mean(psnrs):.2f}", "SSIM": f"{ssim:.3f}", "worst frame": f"{min(psnrs):.2f}"})
        place = min(SHOWN, shown.held[-1])
        picture, truth = pictures.on_white(place)
        drawn.append((f"{title}, {scores[place].psnr:.1f} dB", picture))
        alphas += [rgba[..., 3] for rgba in shown.read_pair("dancing", place, owner)]
    window = object_window(alphas)
    sheet([[(title, picture[window]) for title, picture in [("truth", truth), *drawn]]], path)
    return {
        "caption": f"{facts.clip} by each way, {len(shown.held)} frames, the turning light as above, after one factor a channel",
        "rows": rows,
    }


def danced_cell(shown: Dance, variant: AbstractVariant) -> dict:
    """A way's pictures, in files."""
    evidence = shown.evidence
    files = [shown.picture_path("dancing", variant.name, place) for place in shown.held]

    def make() -> dict:
        bound, rest = read_bound(evidence, variant), evidence.subject.asset.mesh
        for place, file in zip(shown.held, files, strict=True):
            ours, _ = posed_pair(shown, "dancing", place)
            light = rotate_environment(shown.light, shown.degrees(place))
            with torch.no_grad():
                drawn = variant.pose(evidence.subject, bound, field_of_moved_mesh(rest, ours.mesh.vertices), light)
                write_picture(drawn(shown.camera), file)
        return {}

    return evidence.cells.cell(f"{evidence.scene.name}-{shown.facts.clip}-{variant.name}", asked_of_dance(evidence), make, files)
