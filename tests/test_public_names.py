"""Users' type checkers know the public names, although each is imported when it is first used."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import drgs

ROOT = Path(__file__).parent.parent
USER_CODE = """
from pathlib import Path

import drgs
from drgs import Client

asset = drgs.load_asset("out/teapot")
scene = drgs.pose_scene(asset, drgs.parse_edits([]), base_directory=Path("."))
reveal_type(drgs.render_frame(scene, asset.cameras[0], drgs.RenderSettings(bounces=2)))
reveal_type(Client("http://127.0.0.1:8000").assets())
drgs.render_frame(asset)
drgs.rendr_frame(scene)
"""


def test_type_checkers_are_told_the_names_that_are_there():
    tree = ast.parse(Path(drgs.__file__).read_text())
    told = {
        alias.asname: node.module
        for block in tree.body
        if isinstance(block, ast.If)
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert told == drgs._modules


@pytest.mark.slow
def test_users_code_is_checked(tmp_path: Path):
    program = tmp_path / "program.py"
    program.write_text(USER_CODE)
    found = subprocess.run([sys.executable, "-m", "mypy", str(program)], cwd=ROOT, capture_output=True, text=True, timeout=600).stdout
    notes = [line.partition(": ")[2] for line in found.splitlines()]
    assert 'note: Revealed type is "drgs.render.records.Frame"' in notes, found
    assert 'note: Revealed type is "drgs_server.api.rest_records.AssetList"' in notes, found
    assert any("Missing positional argument" in note for note in notes), found
    assert any('Module has no attribute "rendr_frame"' in note for note in notes), found
    assert sum(note.startswith("error: ") for note in notes) == 3, found
