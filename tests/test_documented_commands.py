"""Commands on the pages are commands: each is taken by the command line as it stands, and those of the tutorial that take seconds are run.

Not run are what takes minutes (pose, build: other tests run them) and what does not end (serve, worker).
"""

import re
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import typer
from typer.testing import CliRunner

from drgs.cli import app
from drgs.scene.asset import save_asset
from drgs.scene.camera import camera_from_opengl
from drgs_worker.jobs.start_view import turntable_view
from tests.convert.test_export_asset import ball_asset
from tests.reconstruct.tiny_capture import FEW_VIEWS, sphere_views, write_nerf_synthetic

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
SLOW_OR_ENDLESS = ("pose", "build", "serve", "worker", "bench")
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
    """The folder of somebody who has come as far as the tutorial's second step, with a small asset."""
    asset = ball_asset()
    intrinsics = torch.tensor([[400.0, 0, 160], [0, 400.0, 160], [0, 0, 1]])
    view = torch.from_numpy(turntable_view((-1, -1, 1), (1, 1, 3), 30, 20))
    save_asset(replace(asset, cameras=(camera_from_opengl(view, intrinsics, 320, 320, "front"),)), tmp_path / "out" / "sample")
    # A ball for the sample, of which examining and rendering as many views takes a core ten seconds more.
    sample = write_nerf_synthetic(tmp_path / "examples" / "sample_capture", sphere_views(FEW_VIEWS, square=True))
    shutil.copytree(sample / "train", sample / "test")
    (sample / "transforms_test.json").write_text((sample / "transforms_train.json").read_text().replace("./train/", "./test/"))
    (tmp_path / "examples" / "environments").symlink_to(ROOT / "examples" / "environments", target_is_directory=True)
    (tmp_path / "photos").symlink_to(sample, target_is_directory=True)
    (edits,) = re.findall(r"^```json\n(.*?)^```", (ROOT / "docs" / "tutorial.md").read_text(), re.MULTILINE | re.DOTALL)
    (tmp_path / "gold.json").write_text(edits)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.slow
def test_the_tutorial_can_be_followed(reader: Path):
    said = ""
    for name, *arguments in commands(ROOT / "docs" / "tutorial.md"):
        if name in SLOW_OR_ENDLESS:
            continue
        result = CliRunner().invoke(app, [name, *arguments])
        assert result.exit_code == 0, f"drgs {name} {' '.join(arguments)}: {result.output}"
        said += result.output
    # What the doctor says of a capture that is good is asked of the sample, in test_cli.py.
    assert "1 picture written to out/gold" in said and "views.psnr" in said
    made = {path.name for path in reader.iterdir()}
    assert {"sheet.png", "sample.html", "sample.glb", "sample.ply", "sample.spz", "light.exr", "sample.usdz"} <= made
    assert list((reader / "out" / "gold").glob("*.png")) and list((reader / "out" / "pictures").glob("*.png"))
