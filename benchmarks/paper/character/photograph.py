"""A capture of the character at rest: photographs under one light, test views under that and another, and the rig that it dances by.

In: a folder, and how much is spent. Out: the layout of the scenes in shared/bench (draw_scene writes it), with character.glb, and in scene.json which
animation, under which light, is to be shown, and who drew it: our own renderer, or Mitsuba, of which nothing is ours. Lights are those of
examples/environments, painted by formulas as well.
"""

import json
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from benchmarks.paper.character.rigged_glb import CELL, CLIP, write_character
from benchmarks.reconstruct.draw_scene import Drawing, Renderer, draw_scene
from drgs.convert.import_mesh import import_mesh

NAME = "character"
FILE = f"{NAME}.glb"
ENVIRONMENTS = Path(__file__).parents[3] / "examples" / "environments"
LIGHT, NEW_LIGHT = "sunset", "studio"
"""Of the photographs, and of the dance."""
DISTANCE = 4.0
"""Of cameras from the origin [world units]."""
FIELD_OF_VIEW = 0.5
"""[rad]; with its arms up the character still fits."""
TRAINING_VIEWS, TEST_VIEWS = 64, 12
LOWEST, HIGHEST = -0.6, 0.95
"""Sines of the elevations that photographs are taken from."""
TEST_ELEVATIONS = (12.0, 35.0, -10.0)
"""In turn [degrees]."""
TEST_START = -75.0
"""Azimuth of the first test view, which looks into its face [degrees]."""
GOLDEN_TURN = np.pi * (3 - 5**0.5)


@dataclass(frozen=True)
class CaptureSettings:
    """How much is spent."""

    side: int = 400
    """Of pictures [pixels]."""
    samples: int = 64
    """Rays a pixel of a photograph; test pictures have twice as many."""
    cell: float = CELL
    """Of the grid that the body is modelled with [world units]."""
    views: int = TRAINING_VIEWS
    renderer: Renderer = "ours"


def photograph(out: Path, settings: CaptureSettings) -> None:
    """Write the capture in place of what is there; a kill leaves none, or a whole one.

    Raises:
        ValueError: the cells are too wide.
    """
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=f".{out.name}.") as folder:
        stage, made = Path(folder) / "cameras", Path(folder) / NAME
        stage.mkdir()
        write_cameras(stage / "transforms_train.json", "train", photograph_directions(settings.views), settings.side)
        write_cameras(stage / "transforms_test.json", "test", test_directions(), settings.side)
        write_character(Path(folder) / FILE, settings.cell)
        light, new_light = (ENVIRONMENTS / f"{name}.exr" for name in (LIGHT, NEW_LIGHT))
        # The very mesh that whoever imports the file gets.
        drawing = Drawing(settings.samples, renderer=settings.renderer)
        draw_scene(stage, made, None, light, new_light, drawing, import_mesh(Path(folder) / FILE).mesh)
        shutil.copy(Path(folder) / FILE, made)
        rig = {"file": FILE, "clip": CLIP, "light": NEW_LIGHT, "renderer": settings.renderer}
        facts = json.loads((made / "scene.json").read_text()) | {"rig": rig}
        (made / "scene.json").write_text(json.dumps(facts))
        if out.exists():
            shutil.rmtree(out)
        made.rename(out)


def photograph_directions(count: int) -> Float[ndarray, "view 3"]:
    """Towards cameras around the object, evenly over the sphere between two elevations."""
    z = LOWEST + (HIGHEST - LOWEST) * (np.arange(count) + 0.5) / count
    azimuth = GOLDEN_TURN * np.arange(count)
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], -1)


def test_directions() -> Float[ndarray, "view 3"]:
    """Towards the test cameras, once around."""
    places = np.arange(TEST_VIEWS)
    azimuth = np.radians(TEST_START + 360 * places / TEST_VIEWS)
    elevation = np.radians(np.resize(TEST_ELEVATIONS, TEST_VIEWS))
    return np.stack([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)], -1)


test_directions.__test__ = False  # type: ignore[attr-defined]  # pytest collects by name


def write_cameras(path: Path, folder: str, directions: Float[ndarray, "view 3"], side: int) -> None:
    """A file of cameras in NeRF-synthetic's layout that look at the origin; their pictures are r_000.png and so on in `folder`."""
    frames = []
    for place, direction in enumerate(directions):
        right = np.cross([0.0, 0.0, 1.0], direction)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3] = np.stack([right, np.cross(direction, right), direction, DISTANCE * direction], -1)
        frames.append({"file_path": f"./{folder}/r_{place:03d}", "transform_matrix": pose.tolist()})
    path.write_text(json.dumps({"camera_angle_x": FIELD_OF_VIEW, "w": side, "h": side, "frames": frames}))
