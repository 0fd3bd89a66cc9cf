"""Variants of a session over REST and the client: edits that change nothing by themselves, put in force, renamed and undone; and in its GLB and page."""

import base64
import json
import re
import struct
import subprocess
import sys
import zlib
from pathlib import Path
from typing import Any

import pytest
from conftest import Service
from pydantic import BaseModel
from test_rest import is_problem
from test_versions import opened

from drgs.scene.edits import AS_CAPTURED, AS_SHOWN
from drgs_server.client_variants import SessionVariants


def rough(value: float) -> dict:
    return {"op": "material", "select": {"all": True}, "set": {"roughness": value}}


def variants_of(service: Service, session: str) -> SessionVariants:
    """The client's part, over the test's own connection."""

    def call(method: str, path: str, model: type[BaseModel], timeout: float = 0, **options: Any) -> BaseModel:
        answer = service.client.request(method, path, **options)
        assert answer.status_code == 200, answer.text
        return model.model_validate_json(answer.content)

    return SessionVariants(call, session)


@pytest.mark.slow
def test_a_variant_is_kept_renamed_worn_and_undone(service: Service) -> None:
    session = service.open_session()
    variants = variants_of(service, session)
    for edit in (rough(0.1), {"op": "environment", "rotation": 30}):
        assert service.client.post(f"/api/sessions/{session}/edits", json={"edit": edit}).status_code == 200
    assert [edit.op for edit in variants.keep("Smooth").edits] == ["material", "environment", "variant"]
    variants.keep("Matt", [rough(0.9)])
    assert [(one.name, [edit.set.roughness for edit in one.edits]) for one in variants.all()] == [("Smooth", [0.1]), ("Matt", [0.9])]
    worn = variants.apply("Matt").edits
    assert [edit.op for edit in worn] == ["environment", "variant", "variant", "material"]
    assert worn[-1].op == "material" and worn[-1].set.roughness == 0.9
    variants.rename("Matt", "Dull & dark")
    assert [one.name for one in variants.all()] == ["Smooth", "Dull & dark"]
    variants.remove("Dull & dark")
    assert [one.name for one in variants.all()] == ["Smooth"]
    for _ in range(3):  # the removal, the name, and what is in force
        assert service.client.post(f"/api/sessions/{session}/undo").status_code == 200
    assert [one.name for one in variants.all()] == ["Smooth", "Matt"]
    first = service.client.get(f"/api/sessions/{session}").json()["edits"][0]
    assert first["op"] == "material" and first["set"]["roughness"] == 0.1


def test_what_cannot_be_done_to_a_variant_is_a_sentence(service: Service) -> None:
    path = f"/api/sessions/{service.open_session()}/variants"
    for name in ("One", "Two"):
        assert service.client.put(f"{path}/{name}", json={"edits": [rough(0.5)]}).status_code == 200
    is_problem(service.client.post(f"{path}/Three/apply"), 404)
    is_problem(service.client.delete(f"{path}/Three"), 404)
    is_problem(service.client.post(f"{path}/Three/rename", json={"name": "Four"}), 404)
    is_problem(service.client.post(f"{path}/One/rename", json={"name": "Two"}), 409)
    is_problem(service.client.put(f"{path}/{AS_CAPTURED}"), 422)
    is_problem(service.client.put(f"{path}/Painted", json={"edits": [rough(0.5) | {"select": {"weights_file": "weights/none.f32"}}]}), 422)
    is_problem(service.client.put(f"{path}/Lit", json={"edits": [{"op": "environment", "rotation": 30}]}), 422)
    assert [one["name"] for one in service.client.get(path).json()["variants"]] == ["One", "Two"]


@pytest.mark.slow
def test_a_glb_of_a_session_holds_its_variants(service: Service, tmp_path: Path) -> None:
    _, session = opened(service, tmp_path)
    assert service.client.put(f"/api/sessions/{session}/variants/Matt", json={"edits": [rough(0.9)]}).status_code == 200

    def names() -> list[str]:
        answer = service.client.get(f"/api/sessions/{session}/export?format=mesh")
        assert answer.status_code == 200, answer.text
        (length,) = struct.unpack_from("<I", answer.content, 12)
        found = json.loads(answer.content[20 : 20 + length])
        assert [material["name"] for material in found["materials"]] == names_of(found)
        return names_of(found)

    def names_of(found: dict) -> list[str]:
        return [one["name"] for one in found["extensions"]["KHR_materials_variants"]["variants"]]

    assert names() == [AS_SHOWN, "Matt"]
    kept = [{"op": "variant", "name": "Matt", "edits": [rough(0.9)]}]
    assert service.client.put(f"/api/sessions/{session}/edits", json={"edits": kept}).status_code == 200
    assert names() == [AS_CAPTURED, "Matt"]


@pytest.mark.slow
def test_a_page_of_a_session_holds_its_variants(service: Service, tmp_path: Path) -> None:
    subprocess.run(
        [sys.executable, Path(__file__).parents[2] / "web" / "build.py"], check=True
    )  # the page's program, as browser tests have it made
    _, session = opened(service, tmp_path)
    assert service.client.put(f"/api/sessions/{session}/variants/Matt", json={"edits": [rough(0.9)]}).status_code == 200
    answer = service.client.get(f"/api/sessions/{session}/export?format=html")
    assert answer.status_code == 200, answer.text
    (packed,) = re.findall(r'type="text/plain">([^<]+)<', answer.text)
    data = zlib.decompress(base64.b64decode(packed))
    (length,) = struct.unpack_from("<I", data)
    assert json.loads(data[4 : 4 + length])["materials"] == [AS_SHOWN, "Matt"]
