"""What a build beside other work is held against; the viewer that never rests, on a real server."""

import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.builds.build_process import BuildRun
from benchmarks.render.frame import served
from benchmarks.serve.beside import GIVING_WAY, SCRIPT, camera_path, figures, pictures_a_second
from drgs.scene.asset import Asset, save_asset
from drgs_worker.run import MODESTY
from tests.render.closed_form_scenes import sunny_sky, two_spheres


def run(seconds: float, cpu_seconds: float) -> BuildRun:
    return BuildRun(seconds, cpu_seconds, {}, 100)


def test_ratios_are_of_the_longer_build_of_the_mean_of_their_processor_time_and_to_what_was_alone_before_and_after():
    found = figures([run(90, 140), run(110, 160)], [run(180, 160), run(210, 170)], run(140, 155), fps_alone=[9, 11], fps_beside=6.5)
    assert (found["beside_build_ratio"], found["beside_build_cpu_ratio"]) == (2.1, 1.1)
    assert (found["beside_viewer_ratio"], found["beside_viewer_cpu_ratio"], found["viewer_kept"]) == (1.4, 1.03, 0.65)


def test_a_build_that_gives_way_is_the_command_itself(tmp_path: Path):
    asked = f"import os; print(os.nice(0), end=' '); {GIVING_WAY.replace('main()', 'print(os.nice(0), sys.argv)')}"
    said = subprocess.run([sys.executable, "-c", asked, "build", "x"], capture_output=True, text=True, check=True).stdout
    before, after, *arguments = said.split(maxsplit=2)
    assert int(after) == min(int(before) + MODESTY, 19) and arguments == ["['drgs', 'build', 'x']\n"]


def test_a_script_loads_torch_before_anything_is_chosen():
    loading = SCRIPT.replace("import drgs\n", "print(sorted({'GOMP_SPINCOUNT', 'OMP_WAIT_POLICY'} & os.environ.keys()), end=' ')\n", 1)
    loading = loading.split("asset =")[0] + "print('torch' in sys.modules, out)"
    arguments = ["capture", "out", "draft", "cpu", "0"]
    said = subprocess.run([sys.executable, "-c", loading, *arguments], capture_output=True, text=True, check=True).stdout
    assert said == "[] True out\n"


@pytest.mark.slow
def test_a_viewer_that_never_rests_gets_a_picture_of_each_camera(tmp_path: Path):
    path = tmp_path / "spheres"
    save_asset(Asset(None, two_spheres(roughness=0.6), None, sunny_sky(sun=20.0)), path)
    with served(path, 48, "cpu") as (_, _, stream):
        asked, turn = [], camera_path(path, 48)

        def next_camera() -> list[list[float]]:
            asked.append(1)
            return turn()

        rate = pictures_a_second(stream, next_camera, 48, lambda: True, most=5)
    assert len(asked) == 5 and rate > 0
