"""What is waited for at first is measured whole, and nothing stays behind, also where something fails."""

from pathlib import Path

import psutil
import pytest

from benchmarks.serve import cold
from benchmarks.serve.cold import Opening, compiled_modules, first_opening, main, render_seconds, seconds_of, served, write_camera
from drgs.convert.import_mesh import import_mesh
from drgs.scene.asset import save_asset
from drgs_server.live.messages import StartView
from tests.web.browser import write_ball


def descendants() -> list[psutil.Process]:
    return psutil.Process().children(recursive=True)


@pytest.mark.slow
def test_a_first_opening_is_timed_in_its_parts_and_leaves_nothing(tmp_path: Path) -> None:
    write_ball(tmp_path / "ball.ply")
    save_asset(import_mesh(tmp_path / "ball.ply"), tmp_path / "ball")
    before = {process.pid for process in descendants()}
    opening = first_opening(tmp_path / "ball", tmp_path)
    assert {process.pid for process in descendants()} == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["ball", "ball.ply"]

    found = opening.seconds()
    parts = [found[name] for name in ("serve_ready_s", "upload_s", "open_to_traced_s")]
    assert all(part > 0 for part in parts) and found["first_picture_s"] == sum(parts)
    # Who has shown an object before has loaded the renderer.
    assert 0 < found["next_open_to_traced_s"] < found["open_to_traced_s"]
    assert (opening.width, opening.height) == (400, 400)

    write_camera(tmp_path / "transforms.json", opening.view)
    render, client, nothing = (
        render_seconds(tmp_path / "ball", tmp_path), seconds_of(["-c", "from drgs import Client"]), seconds_of(["-c", ""]),
    )  # fmt: skip
    assert 0 < nothing < client < render


def test_medians_stand_beside_all_that_was_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    view = StartView(world_from_camera=((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 2), (0, 0, 0, 1)), fov_y_degrees=40)
    ready = iter([9.0, 1.0, 11.0, 3.0, 13.0, 2.0, 12.0])  # that which is not measured, then warm and fresh in turns

    def opened(asset: Path, folder: Path, kernels: Path | None = None) -> Opening:
        if kernels is not None:
            assert not any(kernels.iterdir())
            (kernels / "1.0" / "wp_one").mkdir(parents=True)
        return Opening(next(ready), 1.0, 0.5, None if kernels else 0.25, view, 400, 400)

    monkeypatch.setattr(cold, "first_opening", opened)
    monkeypatch.setattr(cold, "render_seconds", lambda asset, folder: 2.0)
    monkeypatch.setattr(cold, "seconds_of", lambda arguments: 0.125)
    found = cold.measure(tmp_path / "asset", tmp_path, repeats=3, fresh=True)
    assert found["serve_ready_s"] == 2 and found["values"]["serve_ready_s"] == [1, 3, 2]
    assert found["fresh_serve_ready_s"] == 12 and found["values"]["fresh_first_picture_s"] == [12.5, 14.5, 13.5]
    assert found["fresh_modules"] == 1 and found["values"].keys() == {name for name in found if name.endswith("_s")}
    assert {"first_picture_s", "next_open_to_traced_s", "render_first_s", "drgs_help_s", "import_client_s", "python_s"} <= found.keys()
    assert "fresh_next_open_to_traced_s" not in found and [path.name for path in tmp_path.iterdir()] == ["transforms.json"]


ANSWERS = """
import http.server
class Well(http.server.BaseHTTPRequestHandler):
    def do_GET(self):
        self.send_response(200)
        self.end_headers()
server = http.server.HTTPServer(("127.0.0.1", 0), Well)
print(f"http://127.0.0.1:{server.server_port}/#token=x", flush=True)
server.serve_forever()
"""
"""A server that is started and answers as `drgs serve` does, which the first test here starts and ends, without what takes it seconds to load."""


@pytest.mark.slow
def test_a_server_is_ended_where_its_user_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cold, "DRGS", ("-c", ANSWERS))
    others = descendants()  # of tests before, in the same process
    with pytest.raises(RuntimeError, match="on purpose"), served(tmp_path / "data", tmp_path / "kernels") as (address, seconds):
        assert seconds > 0 and "#token=" in address
        servers = [process for process in descendants() if process not in others]
        assert any("serve" in process.cmdline() for process in servers)
        raise RuntimeError("on purpose")
    left = [process.cmdline() for process in servers if process.is_running() and process.status() != psutil.STATUS_ZOMBIE]
    assert left == []


@pytest.mark.slow
def test_what_cannot_start_says_so(tmp_path: Path) -> None:
    (tmp_path / "data").write_text("no folder")
    with pytest.raises(ValueError, match="before it said its address"), served(tmp_path / "data"):
        pass
    with pytest.raises(ValueError, match="ended with 3: so it is"):
        seconds_of(["-c", "import sys; print('so it is', file=sys.stderr); sys.exit(3)"])
    with pytest.raises(ValueError, match="at least 1"):
        main(["--repeats", "0"])


def test_modules_are_counted_wherever_warp_s_version_puts_them(tmp_path: Path) -> None:
    (tmp_path / "1.19.0" / "wp_drgs.render_12ab").mkdir(parents=True)
    (tmp_path / "1.19.0" / "wp_drgs.render_12ab" / "wp_drgs.render_12ab.o").touch()
    assert len(compiled_modules(tmp_path)) == 1
