"""What people have instead of a good capture, and the one sentence that each of it gets, with what to do about it.

A row is a way to spoil a good capture and what comes of it. `error`: the doctor, the build's door and the search for poses refuse it in that very
sentence, and nothing is written. `warning` and `info`: it can be built, and the doctor says what will hurt.
"""

import json
import math
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageFilter

from drgs.evaluate.doctor import doctor
from drgs.reconstruct.build_asset import BuildSettings, build_asset
from drgs.reconstruct.pose.explain_failure import check_baseline, check_features, check_placed
from drgs.reconstruct.pose.prepare_photos import PreparedPhoto
from tests.evaluate import painted_balls as balls
from tests.evaluate.painted_balls import Ball, Picture

Spoil = Callable[[Path], object]


@dataclass(frozen=True)
class Bad:
    """A bad capture."""

    write: Callable[[Path], object]
    level: str
    sentence: str
    """All of it, as a pattern."""
    advice: str
    """A part of it."""
    marked: tuple[str, ...] = ()
    """Pictures that carry a mark."""


def spoiled(*changes: Spoil) -> Spoil:
    """A good capture with files changed."""

    def write(folder: Path) -> None:
        balls.write_capture(folder)
        for change in changes:
            change(folder)

    return write


def masks_in_files(change: Spoil) -> Spoil:
    return spoiled(balls.write_masks, change)


def taken(**how: object) -> Spoil:
    return lambda folder: balls.write_capture(folder, balls.pictures(**how))


def posed(change: Callable[[int, Picture], Picture]) -> Spoil:
    """Pictures or poses changed one by one."""
    return lambda folder: balls.write_capture(folder, [change(number, picture) for number, picture in enumerate(balls.pictures())])


def pixels(number: int, change: Callable[[np.ndarray], np.ndarray]) -> Spoil:
    """Of one picture, RGBA."""

    def apply(folder: Path) -> None:
        path = folder / "train" / f"r_{number:03d}.png"
        Image.fromarray(change(np.array(Image.open(path)))).save(path)

    return apply


def frames(change: Callable[[list[dict]], object]) -> Spoil:
    """Of the camera file."""

    def apply(folder: Path) -> None:
        path = folder / "transforms_train.json"
        document = json.loads(path.read_text())
        change(document["frames"])
        path.write_text(json.dumps(document))

    return apply


def files(pattern: str, change: Callable[[Path], object]) -> Spoil:
    """Each file of that name."""

    def apply(folder: Path) -> None:
        found = sorted(folder.glob(pattern))
        assert found
        for path in found:
            change(path)

    return apply


def photographs(*changes: Spoil, **how: float) -> Spoil:
    def write(folder: Path) -> None:
        balls.write_photographs(folder, **how)
        for change in changes:
            change(folder)

    return write


def blurred(rgba: np.ndarray) -> np.ndarray:
    """The object's paint, smeared by three pixels; its outline stays."""
    soft = np.asarray(Image.fromarray(rgba[..., :3]).filter(ImageFilter.GaussianBlur(3)))
    return np.concatenate([soft, rgba[..., 3:]], -1)


def brighter(gain: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda rgba: np.concatenate([np.clip(rgba[..., :3] * np.float32(gain), 0, 255), rgba[..., 3:]], -1).astype(np.uint8)


def turned(degrees: float, axis: int) -> np.ndarray:
    """(4, 4), on the right of a pose: about an axis of the camera; on its left: of the world."""
    matrix, (j, k) = np.eye(4), [other for other in range(3) if other != axis]
    angle = math.radians(degrees)
    matrix[[j, j, k, k], [j, k, j, k]] = math.cos(angle), -math.sin(angle), math.sin(angle), math.cos(angle)
    return matrix


def on_one_side(half_angle: float, count: int = balls.VIEWS) -> np.ndarray:
    """Camera positions around +x."""
    k = np.arange(count) + 0.5
    off, around = np.radians(half_angle) * np.sqrt(k / count), np.pi * (1 + 5**0.5) * k
    return 3 * np.stack([np.cos(off), np.sin(off) * np.cos(around), np.sin(off) * np.sin(around)], -1)


def exchanged(taken_pictures: list[Picture], a: int, b: int) -> list[Picture]:
    """Each of the two has the other's pose."""
    poses = {a: taken_pictures[b].world_from_camera, b: taken_pictures[a].world_from_camera}
    return [replace(picture, world_from_camera=poses.get(k, picture.world_from_camera)) for k, picture in enumerate(taken_pictures)]


def opaque(rgba: np.ndarray) -> np.ndarray:
    return np.dstack([balls.before_grey(rgba), np.full(rgba.shape[:2], 255, np.uint8)])


ALSO_TRUE: dict[str, str] = {
    "six pictures": r"No view from azimuths .*",
    "no masks": r"There are neither masks nor sparse points: .*",
    "masks all full": r"There are neither masks nor sparse points: .*",
    "copies of too few photographs": r"5 of 10 pictures are the same files as others .*",
}
"""What else the doctor says of them, and is right."""
TWO = [Ball((0.0, 0.4, 0.0), 0.3), Ball((0.0, -0.35, 0.1), 0.25)]
CENTERED = [Ball((0.0, 0.0, 0.0))]
"""Whose outline is the same from everywhere."""
R5 = "train/r_005.png"

BAD: dict[str, Bad] = {
    # What is not there, or not to be read
    "two pictures": Bad(
        spoiled(frames(lambda f: f.__delitem__(slice(2, None)))), "error", r".*: 2 views, expected at least 3\.", "Mend that"
    ),
    "six pictures": Bad(taken(positions=balls.camera_positions(6)), "warning", r"6 views are few\.", "Take 20 to 100"),
    "an empty file": Bad(
        spoiled(files(R5, lambda path: path.write_bytes(b""))),
        "error",
        r".*r_005\.png: not a readable PNG, JPEG or WebP image \(the file is empty\)\.",
        "Copy it from the camera once more",
        ("r_005",),
    ),
    "a truncated file": Bad(
        spoiled(files(R5, lambda path: path.write_bytes(path.read_bytes()[:300]))),
        "error",
        r".*r_005\.png: the image cannot be decoded \(.*truncated.*\)\.",
        "Copy it from the camera once more",
        ("r_005",),
    ),
    "a wrong suffix": Bad(
        spoiled(files(R5, lambda path: Image.open(path).save(path, format="TIFF"))),
        "error",
        r".*r_005\.png: not a readable PNG, JPEG or WebP image \(it is a TIFF or RAW file whatever its name says\)\.",
        "Copy it from the camera once more",
        ("r_005",),
    ),
    "pictures of one pixel": Bad(
        spoiled(files("train/*", lambda path: Image.open(path).resize((1, 1)).save(path))),
        "error",
        r".*r_000\.png: the image is 1x1 pixels, expected at least 16 a side\.",
        "Put the photograph itself in its place",
        ("r_000",),
    ),
    # Pictures
    "a blurred picture": Bad(
        spoiled(pixels(5, blurred)), "warning", r"1 of 20 pictures are blurred \(r_005\)\.", "take them again", ("r_005",)
    ),
    "an over-exposed picture": Bad(
        spoiled(pixels(5, brighter(20))), "warning", r"1 of 20 pictures are over-exposed \(r_005\)\.", "less exposure", ("r_005",)
    ),
    "an under-exposed picture": Bad(
        spoiled(pixels(5, brighter(0.02))), "warning", r"1 of 20 pictures are under-exposed \(r_005\)\.", "more exposure", ("r_005",)
    ),
    "exposures up and down": Bad(
        spoiled(*(pixels(number, brighter(1.2 if number % 2 else 0.5)) for number in range(balls.VIEWS))),
        "warning",
        r"The same points differ in brightness by 1\.\d\d stops between views; a build takes that for their exposures, unless the light turns with the camera\.",
        "Lock exposure",
    ),
    "copies of a picture": Bad(
        spoiled(*(files(R5, lambda path, n=n: Image.open(path).save(path.with_name(f"r_{n:03d}.png"))) for n in (8, 13))),
        "warning",
        r"2 of 20 pictures show the very same as another \(r_008 as r_005, r_013 as r_005\)\.",
        "one of the two is the wrong file",
        ("r_008", "r_013"),
    ),
    "one picture over and over, without masks": Bad(
        spoiled(pixels(0, opaque), files("train/*", lambda path: path.write_bytes(path.with_name("r_000.png").read_bytes()))),
        "error",
        r".*: all 20 pictures are the same, expected one of its own from each camera\.",
        "seen from all around",
    ),
    "a picture of another scene": Bad(
        lambda folder: balls.write_capture(folder, balls.pictures(balls=lambda n: [Ball((-0.5, 0.4, -0.3), 0.3)] if n == 5 else [Ball()])),
        "warning",
        r"In 1 of 20 views \(r_005\) the mask differs from what the other masks imply\.",
        "they are of something else",
        ("r_005",),
    ),
    "two pictures with each other's pose, of one outline": Bad(
        lambda folder: balls.write_capture(folder, exchanged(balls.pictures(balls=lambda n: CENTERED), 5, 12)),
        "warning",
        r"2 of 20 pictures \(r_005, r_012\) show something else than the others where their poses say the object is\.",
        "the poses of other pictures",
        ("r_005", "r_012"),
    ),
    # Masks
    "no masks": Bad(
        spoiled(*(pixels(number, opaque) for number in range(balls.VIEWS))),
        "warning",
        r"There are no masks: the build looks .*",
        "alpha channel",
    ),
    "masks all empty": Bad(
        masks_in_files(files("masks/*", lambda path: Image.new("L", (balls.SIDE,) * 2, 0).save(path))),
        "error",
        r".*: the masks of all 20 pictures are empty, expected white \(or opaque\) where the object is\.",
        "take masks/ away",
    ),
    "masks all full": Bad(
        masks_in_files(files("masks/*", lambda path: Image.new("L", (balls.SIDE,) * 2, 255).save(path))),
        "warning",
        r"The masks of all 20 pictures are white all over: the build takes them for none, and looks for the object itself\.",
        "black elsewhere",
    ),
    "masks of another size": Bad(
        masks_in_files(files("masks/r_005.png", lambda path: Image.new("L", (32, 32), 255).save(path))),
        "error",
        r".*r_005\.png: the mask is 32x32, but its image r_005\.png is 48x48\.",
        "Mend that",
    ),
    "a mask too few": Bad(
        masks_in_files(files("masks/r_005.png", Path.unlink)),
        "error",
        r".*r_005\.png: no such mask \(1 of 20 images have none\), expected a mask for every image\.",
        "Mend that",
    ),
    "an empty mask": Bad(
        masks_in_files(files("masks/r_005.png", lambda path: Image.new("L", (balls.SIDE,) * 2, 0).save(path))),
        "warning",
        r"The mask is empty in 1 views \(r_005\)\.",
        "Leave these pictures out",
        ("r_005",),
    ),
    "a full mask": Bad(
        masks_in_files(files("masks/r_005.png", lambda path: Image.new("L", (balls.SIDE,) * 2, 255).save(path))),
        "warning",
        r"The mask fills the whole picture in 1 of 20 views \(r_005\)\.",
        "Draw these masks anew",
        ("r_005",),
    ),
    "two objects": Bad(
        taken(balls=lambda n: TWO),
        "info",
        r"The masks show 2 things that stand apart \(of volumes 100 : \d\d\)\.",
        "take the others out of the masks",
    ),
    "an object that moves a little": Bad(
        taken(balls=lambda n: [Ball((0.0, 0.0, -0.15 if n % 2 else 0.15), 0.5)]),
        "warning",
        r"In \d+ of 20 views \(.*\) the mask holds what the others exclude: the object moved between pictures, or poses and pictures are mixed up\.",
        "at rest",
    ),
    "an object that moves far": Bad(
        taken(balls=lambda n: [Ball((0.0, 0.0, -0.35 if n % 2 else 0.35), 0.5)]),
        "error",
        r".*: what all masks together allow fills \d+ % of the middle one of them, expected more than 50 %\.",
        "The object moved between pictures",
    ),
    "pictures turned left to right": Bad(
        lambda folder: balls.write_capture(
            folder, [replace(picture, rgba=picture.rgba[:, ::-1]) for picture in balls.pictures(balls=lambda n: TWO)]
        ),
        "error",
        r".*: what all masks together allow fills \d+ % of the middle one of them, expected more than 50 %\.",
        "do not belong together",
    ),
    "mirrored surroundings": Bad(
        taken(paint=balls.mirror),
        "info",
        r"Pictures hardly agree on how bright the same places are \(rank correlation -?0\.\d\d\): the object mirrors its surroundings, or the poses are off\.",
        "surroundings that stand still",
    ),
    # Cameras
    "a picture of another lens": Bad(
        spoiled(frames(lambda f: f[5].update(camera_angle_x=1.7))),
        "warning",
        r"Focal lengths of 1 of 20 pictures \(r_005\) are more than 3 times longer or shorter than those of the others\.",
        "Check their fl_x",
        ("r_005",),
    ),
    "a camera that looks away": Bad(
        posed(lambda n, picture: picture if n != 5 else replace(picture, world_from_camera=picture.world_from_camera @ turned(180, 1))),
        "warning",
        r"1 of 20 cameras look away from the object \(r_005\)\.",
        "Check their poses",
        ("r_005",),
    ),
    "matrices in OpenCV's axes": Bad(
        posed(lambda n, picture: replace(picture, world_from_camera=picture.world_from_camera @ np.diag([1.0, -1, -1, 1]))),
        "error",
        r".*: 20 of 20 cameras look away from where their viewing directions meet, expected all to look at the object\.",
        "change the sign of the second and third column",
    ),
    "world-to-camera matrices": Bad(
        posed(lambda n, picture: replace(picture, world_from_camera=np.linalg.inv(picture.world_from_camera))),
        "error",
        r".*: all 20 cameras stand at one place, expected them around the object\.",
        "invert those that are world-to-camera",
    ),
    "upside-down poses": Bad(
        posed(lambda n, picture: replace(picture, world_from_camera=turned(180, 0) @ picture.world_from_camera)),
        "warning",
        r"The cameras' mean upward direction is 1[78]\d degrees off the world's z axis\.",
        "turn the world upright by --up ",
    ),
    "a pose that is not finite": Bad(
        spoiled(frames(lambda f: f[5]["transform_matrix"][1].__setitem__(3, math.nan))),
        "error",
        r".*r_005: its pose contains NaN or infinity, expected 16 finite numbers\.",
        "Mend that",
    ),
    "a mirrored pose": Bad(
        spoiled(frames(lambda f: [row.__setitem__(0, -row[0]) for row in f[5]["transform_matrix"]])),
        "error",
        r".*r_005: its pose is not rigid \(determinant -1, .*\), expected a rotation without scale or mirroring\.",
        "Mend that",
    ),
    "all from one side": Bad(
        taken(positions=on_one_side(40)),
        "warning",
        r"All pictures are taken from one side, within \d\d degrees of the direction between them\.",
        "from all around",
    ),
    "all from one place": Bad(
        taken(positions=on_one_side(1, count=6)),
        "error",
        r".*: all pictures are taken from within [12]\.\d degrees as seen from the object, expected them from all around it\.",
        "Walk around the object",
    ),
    # Photographs without cameras
    "photographs of which one is damaged": Bad(
        photographs(files("p_005.png", lambda path: path.write_bytes(path.read_bytes()[:900])), count=22),
        "warning",
        r".*p_005\.png: the image cannot be decoded \(.*\)\. The build leaves it out\.",
        "Copy it from the camera once more",
        ("p_005",),
    ),
    "too few photographs": Bad(
        photographs(count=5),
        "error",
        r".*: 5 pictures, expected at least 8 PNG, JPEG or WebP photographs, better 40 to 100 .*",
        "all around",
    ),
    "copies of too few photographs": Bad(
        photographs(files("p_00[0-4].png", lambda path: path.with_name(f"q{path.name}").write_bytes(path.read_bytes())), count=5),
        "error",
        r".*: 5 of 10 pictures can be used, expected at least 8.*",
        "Take 40 to 100",
        tuple(f"qp_00{n}" for n in range(5)),
    ),
    "photographs without texture": Bad(
        photographs(grain=0.0),
        "warning",
        r"20 of 20 pictures show hardly any texture to recognise places by \(.*\): poses will probably not be found\.",
        "newspaper",
        tuple(f"p_{n:03d}" for n in range(balls.VIEWS)),
    ),
    "a blurred photograph": Bad(
        photographs(files("p_005.png", lambda path: Image.open(path).filter(ImageFilter.GaussianBlur(4)).save(path))),
        "warning",
        r"1 of 20 pictures are blurred \(p_005\)\.",
        "take them again",
        ("p_005",),
    ),
}
"""By what is wrong."""


def test_there_are_twenty_and_more() -> None:
    assert len(BAD) >= 20


@pytest.mark.slow
def test_nothing_is_said_of_good_captures(tmp_path: Path) -> None:
    for report in (doctor(balls.write_capture(tmp_path / "posed")), doctor(balls.write_photographs(tmp_path / "plain"))):
        assert report["ok"] and [f for f in report["findings"] if f["level"] != "info"] == [] and report["marks"] == {}
        assert all("There are no masks/" in f["sentence"] or "guessed" in f["sentence"] for f in report["findings"])


def test_a_side_without_paint_is_not_called_blurred(tmp_path: Path) -> None:
    def plain(rgba: np.ndarray) -> np.ndarray:
        grain = np.random.default_rng(0).normal(120, 1.5, rgba.shape[:2])[..., None].repeat(3, 2)
        return np.concatenate([np.where(rgba[..., 3:] > 0, grain, 0), rgba[..., 3:]], -1).astype(np.uint8)

    folder = tmp_path / "capture"
    spoiled(pixels(5, plain))(folder)
    assert doctor(folder)["looks"]["blurred"] == []


@pytest.mark.slow
@pytest.mark.parametrize("what", BAD)
def test_a_bad_capture_gets_its_sentence(what: str, tmp_path: Path) -> None:
    bad = BAD[what]
    folder = tmp_path / "capture"
    bad.write(folder)
    report = doctor(folder)
    assert report["ok"] == (bad.level != "error")
    said = [finding for finding in report["findings"] if finding["level"] in ("error", "warning")]
    if bad.level == "info":
        assert said == []
        said = [finding for finding in report["findings"] if re.fullmatch(bad.sentence, finding["sentence"])]
    finding = said[0]
    assert finding["level"] == bad.level and re.fullmatch(bad.sentence, finding["sentence"]), said
    assert bad.advice in finding["advice"] and finding["advice"]
    assert "\n" not in finding["sentence"]
    others = [other["sentence"] for other in said[1:]]
    assert [sentence for sentence in others if not re.fullmatch(ALSO_TRUE.get(what, ""), sentence)] == []
    assert tuple(sorted(report["marks"])) == bad.marked or not bad.marked
    if bad.level == "error":
        if "photographs" in what:
            pytest.importorskip("pycolmap")
        with pytest.raises(ValueError) as refusal:
            build_asset(folder, tmp_path / "asset", BuildSettings(preset="draft", device="cpu"))
        assert re.fullmatch(bad.sentence, str(refusal.value))
        assert not (tmp_path / "asset").exists()


PREPARED = [PreparedPhoto(f"p_{number:03d}", f"p_{number:03d}.png", False, 80, 60, None, 100.0, "") for number in range(20)]
NO_MATCHES = {photo.name: "no matches, no other picture shows the same" for photo in PREPARED[:12]}
SEARCHES: dict[str, tuple[Callable[[Path], object], str]] = {
    "without texture": (
        lambda folder: check_features(folder, PREPARED, {photo.file: 9 for photo in PREPARED}, 0.6),
        r".*: 20 of 20 pictures have fewer than 60 features \(.*\): blurred, or of something without texture; put textured things, .*",
    ),
    "all from one place": (
        lambda folder: check_baseline(folder, 0.001),
        r".*: what the pictures show moves by 0\.10 % of their width .*: they are taken from one place; walk around the object\.",
    ),
    "of two scenes": (
        lambda folder: check_placed(folder, 8, 20, NO_MATCHES, [], 0.6),
        r".*: 8 of 20 pictures could be placed, expected at least 12 \(no matches: .*\)\. Take more pictures .*",
    ),
}
"""What only looking for poses can tell of photographs (pose/explain_failure.py), and ends it."""


@pytest.mark.parametrize("what", SEARCHES)
def test_photographs_that_cannot_be_posed_get_their_sentence(what: str, tmp_path: Path) -> None:
    search, sentence = SEARCHES[what]
    with pytest.raises(ValueError) as refusal:
        search(tmp_path)
    assert re.fullmatch(sentence, str(refusal.value))
