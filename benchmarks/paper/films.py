"""Pictures as films that can be shown over and over: a deformation there, and back by the same pictures, so that nothing jumps; or a clip as it is.

In: pictures, of a deformation those of the way there. Out: an MP4 (H.264).
"""

import math
import tempfile
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from PIL import Image

from benchmarks.paper.sheets import Array
from drgs_worker.jobs.write_video import write_video

FPS = 24
WAY_THERE = 25
"""Pictures of the way there, with the first and the last: forth and back take two seconds."""


def shares() -> list[float]:
    """How much of the deformation each picture of the way there has, 0..1: slowly from rest, and slowly to the end."""
    return [0.5 - 0.5 * math.cos(math.pi * place / (WAY_THERE - 1)) for place in range(WAY_THERE)]


def write_film(pictures: Iterable[Array], path: Path, back: bool = True) -> None:
    """
    Args:
        pictures: (height, width, 3) sRGB 0..1, all of one size. An odd last row or column is left out.
        back: they are the way there, and the way back follows.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        files = []
        for place, picture in enumerate(pictures):
            files.append(Path(folder) / f"{place:04d}.png")
            Image.fromarray((picture.clip(0, 1) * 255).round().astype(np.uint8)).save(files[-1])
        write_video([*files, *(files[-2:0:-1] if back else [])], path, FPS)
