"""A few strokes over two pictures give the masks of all; wrong ones are refused at the door."""

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from typer.testing import CliRunner

from drgs.cli import app
from drgs.evaluate.contact_sheet import GOOD
from drgs.reconstruct.build_asset import BuildSettings, build_asset
from drgs.reconstruct.capture.load_views import load_unmasked_views, load_views, read_capture
from drgs.reconstruct.capture.load_views.checks import CaptureFault
from drgs.reconstruct.capture.load_views.read_pictures import read_pictures
from drgs.reconstruct.capture.masks_by_strokes import StrokeSettings, masks_by_strokes
from drgs.reconstruct.capture.masks_by_strokes.color_shares import CELLS, cells_of, color_shares, log_odds
from drgs.reconstruct.capture.masks_by_strokes.cut_picture import cut_picture, edges_of, undecided
from drgs.reconstruct.capture.masks_by_strokes.vote_volume import Region, silhouette, vote_volume
from drgs.reconstruct.capture.open_capture import open_capture
from drgs.reconstruct.presets import PRESETS
from drgs.scene.strokes import Stroke, plain_strokes, read_strokes
from drgs.scene.views import Views
from tests.one_torch_thread import one_torch_thread  # noqa: F401
from tests.reconstruct.capture.test_find_masks import before_surroundings
from tests.reconstruct.test_build_asset import WITHOUT_HOLLOWS
from tests.reconstruct.tiny_capture import (
    FEW_VIEWS,
    HEIGHT,
    SPHERE_CENTER,
    SPHERE_RADIUS,
    WIDTH,
    TinyView,
    sphere_views,
    write_nerf_synthetic,
)

VIEW_COUNT, STROKED = 14, (3, 9)
STROKED_OF_FEW = (2, 6)
COARSE = StrokeSettings(rounds=tuple(dataclasses.replace(step, cells=step.cells * 3 // 5) for step in StrokeSettings().rounds))
"""Volumes with cells as fine as pictures this small can tell: nearly all of the time is theirs."""
BLUE = np.array([0.2, 0.5, 0.9])
"""Of the surroundings, so that their colours are few of the ball's."""


def before_blue(view: TinyView) -> TinyView:
    """The ball before stripes of dark to light blue that turn with the direction; no alpha."""
    alpha = view.rgba[..., 3:] / 255
    grey = before_surroundings(view).rgba.mean(-1, keepdims=True) * np.ones(3)
    picture = view.rgba[..., :3] * alpha + grey * BLUE * (1 - alpha)
    return TinyView(view.name, np.round(picture).astype(np.uint8), view.camera_from_world)


def photographed(folder: Path, count: int) -> Path:
    return write_nerf_synthetic(folder, [before_blue(view) for view in sphere_views(count, square=True)])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return photographed(tmp_path_factory.mktemp("stroked"), VIEW_COUNT)


@pytest.fixture(scope="module")
def few(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """For what goes through programs, which know no coarser settings."""
    return photographed(tmp_path_factory.mktemp("few"), FEW_VIEWS)


@pytest.fixture(scope="module")
def views(folder: Path) -> Views:
    return read_pictures(read_capture(folder), None)


@pytest.fixture(scope="module")
def truth() -> torch.Tensor:
    return torch.from_numpy(np.stack([view.rgba[..., 3] for view in sphere_views(VIEW_COUNT, square=True)])) > 127


def strokes_over(views: Views, stroked: tuple[int, int] = STROKED) -> list[Stroke]:
    """A cross over the ball's middle and a frame near the picture's edge, in two pictures."""
    strokes = []
    for number in stroked:
        camera = views.cameras[number]
        place = camera.camera_from_world.double().numpy() @ np.append(SPHERE_CENTER, 1)
        x, y = (place[:2] / place[2] * camera.intrinsics[0, 0].item() + [WIDTH / 2, HEIGHT / 2]) / [WIDTH, HEIGHT]
        cross = [(x - 0.12, y), (x + 0.12, y), (x, y), (x, y - 0.12), (x, y + 0.12)]
        frame = [(0.04, 0.05), (0.96, 0.05), (0.96, 0.95), (0.04, 0.95), (0.04, 0.05)]
        strokes.append(Stroke(picture=camera.name, shows="object", radius=0.02, points=cross))
        strokes.append(Stroke(picture=camera.name, shows="background", radius=0.02, points=frame))
    return strokes


def agreement(views: Views, truth: torch.Tensor) -> torch.Tensor:
    """Intersection over union of each view."""
    masks = torch.stack(views.coverage) > 127
    return (masks & truth).sum((1, 2)) / (masks | truth).sum((1, 2))


@pytest.mark.slow
def test_strokes_in_two_pictures_mask_all(views: Views, truth: torch.Tensor) -> None:
    told: list[float] = []
    found = masks_by_strokes(views, strokes_over(views), COARSE, report=told.append)
    assert found is not None and found.has_masks and found.cameras == views.cameras
    same = agreement(found, truth)
    assert float(same.mean()) > 0.9 and float(same.min()) > 0.8
    assert told == sorted(told) and told[0] >= 0 and told[-1] <= 1
    again = masks_by_strokes(views, strokes_over(views), COARSE)
    assert again is not None and all(torch.equal(a, b) for a, b in zip(found.coverage, again.coverage, strict=True)), "the same bits"


def test_a_caller_that_stops_gets_nothing(views: Views) -> None:
    assert masks_by_strokes(views, strokes_over(views), should_stop=lambda: True) is None


@pytest.mark.slow
def test_what_was_stroked_is_what_it_was_stroked_as(views: Views) -> None:
    """Even against all colours and all other pictures."""
    corner = Stroke(picture=views.cameras[3].name, shows="object", radius=0.05, points=[(0.06, 0.5)])
    found = masks_by_strokes(views, [*strokes_over(views), corner], COARSE)
    assert found is not None
    assert int(found.coverage[3][HEIGHT // 2, round(0.06 * WIDTH)]) > 127


def test_masks_of_the_capture_leave_the_pictures_for_strokes_whole(views: Views, folder: Path, tmp_path: Path) -> None:
    """Shrunken with their masks, pictures lose what is outside."""
    masked = tmp_path / "masked"
    shutil.copytree(folder, masked)
    (masked / "masks").mkdir()
    for camera in views.cameras:
        Image.fromarray(np.eye(HEIGHT, WIDTH, dtype=np.uint8) * 255).save(masked / "masks" / f"{camera.name}.png")
    seen: list[Views] = []
    _, opened, _ = open_capture(folder, 36, 100, 0, masked=lambda given: seen.append(given) or given)
    open_capture(masked, 36, 100, 0, masked=lambda given: seen.append(given) or given)
    seen.append(load_unmasked_views(masked, 36))
    assert not opened.has_masks and not any(found.has_masks for found in seen)
    assert all(torch.equal(seen[0].images_srgb[3], other.images_srgb[3]) for other in seen)
    assert not load_views(masked, 36).images_srgb[3].equal(seen[0].images_srgb[3])


def test_strokes_that_say_too_little_are_refused(views: Views) -> None:
    over, around = strokes_over(views)[:2]
    with pytest.raises(CaptureFault, match="says what is not the object"):
        masks_by_strokes(views, [over])
    with pytest.raises(CaptureFault, match="says what the object is"):
        masks_by_strokes(views, [around])
    with pytest.raises(CaptureFault, match="called 'IMG_7', expected one of 14 names such as 'r_000'"):
        masks_by_strokes(views, [over, around.model_copy(update={"picture": "IMG_7"})])


def test_strokes_over_two_things_are_refused(views: Views) -> None:
    """Two pictures from one place, each with an object where the other has none."""
    cameras = (views.cameras[0], dataclasses.replace(views.cameras[0], name="again"), views.cameras[1])
    same = dataclasses.replace(
        views, cameras=cameras, images_srgb=(*views.images_srgb[:1] * 2, views.images_srgb[1]), coverage=views.coverage[:3]
    )
    strokes = []
    for name, here, there in (("r_000", 0.05, 0.95), ("again", 0.95, 0.05)):
        rest = [(there, 0.0), (there, 1.0), (0.5, 1.0), (0.5, 0.0), (0.4 + 0.2 * (here < 0.5), 0.5)]
        strokes.append(Stroke(picture=name, shows="background", radius=0.2, points=rest))
        strokes.append(Stroke(picture=name, shows="object", radius=0.05, points=[(here, 0.1), (here, 0.9)]))
    with pytest.raises(CaptureFault, match="at no one place in the world"):
        masks_by_strokes(same, strokes)


def test_strokes_go_through_a_file(tmp_path: Path, views: Views) -> None:
    file = tmp_path / "strokes.json"
    strokes = tuple(strokes_over(views))
    file.write_text(json.dumps({"strokes": plain_strokes(strokes)}))
    assert read_strokes(file) == strokes


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("{", "no JSON"),
        ("[]", "expected a JSON object with a list `strokes`"),
        ('{"strokes": [{"picture": "a", "shows": "cat", "points": [[0, 0]]}]}', "strokes.0.shows"),
        ('{"strokes": [{"picture": "a", "shows": "object", "points": [[0, 2]]}]}', "strokes.0.points.0.1"),
        ('{"strokes": [{"picture": "a", "shows": "object", "radius": 0, "points": [[0, 1]]}]}', "strokes.0.radius"),
        ('{"strokes": [{"picture": "a", "shows": "object", "points": []}]}', "strokes.0.points"),
    ],
)
def test_a_wrong_file_is_told_by_its_place(tmp_path: Path, text: str, sentence: str) -> None:
    file = tmp_path / "strokes.json"
    file.write_text(text)
    with pytest.raises(ValueError, match="strokes") as caught:
        read_strokes(file)
    assert sentence in str(caught.value) and str(file) in str(caught.value)


def test_a_cut_follows_the_edge_between_what_is_said() -> None:
    """Only one column on either side says anything; the line between them falls where the colour changes."""
    picture = np.full((20, 30, 3), 60, np.uint8)
    picture[:, 19:] = 200
    edges = edges_of(picture, 4.0)
    cost = np.zeros((20, 30), np.float32)
    cost[:, 0], cost[:, -1] = -50, 50
    cut = undecided(edges)
    cut_picture(cut, cost, edges, 600)
    assert torch.equal(cut.value > 0.5, torch.arange(30).expand(20, -1) < 19)


def test_a_colour_that_is_only_inside_speaks_for_the_object() -> None:
    picture = np.zeros((4, 8, 3), np.uint8)
    picture[:, :4], picture[:, 4:] = (200, 30, 30), (30, 30, 200)
    cells = cells_of(picture)
    inside, around = (
        color_shares([(cells, chosen)]) for chosen in (np.arange(32).reshape(4, 8) % 8 < 4, np.arange(32).reshape(4, 8) % 8 >= 4)
    )
    assert inside.sum() == pytest.approx(1, abs=1e-5) and len(inside) == CELLS
    odds = log_odds(inside, around, 0.05, 0.05, 3.0)
    assert (odds[cells][:, :4] == 3).all() and (odds[cells][:, 4:] == -3).all()
    assert abs(odds[cells_of(np.full((1, 1, 3), 128, np.uint8))]).item() < 1e-5, "a colour that nobody met says nothing"


def test_a_ball_is_voted_for_and_covers_its_masks(views: Views, truth: torch.Tensor) -> None:
    masks = [mask.float() for mask in truth]
    region = Region(SPHERE_CENTER - 1.0, SPHERE_CENTER + 1.0, 64)
    volume = vote_volume(region, views.cameras, masks, 0.02)
    assert volume is not None
    away = np.linalg.norm(volume.centers.numpy() - SPHERE_CENTER, axis=1)
    assert away.max() < SPHERE_RADIUS + 0.1 and volume.size == pytest.approx(4 / 3 * np.pi * SPHERE_RADIUS**3, rel=0.25)
    seen = torch.from_numpy(silhouette(volume, views.cameras[5]).covers)
    assert float((seen & truth[5]).sum() / (seen | truth[5]).sum()) > 0.85
    # One picture that says no to everything is outvoted where one in twenty may, and not where none may.
    masks[7] = torch.zeros_like(masks[7])
    outvoted = vote_volume(region, views.cameras, masks, 0.08)
    assert outvoted is not None and outvoted.size > 0.9 * volume.size
    assert vote_volume(region, views.cameras, masks, 0.02) is None
    # Unless less than some size is not believed.
    assert vote_volume(region, views.cameras, masks, 0.02, 0.5 * volume.size, 0.35) is not None


@pytest.mark.slow
def test_the_doctor_draws_the_outlines_that_strokes_give(few: Path, tmp_path: Path) -> None:
    file, sheet = tmp_path / "strokes.json", tmp_path / "sheet.png"
    file.write_text(json.dumps({"strokes": plain_strokes(strokes_over(load_unmasked_views(few), STROKED_OF_FEW))}))
    done = CliRunner().invoke(app, ["doctor", str(few), "--strokes", str(file), "--sheet", str(sheet)])
    assert done.exit_code == 0, done.output
    with Image.open(sheet) as drawn:
        green = (np.asarray(drawn.convert("RGB"), int) == GOOD).all(-1)
    assert green.sum() > FEW_VIEWS * 70, "an outline in each of the pictures, of a ball that is some 35 pixels wide"
    alone = CliRunner().invoke(app, ["doctor", str(few), "--strokes", str(file)])
    assert alone.exit_code == 2 and "expected --sheet FILE" in alone.output


@pytest.mark.slow
def test_a_build_takes_its_masks_from_strokes(few: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PRESETS, "tiny", WITHOUT_HOLLOWS)
    strokes = tuple(strokes_over(load_unmasked_views(few), STROKED_OF_FEW))
    asset = build_asset(few, tmp_path / "ball", BuildSettings(preset="tiny", device="cpu", strokes=strokes))
    assert asset.provenance["strokes"] == plain_strokes(strokes)
    away = (asset.mesh.vertices - torch.from_numpy(SPHERE_CENTER).float()).norm(dim=-1)
    assert float(away.max()) < 1.3 * SPHERE_RADIUS and float(away.median()) == pytest.approx(SPHERE_RADIUS, rel=0.1)
