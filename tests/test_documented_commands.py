"""Commands on the pages are commands: each is taken by the command line as it stands, and those of the tutorial are run, one after the other."""

import re
import shlex
import shutil
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch
import typer
from typer.testing import CliRunner

from drgs.cli import app
from drgs.exchange.ply import parse_ply
from drgs.reconstruct.pose import pose_photographs
from drgs.reconstruct.pose.pose_photographs import PoseSettings
from drgs.reconstruct.presets import PRESETS
from drgs.scene.asset import load_asset
from drgs.scene.load_environment import load_environment
from drgs_server.client import Client
from tests.reconstruct.pose.textured_scene import PLAIN_SIZE, orbit, write_photographs
from tests.reconstruct.test_build_asset import WITHOUT_HOLLOWS
from tests.reconstruct.tiny_capture import sphere_views, write_nerf_synthetic
from tests.web.browser import RunningServer

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
TUTORIAL = ROOT / "docs" / "tutorial.md"
VIEWS = 4
"""Of the ball, each of which is rendered twice at the tutorial's size."""
PLAIN_VIEWS, AROUND = 8, 24
"""Of the egg, the fewest that are posed, and how many would go all round it at their distance from each other."""
SHORT = replace(
    WITHOUT_HOLLOWS,
    fit=replace(WITHOUT_HOLLOWS.fit, iterations=10),
    surface=replace(WITHOUT_HOLLOWS.surface, passes=1),
    materials=replace(WITHOUT_HOLLOWS.materials, iterations=2),
)
FENCE = "```"


def commands(page: Path) -> list[list[str]]:
    """Words of each line of a block that calls drgs, without comments."""
    found, language = [], None
    for line in page.read_text().splitlines():
        if line.startswith(FENCE):
            language = line.removeprefix(FENCE) if language is None else None
        elif language in ("", "sh") and line.startswith("drgs "):
            found.append(shlex.split(line, comments=True)[1:])
    return found


def test_there_are_commands_on_the_pages():
    found = {page.name: len(commands(page)) for page in PAGES}
    assert found["tutorial.md"] > 8 and found["capture_well.md"] > 1 and found["README.md"] > 5


@pytest.mark.parametrize("page", [page for page in PAGES if commands(page)], ids=lambda page: page.name)
def test_the_command_line_takes_every_command_of_a_page(page: Path):
    group = typer.main.get_command(app)
    context = typer.Context(group, info_name="drgs")
    for name, *arguments in commands(page):
        command = group.get_command(context, name)  # type: ignore[attr-defined]
        assert command is not None, f"{page.name}: drgs {name}"
        command.make_context(name, list(arguments), parent=context)


@pytest.fixture
def reader(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of somebody who begins the tutorial: few photographs of a ball for the sample, plain ones of an egg, and the environments. A draft is
    SHORT there; what the doctor says of a capture that is good is asked of the sample, in test_cli.py."""
    monkeypatch.setitem(PRESETS, "draft", SHORT)
    monkeypatch.setattr(pose_photographs, "PoseSettings", partial(PoseSettings, most_features=500))
    sample = write_nerf_synthetic(tmp_path / "examples" / "sample_capture", sphere_views(VIEWS, square=True))
    shutil.copytree(sample / "train", sample / "test")
    (sample / "transforms_test.json").write_text((sample / "transforms_train.json").read_text().replace("./train/", "./test/"))
    (tmp_path / "examples" / "environments").symlink_to(ROOT / "examples" / "environments", target_is_directory=True)
    if find_spec("pycolmap"):
        write_photographs(tmp_path / "pictures", orbit(AROUND)[:PLAIN_VIEWS], size=PLAIN_SIZE)
    else:
        (tmp_path / "photos").symlink_to(sample, target_is_directory=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def look_in_a_browser(reader: Path) -> None:
    """`drgs serve`, on a free port; what a browser would send for a folder that is dropped; and Ctrl-C."""
    running = RunningServer(reader / "data")
    running.start()
    try:
        with Client(running.address, token=running.token) as client:
            dropped = client.upload_asset(reader / "out" / "sample")
            assert dropped.face_count == len(load_asset(reader / "out" / "sample").mesh.faces)
    finally:
        running.stop()


@pytest.mark.slow
def test_the_tutorial_can_be_followed_from_photographs_to_files(reader: Path):
    """All of its commands in their order, in one folder: each finds what those before it left there."""
    (edits,) = re.findall(r"^```json\n(.*?)^```", TUTORIAL.read_text(), re.MULTILINE | re.DOTALL)
    (reader / "gold.json").write_text(edits)
    said = ""
    for name, *arguments in commands(TUTORIAL):
        if name == "serve":
            look_in_a_browser(reader)
        elif name != "pose" or find_spec("pycolmap"):
            result = CliRunner().invoke(app, [name, *arguments])
            assert result.exit_code == 0, f"drgs {name} {shlex.join(arguments)}: {result.output}"
            said += result.output
    assert f"{VIEWS} pictures written to out/gold" in said and "views.psnr" in said
    pictures = {folder: sorted(path.name for path in (reader / "out" / folder).glob("*.png")) for folder in ("pictures", "gold")}
    assert pictures["gold"] == pictures["pictures"] == [f"r_{number:03d}.png" for number in range(VIEWS)]
    assert (reader / "out" / "sample.build").is_dir(), "the checkpoints, which it says can be deleted"
    made = {path.name for path in reader.iterdir()}
    assert {"photos", "sheet.png", "sample.html", "sample.glb", "sample.ply", "sample.spz", "light.exr", "sample.usdz"} <= made
    built = load_asset(reader / "out" / "sample")
    assert built.gaussians is not None
    splats = parse_ply((reader / "sample.ply").read_bytes()).elements["vertex"].scalars
    assert len(splats["x"]) == len(built.gaussians.centers)
    assert torch.equal(load_environment(reader / "light.exr").radiance, built.environment.radiance)
