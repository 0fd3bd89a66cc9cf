"""A simulation that was killed goes on with the next frame, and its clip is the same to the last bit."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import trimesh

from drgs.convert.import_mesh import import_mesh
from drgs.deform.clip import growing_clip, open_clip, read_frame
from drgs.deform.matter.simulate import simulate
from drgs.deform.matter.simulation_scene import parse_simulation_scene
from drgs.deform.pose_scene import pose_scene
from drgs.scene.asset import Asset, load_asset, save_asset
from drgs.scene.edits import parse_edits
from tests.patience import PATIENCE_SECONDS

SCENE = parse_simulation_scene({"particles": 300, "duration": 0.4, "fps": 20, "spin": [0, 3.0, 0], "matter": {"preset": "jelly"}})
FRAMES = 9
PROGRAM = """
import os, signal, sys
from pathlib import Path
from drgs.deform.matter.simulate import simulate
from drgs.deform.matter.simulation_scene import SimulationScene
from drgs.scene.asset import load_asset

def die(done, total):
    if done == int(sys.argv[5]):
        os.kill(os.getpid(), signal.SIGKILL)

scene = SimulationScene.model_validate_json(sys.argv[4])
simulate(load_asset(Path(sys.argv[1])), scene, Path(sys.argv[2]), die, checkpoint=Path(sys.argv[3]))
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("ball")
    trimesh.creation.icosphere(subdivisions=2, radius=0.5).export(root / "ball.ply")
    save_asset(import_mesh(root / "ball.ply"), root / "asset")
    simulate(load_asset(root / "asset"), SCENE, root / "undisturbed")
    return root


@pytest.fixture
def asset(folder: Path) -> Asset:
    return load_asset(folder / "asset")


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def frames_reported(asset: Asset, out: Path, checkpoint: Path) -> list[int]:
    told: list[int] = []
    simulate(asset, SCENE, out, lambda done, total: told.append(done), checkpoint=checkpoint)
    return told


@pytest.mark.slow
def test_kill_9_costs_one_frame_and_no_bit(folder: Path, asset: Asset, tmp_path: Path) -> None:
    checkpoint = tmp_path / "frames"
    arguments = [str(folder / "asset"), str(tmp_path / "clip"), str(checkpoint), SCENE.model_dump_json(), "4"]
    died = subprocess.run([sys.executable, "-c", PROGRAM, *arguments], timeout=PATIENCE_SECONDS)
    assert died.returncode == -signal.SIGKILL and not (tmp_path / "clip").exists()
    assert frames_reported(asset, tmp_path / "clip", checkpoint) == [4, 5, 6, 7, 8, 9]
    assert contents(tmp_path / "clip") == contents(folder / "undisturbed")
    assert len(contents(tmp_path / "clip")) == FRAMES + 1 and not checkpoint.exists()


class Stop(Exception):
    pass


def stop_at(asset: Asset, frame: int, checkpoint: Path) -> None:
    def stop(done: int, total: int) -> None:
        if done == frame:
            raise Stop

    with pytest.raises(Stop):
        simulate(asset, SCENE, None, stop, checkpoint=checkpoint)


@pytest.mark.slow
@pytest.mark.parametrize("damage", ["state.safetensors", "frame_00002.safetensors"])
def test_a_damaged_checkpoint_is_left_aside(damage: str, folder: Path, asset: Asset, tmp_path: Path) -> None:
    stop_at(asset, 4, tmp_path / "frames")
    os.truncate(tmp_path / "frames" / damage, 100)
    assert frames_reported(asset, tmp_path / "clip", tmp_path / "frames") == list(range(1, FRAMES + 1))
    assert contents(tmp_path / "clip") == contents(folder / "undisturbed")


@pytest.mark.slow
def test_the_checkpoint_of_another_scene_is_left_aside(asset: Asset, tmp_path: Path) -> None:
    stop_at(asset, 3, tmp_path / "frames")
    told: list[int] = []
    other = SCENE.model_copy(update={"duration": 0.1})
    simulate(asset, other, None, lambda done, total: told.append(done), checkpoint=tmp_path / "frames")
    assert told == [1, 2, 3]


@pytest.mark.slow
def test_a_clip_in_the_making_plays_up_to_its_newest_frame(folder: Path, asset: Asset, tmp_path: Path) -> None:
    (edit,) = parse_edits([{"op": "pose", "clip": "fall", "time": 0.15}])
    stop_at(asset, 3, growing_clip(tmp_path / "fall"))
    growing, whole = open_clip(growing_clip(tmp_path / "fall")), open_clip(folder / "undisturbed")
    assert (growing.frame_count, growing.fps) == (3, whole.fps)
    for index in range(3):
        assert torch.equal(read_frame(growing, index).vertices, read_frame(whole, index).vertices)
    newest = pose_scene(asset, [edit], tmp_path, confine=True).mesh
    assert torch.equal(newest.vertices, read_frame(whole, 2).vertices), "later moments show the newest frame"
    frames_reported(asset, tmp_path / "fall", growing_clip(tmp_path / "fall"))
    assert torch.equal(pose_scene(asset, [edit], tmp_path, confine=True).mesh.vertices, read_frame(whole, 3).vertices)


@pytest.mark.slow
def test_frames_at_rest_are_kept_too(asset: Asset, tmp_path: Path) -> None:
    still = SCENE.model_copy(update={"gravity": 0.0, "spin": (0.0, 0.0, 0.0), "floor": None})
    whole, report = simulate(asset, still)
    assert report.sleeping_frames > 0

    def stop(done: int, total: int) -> None:
        if done == 7:
            raise Stop

    with pytest.raises(Stop):
        simulate(asset, still, None, stop, checkpoint=tmp_path / "frames")
    again, report_again = simulate(asset, still, None, checkpoint=tmp_path / "frames")
    assert report_again == report and all(bool((a.vertices == b.vertices).all()) for a, b in zip(whole, again, strict=True))
