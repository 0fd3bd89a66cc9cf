"""The command line keeps its manners: fast help, one sentence for wrong input, clean stdout."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

COMMANDS = ("build", "render", "import", "export", "simulate", "eval", "doctor", "serve", "worker", "bench")


def drgs(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "drgs.cli", *map(str, arguments)], capture_output=True, text=True, timeout=120)


def assert_one_sentence(result: subprocess.CompletedProcess[str]) -> None:
    assert result.returncode == 2, result.stderr
    assert result.stdout == ""
    assert len(result.stderr.strip().splitlines()) == 1, result.stderr
    assert result.stderr.startswith("drgs: ")


def test_help_names_every_command():
    result = drgs("--help")
    assert result.returncode == 0
    assert all(f"  {name} " in result.stdout for name in COMMANDS)


def test_help_imports_nothing_heavy():
    # What makes it answer at once, and what a clock on a busy machine can't judge.
    program = (
        "import sys; from drgs.cli import app; sys.exit(sorted({'torch', 'warp', 'numpy', 'rich', 'fastapi'} & set(sys.modules)) or None)"
    )
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert result.returncode == 0, f"imported {result.stderr}"


@pytest.mark.skipif(sys.platform == "win32", reason="counts processor time as POSIX does")
def test_help_takes_less_than_half_a_second_of_processor_time():
    import resource

    def seconds() -> float:
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        drgs("--help")
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime

    assert min(seconds() for _ in range(3)) < 0.5


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(command: str):
    result = drgs(command, "--help")
    assert result.returncode == 0
    assert result.stdout.startswith("Usage: ")


def test_a_dataset_that_does_not_exist_is_one_sentence(tmp_path: Path):
    result = drgs("doctor", tmp_path / "nothing_here")
    assert_one_sentence(result)
    assert "nothing_here" in result.stderr


def test_a_folder_that_is_no_capture_is_one_sentence(tmp_path: Path):
    assert_one_sentence(drgs("build", tmp_path, tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_an_asset_that_does_not_exist_is_one_sentence(tmp_path: Path):
    assert_one_sentence(drgs("export", tmp_path / "asset", tmp_path / "x.glb", "--format", "glb"))


def test_a_wrong_size_is_one_sentence_that_says_what_is_expected(tmp_path: Path):
    cameras = tmp_path / "transforms.json"
    cameras.write_text('{"camera_angle_x": 0.5, "frames": []}')
    result = drgs("render", tmp_path, tmp_path / "out", "--cameras", cameras, "--size", "400")
    assert_one_sentence(result)
    assert "400x300" in result.stderr


def test_wrong_edits_are_one_sentence_that_names_the_field(tmp_path: Path):
    edits = tmp_path / "edits.json"
    edits.write_text('[{"op": "material", "select": {"all": true}, "set": {"roughness": 3}}]')
    result = drgs("render", tmp_path, tmp_path / "out", "--cameras", tmp_path / "transforms.json", "--edits", edits)
    assert_one_sentence(result)
    assert "0..1" in result.stderr


def test_render_brings_light_to_the_picture_by_the_curve_that_is_asked_for(tmp_path: Path):
    from typer.testing import CliRunner

    from drgs.build.import_mesh import import_mesh
    from drgs.cli import app
    from drgs.scene.asset import save_asset
    from tests.web.browser import write_ball

    write_ball(tmp_path / "ball.ply")
    save_asset(import_mesh(tmp_path / "ball.ply"), tmp_path / "asset")
    camera = {"file_path": "r_0", "transform_matrix": [[1, 0, 0, 0], [0, 0, -1, -2], [0, 1, 0, 0], [0, 0, 0, 1]]}
    cameras = tmp_path / "transforms.json"
    cameras.write_text(json.dumps({"camera_angle_x": 0.6, "frames": [camera]}))
    pictures = {}
    for curve in ("standard", "filmic"):
        arguments = ["render", tmp_path / "asset", tmp_path / curve, "--cameras", cameras, "--size", "16x16", "--spp", "4", "--aov"]
        result = CliRunner().invoke(app, [*map(str, arguments), "--tone-curve", curve, "--device", "cpu"])
        assert result.exit_code == 0, result.output
        pictures[curve] = {path.suffix: path.read_bytes() for path in (tmp_path / curve).iterdir()}
    assert pictures["standard"][".png"] != pictures["filmic"][".png"]
    assert pictures["standard"][".exr"] == pictures["filmic"][".exr"], "the light itself is the same"


def test_simulate_says_that_it_is_not_there_yet(tmp_path: Path):
    assert_one_sentence(drgs("simulate", tmp_path, tmp_path, "--scene", tmp_path / "sim.json"))


def test_ctrl_c_ends_with_130_and_a_sentence():
    program = "import drgs.cli as c, drgs.scene.edits as e\ndef stop(path): raise KeyboardInterrupt\ne.load_edits = stop\nc.main()"
    arguments = ["render", "asset", "out", "--cameras", "c.json", "--edits", "e.json"]
    result = subprocess.run([sys.executable, "-c", program, *arguments], capture_output=True, text=True, timeout=60)
    assert result.returncode == 130
    assert result.stderr == "drgs: stopped by Ctrl-C\n"
