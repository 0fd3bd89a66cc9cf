"""The command line keeps its manners: fast help, one sentence for wrong input, clean stdout."""

import json
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest
from typer.testing import CliRunner

from drgs import __version__
from drgs.cli import app, main
from tests.patience import PATIENCE_SECONDS

COMMANDS = ("pose", "build", "render", "import", "export", "simulate", "eval", "doctor", "serve", "worker", "bench")


def drgs(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "drgs", *map(str, arguments)], capture_output=True, text=True, timeout=PATIENCE_SECONDS)


def drgs_here(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """In this process, where what a command imports is there already: loading it takes a process of its own two seconds of a core.

    Whatever says a word while it is loaded is seen by the tests that start a process: of doctor, build, simulate, render and export.
    """
    result = CliRunner().invoke(app, [*map(str, arguments)])
    return subprocess.CompletedProcess([], result.exit_code, result.stdout, result.stderr)


ONE_BY_ONE = """
import json, sys, drgs.cli
for arguments in json.loads(sys.argv[1]):
    sys.argv = ["drgs", *arguments]
    try:
        drgs.cli.main()
    except SystemExit as end:
        code = end.code
    for stream in (sys.stdout, sys.stderr):
        print(f"\\nended with {code}", file=stream, flush=True)
"""


def drgs_one_by_one(commands: Sequence[Sequence[str | Path]]) -> list[subprocess.CompletedProcess[str]]:
    """What each command says and ends with, of several in one process: to load what they need takes it two seconds of a core."""
    given = json.dumps([[*map(str, arguments)] for arguments in commands])
    done = subprocess.run([sys.executable, "-c", ONE_BY_ONE, given], capture_output=True, text=True, timeout=PATIENCE_SECONDS)
    assert done.returncode == 0, done.stderr
    said, complained = (re.split(r"\nended with (.*)\n", text) for text in (done.stdout, done.stderr))
    assert said[1::2] == complained[1::2] and len(said) == 2 * len(commands) + 1 and said[-1] == complained[-1] == ""
    return [
        subprocess.CompletedProcess([], int(code), out, err)
        for out, code, err in zip(said[:-1:2], said[1::2], complained[:-1:2], strict=True)
    ]


def assert_one_sentence(result: subprocess.CompletedProcess[str], exit_code: int = 1) -> None:
    """1: wrong input or a full disk. 2: the command was called wrongly."""
    assert result.returncode == exit_code, result.stderr
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
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=PATIENCE_SECONDS)
    assert result.returncode == 0, f"imported {result.stderr}"


@pytest.mark.slow
def test_reading_cameras_imports_nothing_that_finds_points():
    # `drgs render` reads them, and finds none.
    program = "import sys, drgs.reconstruct.capture.load_views; sys.exit(sorted({'scipy', 'skimage'} & set(sys.modules)) or None)"
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=PATIENCE_SECONDS)
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


@pytest.mark.slow
def test_every_command_explains_itself():
    for command, result in zip(COMMANDS, drgs_one_by_one([[command, "--help"] for command in COMMANDS]), strict=True):
        assert result.returncode == 0, command
        assert result.stdout.startswith("Usage: ") and f" {command} " in result.stdout.splitlines()[0]


@pytest.mark.slow
def test_wrong_input_is_one_sentence_of_each_command_that_loads_much(tmp_path: Path):
    """One after another in a process, which no other test shares: a word that anything said while it is loaded would be seen."""
    scene = tmp_path / "sim.json"
    commands = [
        ["doctor", tmp_path / "nothing_here"],
        ["build", tmp_path, tmp_path / "out"],
        ["simulate", tmp_path, tmp_path, "--scene", scene],
        ["export", tmp_path / "asset", tmp_path / "x.glb"],
    ]
    results = drgs_one_by_one(commands)
    for result in results:
        assert_one_sentence(result)
    assert "nothing_here" in results[0].stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_an_asset_that_does_not_exist_is_one_sentence(tmp_path: Path):
    assert_one_sentence(drgs_here("export", tmp_path / "asset", tmp_path / "x.glb"))


def test_a_file_whose_suffix_names_no_format_is_one_sentence(tmp_path: Path):
    result = drgs("export", tmp_path / "asset", tmp_path / "x.fbx")
    assert_one_sentence(result, exit_code=2)
    assert ".glb" in result.stderr and "--format" in result.stderr


@pytest.mark.slow
def test_a_wrong_size_is_one_sentence_that_says_what_is_expected(tmp_path: Path):
    cameras = tmp_path / "transforms.json"
    cameras.write_text('{"camera_angle_x": 0.5, "frames": []}')
    result = drgs_here("render", tmp_path, tmp_path / "out", "--cameras", cameras, "--size", "400")
    assert_one_sentence(result, exit_code=2)
    assert "400x300" in result.stderr


@pytest.mark.slow
def test_wrong_edits_are_one_sentence_that_names_the_field(tmp_path: Path):
    edits = tmp_path / "edits.json"
    edits.write_text('[{"op": "material", "select": {"all": true}, "set": {"roughness": 3}}]')
    result = drgs_here("render", tmp_path, tmp_path / "out", "--cameras", tmp_path / "transforms.json", "--edits", edits)
    assert_one_sentence(result)
    assert "0..1" in result.stderr


def test_an_edit_that_lacks_a_field_is_named_with_its_file_and_where_edits_are_described(tmp_path: Path):
    edits = tmp_path / "gold.json"
    edits.write_text('[{"op": "material", "set": {"roughness": 0.3}}]')
    result = drgs_here("render", tmp_path, tmp_path / "out", "--cameras", tmp_path / "transforms.json", "--edits", edits)
    assert_one_sentence(result)
    assert f"{edits}: edits: 0.material.select: Field required" in result.stderr and "docs/protocol.md" in result.stderr


def test_a_folder_in_the_place_of_a_file_of_cameras_is_one_sentence(tmp_path: Path):
    result = drgs_here("render", tmp_path, tmp_path / "out", "--cameras", tmp_path)
    assert_one_sentence(result)
    assert "is a folder; expected a file of cameras, such as an asset's cameras.json" in result.stderr


@pytest.mark.parametrize("command", ["doctor", "build"])
@pytest.mark.parametrize("file", ["mesh.glb", "thumb.jpg"])
def test_an_asset_in_the_place_of_photographs_is_called_one(tmp_path: Path, command: str, file: str):
    (tmp_path / "cup").mkdir()
    (tmp_path / "cup" / "asset.json").write_text("{}")
    (tmp_path / "cup" / file).touch()
    result = drgs_here(command, tmp_path / "cup", *([tmp_path / "out"] if command == "build" else []))
    assert_one_sentence(result)
    assert "is an asset, which a build wrote; expected photographs or a capture" in result.stderr


def test_pose_says_in_one_sentence_what_is_wrong_with_a_folder(tmp_path: Path):
    (tmp_path / "photos").mkdir()
    result = drgs_here("pose", tmp_path / "photos", tmp_path / "posed", "--json")
    assert_one_sentence(result)
    assert "0 pictures, expected at least 8" in result.stderr


@pytest.mark.parametrize("arguments", [["nonsense"], ["build", "only_one"], ["export", "asset", "out.glb", "--format", "stl"]])
def test_a_command_that_is_called_wrongly_ends_with_2(arguments: list[str]):
    result = drgs(*arguments)
    assert result.returncode == 2
    assert result.stdout == "" and "Usage: " in result.stderr


def test_the_version_is_the_one_of_the_library():
    result = drgs("--version")
    assert (result.returncode, result.stdout) == (0, f"drgs {__version__}\n")


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An asset without Gaussians."""
    from drgs.convert.import_mesh import import_mesh
    from drgs.scene.asset import save_asset
    from tests.web.browser import write_ball

    folder = tmp_path_factory.mktemp("ball")
    write_ball(folder / "ball.ply")
    save_asset(import_mesh(folder / "ball.ply"), folder / "asset")
    return folder / "asset"


@pytest.mark.slow
@pytest.mark.parametrize(("name", "start"), [("a.glb", b"glTF"), ("a.exr", b"v/1\x01"), ("A.GLB", b"glTF")])
def test_export_takes_the_format_from_the_ending(ball: Path, name: str, start: bytes, tmp_path: Path):
    result = drgs_here("export", ball, tmp_path / name)
    assert result.returncode == 0, result.stderr
    assert (tmp_path / name).read_bytes().startswith(start)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="limits the size of files as POSIX does")
def test_files_that_cannot_be_written_whole_are_one_sentence_and_leave_nothing(ball: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    import resource

    pytest.importorskip("pxr", reason="the optional package usd-core is not installed")
    # Compiled modules are files, too: cut short they would be kept, and nothing could import them any more.
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    for name in ("a.glb", "a.usda", "a.usdc", "a.usdz"):
        resource.setrlimit(resource.RLIMIT_FSIZE, (2000, before[1]))
        try:
            result = drgs_here("export", ball, tmp_path / name)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
        assert_one_sentence(result)
        assert "File too large" in result.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_one_sentence_that_says_what_to_do(monkeypatch: pytest.MonkeyPatch):
    def fail(path: Path) -> None:
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr("drgs.scene.edits.load_edits", fail)
    result = drgs_here("render", "asset", "out", "--cameras", "c.json", "--edits", "e.json")
    assert_one_sentence(result)
    assert result.stderr == "drgs: e.json: No space left on device; free some space and try again\n"


def test_render_brings_light_to_the_picture_by_the_curve_that_is_asked_for(tmp_path: Path):
    from drgs.convert.import_mesh import import_mesh
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


def test_ctrl_c_ends_with_130_and_a_sentence(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]):
    def stop(path: Path) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("drgs.scene.edits.load_edits", stop)
    monkeypatch.setattr(sys, "argv", ["drgs", "render", "asset", "out", "--cameras", "c.json", "--edits", "e.json"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 130
    assert capfd.readouterr().err == "drgs: stopped by Ctrl-C\n"
