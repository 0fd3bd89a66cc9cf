"""The command on a scene small enough to know: every table and figure is there, and what is finished is not made again."""

import json
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
import torch
from PIL import Image

from benchmarks.__main__ import main
from benchmarks.paper.cells import CellFolder
from benchmarks.paper.command import repeated
from benchmarks.paper.figures import STRIP, young_modulus
from benchmarks.paper.films import FPS, WAY_THERE, shares, write_film
from benchmarks.paper.pages import honesty, score_rows
from benchmarks.paper.variants import VARIANTS
from drgs.deform.matter.simulation_scene import make_material, parse_simulation_scene
from drgs.exchange.exr import encode_environment
from drgs.reconstruct.capture.load_views import load_cameras
from drgs.reconstruct.geometry.face_surfels import surfels_on_faces_of
from drgs.scene.asset import Asset, load_asset, save_asset
from tests.benchmarks.reconstruct.test_quality_benchmark import sphere_shape
from tests.reconstruct.tiny_capture import SPHERE_RADIUS, sphere_views, write_nerf_synthetic
from tests.render.closed_form_scenes import constant_sky, mesh_of

WAYS = ("mani_gs", "gsp", "ours_particles")
QUICK_FIGURES = ("comparison", "comparison_relit", "materials", "inter_reflection", "strip")
"""This scene has no true maps for the others, and simulated matter takes its time."""


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A painted sphere, two test views, and a deformed truth under two lights that is the sphere at rest: the map does nothing."""
    folder = write_nerf_synthetic(tmp_path_factory.mktemp("scene"), sphere_views(6, square=True))
    train = json.loads((folder / "transforms_train.json").read_text())
    frames = []
    views = sphere_views(2, square=True)
    for where in ("test", "deform/stretch/noon", "deform/stretch/dusk"):
        (folder / where).mkdir(parents=True)
        for view in views:
            Image.fromarray(view.rgba).save(folder / where / f"{view.name}.png")
    frames = [{"file_path": f"./test/{view.name}", "transform_matrix": view.world_from_opengl.tolist()} for view in views]
    (folder / "transforms_test.json").write_text(json.dumps(train | {"frames": frames}))
    facts = {"name": "ball", "train_env": "noon", "deform": {"stretch": {"type": "stretch", "factor": 1.0}}}
    (folder / "scene.json").write_text(json.dumps(facts))
    (folder / "env").mkdir()
    for light, radiance in (("noon", 1.0), ("dusk", 0.5)):
        (folder / "env" / f"{light}.exr").write_bytes(encode_environment(torch.full((8, 16, 3), radiance).numpy()))
    return folder


@pytest.fixture(scope="module")
def assets(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    mesh = mesh_of(sphere_shape(SPHERE_RADIUS), 0.5, 0.6, 0.0)
    gaussians, binding = surfels_on_faces_of(mesh)
    folder = tmp_path_factory.mktemp("assets")
    cameras = tuple(load_cameras(scene / "transforms_train.json"))
    save_asset(Asset(gaussians, mesh, binding, constant_sky(0.8), cameras, primary="mesh"), folder / "ball_asset")
    return folder


def arguments(out: Path, scene: Path, assets: Path, *more: str) -> list[str]:
    given = ["--assets", str(assets / "{scene}_asset"), "--quick", "--spp", "4", "--budget", "600", "--json", *more]
    return ["paper", str(out), "--scenes", str(scene), *given]


@pytest.mark.slow
def test_every_table_and_figure_is_there_and_nothing_is_made_twice(scene: Path, assets: Path, tmp_path: Path, capsys, monkeypatch):
    out = tmp_path / "out"
    command = arguments(out, scene, assets, "--only", *WAYS, "static", "deformed", *QUICK_FIGURES)
    main(command)
    document = json.loads(capsys.readouterr().out)["ball"]
    assert set(document["static"]) == set(document["deformed"]) == set(document["bind"]) == set(WAYS)
    assert set(document["deformed"]["gsp"]["figures"]) == {"stretch/noon", "stretch/dusk"}
    baked = document["static"]["mani_gs"]["figures"]["psnr"]
    assert baked > 20, "painted by the direction of the normal, and baked"
    # The map does nothing, so a baked picture under the same light is the one at rest.
    assert document["deformed"]["mani_gs"]["figures"]["stretch/noon"]["psnr"] == pytest.approx(baked, abs=1.5)
    assert set(document["figures"]) == set(QUICK_FIGURES)
    assert all(Image.open(out / cell["picture"]).size[0] > 50 for cell in document["figures"].values())
    film = document["figures"]["strip"]["film"]
    assert len(frames_of(out / film)) == 2 * (WAY_THERE - 1)
    assert document["figures"]["strip"]["figures"]["psnr_of_its_end"] > 15, "the map does nothing, and the sphere is painted by one colour"
    page = (out / "paper.md").read_text()
    assert f"[Film: there and back]({film})" in page and f'src="{film}" controls' in (out / "index.html").read_text()
    assert all(title in page for title in ("## Static views", "## Deformed, new light", "## Time and memory", "## Who is better"))
    assert str(tmp_path) not in page, "no address of this machine"
    assert "<table>" in (out / "index.html").read_text()

    def unwanted(*_: object) -> None:
        raise AssertionError("it is there already")

    (out / "cells" / "ball-gsp-static.json").unlink()
    for way in set(WAYS) - {"gsp"}:
        monkeypatch.setattr(VARIANTS[way], "bind", unwanted)
        monkeypatch.setattr(VARIANTS[way], "pose", unwanted)
    main(command)
    again = json.loads(capsys.readouterr().out)["ball"]
    assert again["static"]["gsp"]["figures"] == document["static"]["gsp"]["figures"]
    assert again["static"]["mani_gs"] == document["static"]["mani_gs"]

    (out / "cells" / "ball-gsp-deformed.json").unlink()
    main([*command, "--finished"])
    finished = json.loads(capsys.readouterr().out)["ball"]
    assert set(finished["static"]) == set(WAYS) and set(finished["deformed"]) == {"mani_gs", "ours_particles"}


def frames_of(film: Path) -> list[np.ndarray]:
    with av.open(str(film)) as container:
        assert container.streams.video[0].average_rate == FPS
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def test_a_film_goes_there_and_back_slowly_at_both_ends(tmp_path: Path):
    grey = np.array(shares())
    assert grey[0] == 0 and grey[-1] == 1 and np.allclose(grey[list(STRIP)], [0, 0.25, 0.5, 0.75, 1])
    steps = np.diff(grey)
    assert steps.min() > 0 and steps[0] == pytest.approx(steps[-1]) and steps[WAY_THERE // 2] > 5 * steps[0]
    write_film([np.full((33, 40, 3), 0.2 + 0.6 * share) for share in shares()], tmp_path / "new" / "a.mp4")
    shown = [frame.mean() / 255 for frame in frames_of(tmp_path / "new" / "a.mp4")]
    assert np.allclose(shown, 0.2 + 0.6 * np.concatenate([grey, grey[-2:0:-1]]), atol=0.02)
    assert [entry.name for entry in (tmp_path / "new").iterdir()] == ["a.mp4"]


def test_a_cell_that_a_kill_cut_short_is_made_again_and_one_of_other_settings_too(tmp_path: Path):
    made = []

    def make(value: int) -> dict:
        made.append(value)
        return {"value": value}

    cells = CellFolder(tmp_path, "command")
    (tmp_path / "cells").mkdir()
    (tmp_path / "cells" / "one.json.part").write_text('{"asked": {"rays"')
    assert cells.cell("one", {"rays": 4}, lambda: make(1))["value"] == 1
    assert cells.cell("one", {"rays": 4}, lambda: make(2))["value"] == 1
    assert cells.cell("one", {"rays": 8}, lambda: make(3))["value"] == 3
    assert cells.cell("one", {"rays": 8}, lambda: make(4), [tmp_path / "gone.png"])["value"] == 4
    kept = json.loads((tmp_path / "cells" / "one.json").read_text())
    assert made == [1, 3, 4] and {"command", "commit", "time", "machine"} == set(kept["made"])


def test_the_page_says_where_another_way_is_better():
    def cells(ours: float, other: float) -> dict:
        figures = {
            "ours_particles": {"psnr": ours, "ssim": 0.9},
            "gsp": {"psnr": other, "ssim": 0.8},
            "ours_gaussians": {"psnr": 27.0, "ssim": 0.7},
        }
        return {"static": {way: {"figures": values} for way, values in figures.items()}, "deformed": {}}

    ways = [VARIANTS[name] for name in ("gsp", "ours_particles", "ours_gaussians")]
    assert "Gaussians seen is **behind** GSP by 1.00 dB" in honesty({"ball": cells(30, 28)}, ways)
    assert "ahead of the best other (GSP) by 2.00 dB" in honesty({"ball": cells(30, 28)}, ways)
    assert "**behind** GSP by 1.00 dB" in honesty({"ball": cells(30, 31)}, ways)


def test_the_stiffer_jelly_is_stiffer_in_nothing_else(assets: Path):
    asset = replace(load_asset(assets / "ball_asset"), meters_per_unit=0.1)
    low, high = asset.mesh.vertices.amin(0), asset.mesh.vertices.amax(0)
    materials = []
    for matter in ({"preset": "jelly"}, {"preset": "jelly", "young_modulus": 10 * young_modulus(asset, "jelly")}):
        materials.append(make_material(parse_simulation_scene({"matter": matter}).matter, float((high - low).max()), asset.meters_per_unit))
    soft, stiff = materials
    assert stiff.young_modulus == pytest.approx(10 * soft.young_modulus)
    assert replace(stiff, young_modulus=soft.young_modulus) == soft


def test_means_are_over_the_scenes_that_every_way_has():
    ball, cube = {"psnr": 30.0, "ssim": 0.9}, {"psnr": 20.0, "ssim": 0.7}
    scores = {
        "ball": {"gsp": ball, "ours_mesh": ball},
        "cube": {"gsp": ball, "ours_mesh": cube},
        "man": {"ours_mesh": {"psnr": 50.0, "ssim": 1.0}},
    }
    ours, gsp = score_rows(scores, [VARIANTS["ours_mesh"], VARIANTS["gsp"]], "psnr")
    assert (ours["mean PSNR"], gsp["mean PSNR"], ours["mean SSIM"]) == ("25.00", "30.00", "0.800")
    assert "man PSNR" in ours and "man PSNR" not in gsp


def test_commands_for_readers_name_no_folder_of_this_machine():
    told = repeated(["/somewhere/out", "--scenes", "/data/scenes/teapot", "--assets", "/data/{scene}_asset", "--quick"])
    assert told == "python -m benchmarks paper OUT --scenes teapot --assets {scene}_asset --quick"


@pytest.mark.parametrize(
    ("more", "sentence"),
    [
        (["--spp", "0"], "--spp is 0"),
        (["--assets", "nowhere/{scene}"], "nowhere/ball holds no asset.json"),
        (["--lpips", __file__], "has the sha256 .*; expected alexnet.ckpt"),
    ],
)
def test_what_cannot_be_compared_is_refused(scene: Path, assets: Path, tmp_path: Path, more: list[str], sentence: str):
    with pytest.raises(ValueError, match=sentence):
        main(arguments(tmp_path / "out", scene, assets, *more))
