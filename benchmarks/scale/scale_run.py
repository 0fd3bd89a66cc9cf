"""What a curve is told: sizes, repetitions, and the files of the user's that it may look at."""

from dataclasses import dataclass, field
from pathlib import Path

import torch


@dataclass(frozen=True)
class ScaleSizes:
    """Of each curve's points, by its name, and of what stays the same along it. Tests take small ones."""

    pixels: tuple[int, ...] = (200, 283, 400, 566, 800)
    """Sides of square pictures; each has twice the pixels of the one before."""
    faces: tuple[int, ...] = (10_000, 30_000, 100_000, 300_000, 1_000_000)
    surfels: tuple[int, ...] = (10_000, 25_000, 50_000, 100_000, 200_000)
    samples: tuple[int, ...] = (8, 32, 128, 512)
    """Rays a pixel of a still picture."""
    edits: tuple[int, ...] = (10, 100, 1_000, 10_000)
    """In force."""
    assets: tuple[int, ...] = (1, 2, 4, 8)
    """Open in one server."""
    builds: tuple[int, ...] = (16, 32, 64)
    """Photographs."""
    builds_pixels: tuple[int, ...] = (100, 200, 400)
    """Sides of the photographs."""

    object_faces: int = 100_000
    """Of the made object, where faces are not what grows."""
    faces_side: int = 400
    """Of pictures whose faces grow [pixels]."""
    samples_side: int = 200
    """Of pictures whose rays grow [pixels]."""
    asset_faces: int = 60_000
    """Of each asset that a server opens."""
    moving_frames: int = 8
    """Pictures of a moving camera a repetition."""
    edits_measured: int = 8
    """At each number of edits in force, a repetition."""


@dataclass(frozen=True)
class ScaleRun:
    """One call of the benchmark."""

    folder: Path
    """For files that are gone afterwards."""
    sizes: ScaleSizes = field(default_factory=ScaleSizes)
    repeats: int = 3
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))
    asset: Path | None = None
    """What pictures show; None: a made object."""
    scene: Path | None = None
    """Of builds."""
    preset: str | None = None
    """Of builds; None: draft, and their photographs' size is not varied."""
