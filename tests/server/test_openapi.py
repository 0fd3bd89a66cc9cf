"""The OpenAPI document says what is so: every body has an example that its own schema takes, and answers are of the kinds it names."""

import json
from collections.abc import Iterator
from typing import Any

import pytest
from conftest import Service
from pydantic import BaseModel
from test_rest import exr, zipped
from test_uploads import uploaded

from drgs_server.api import rest_records
from drgs_server.api.openapi_document import EXAMPLES, FILES, UPLOADS
from drgs_server.live import messages
from drgs_worker.jobs.requests import JOB_REQUESTS

jsonschema_rs = pytest.importorskip("jsonschema_rs", reason="comes with schemathesis: pip install -e '.[dev]'")


def bodies(document: dict) -> Iterator[tuple[str, str, dict]]:
    """(where, media type, body) of every request and answer."""
    for path, calls in document["paths"].items():
        for method, call in calls.items():
            for media, body in call.get("requestBody", {}).get("content", {}).items():
                yield f"{method} {path}", media, body
            for status, answer in call["responses"].items():
                for media, body in answer.get("content", {}).items():
                    yield f"{method} {path} {status}", media, body


def validator(schema: dict, document: dict) -> Any:
    return jsonschema_rs.Draft202012Validator({**schema, "components": document["components"]}, validate_formats=True)


@pytest.fixture(scope="module")
def document(lasting_service: Service) -> dict:
    return lasting_service.client.get("/api/openapi.json").json()


def test_every_json_body_has_examples_and_its_schema_takes_them(document: dict) -> None:
    checked = 0
    for where, media, body in bodies(document):
        if media in ("application/json", "application/problem+json", "text/plain"):
            assert body.get("examples"), f"{where} has no example"
            check = validator(body["schema"], document)
            for title, example in body["examples"].items():
                assert check.is_valid(example["value"]), (
                    f"{where}, {title}: {[str(error) for error in check.iter_errors(example['value'])]}"
                )
                checked += 1
    assert checked > 100


def test_a_wrong_example_would_be_found(document: dict) -> None:
    body = document["paths"]["/api/sessions"]["post"]["responses"]["201"]["content"]["application/json"]
    value = json.loads(json.dumps(next(iter(body["examples"].values()))["value"]))
    assert validator(body["schema"], document).is_valid(value)
    for wrong in (
        value | {"revision": "three"},
        value | {"colour": 1},
        {k: v for k, v in value.items() if k != "asset"},
        value | {"created_at": "soon"},
    ):
        assert not validator(body["schema"], document).is_valid(wrong)


@pytest.mark.parametrize("name", sorted(EXAMPLES))
def test_the_models_themselves_take_the_examples_and_no_field_is_left_out(name: str) -> None:
    model: type[BaseModel] = getattr(rest_records, name, None) or getattr(messages, name)
    for value in EXAMPLES[name].values():
        made = model.model_validate_json(json.dumps(value))
        assert set(value) == set(model.model_fields), "an example shows every field"
        assert model.model_validate(made.model_dump()) == made


def test_the_examples_of_jobs_are_requests_that_are_taken(document: dict) -> None:
    examples = document["paths"]["/api/jobs"]["post"]["requestBody"]["content"]["application/json"]["examples"]
    assert set(examples) >= set(JOB_REQUESTS)
    for example in examples.values():
        JOB_REQUESTS[example["value"]["kind"]].model_validate(example["value"])


def test_errors_are_documented_as_the_problems_that_they_are(service: Service, document: dict) -> None:
    assert "HTTPValidationError" not in json.dumps(document)
    schema = {"$ref": "#/components/schemas/Problem"}
    for calls in document["paths"].values():
        for call in calls.values():
            assert call["responses"]["default"]["content"]["application/problem+json"]["schema"] == schema
    for answer in (service.client.get("/api/jobs?limit=0"), service.client.get("/api/assets/none"), service.anonymous.get("/api/jobs")):
        assert validator(schema, document).is_valid(answer.json())


@pytest.mark.slow
def test_answers_are_of_the_kinds_and_shapes_that_the_document_names(service: Service, document: dict) -> None:
    session, asset = service.open_session(), "a" * 32
    name = service.client.post("/api/environments", files={"file": ("sky.exr", exr(8, 16))}).json()["name"]
    job = service.client.post("/api/jobs", files={"file": ("a.zip", zipped({"transforms.json": b"{}"}))}).json()["id"]
    service.context.directory.asset(asset).joinpath("thumb.jpg").write_bytes(b"\xff\xd8")
    weights = service.client.post("/api/weights", content=bytes(4)).json()["file"].rpartition("/")[2]
    capture = uploaded(service, zipped({"transforms.json": b"{}"}))
    service.client.post("/api/captures", json={"upload": capture})
    known = {
        "session_id": session,
        "asset_id": asset,
        "job_id": job,
        "suffix": "png",
        "number": 0,
        "weights_name": weights,
        "version": "0f" * 16,
    }
    known |= {"capture_id": capture, "upload_id": capture}
    asked = 0
    for path, calls in document["paths"].items():
        address = path.format(**{"name": name} | known)
        if "get" not in calls or path.endswith(("/export", "/files/{name}")):
            continue
        answer = service.client.get(address, params={"width": 16, "height": 16, "spp": 4} if "frame" in path else None)
        if answer.status_code == 404:  # no preview yet, no pictures, no masks, no light of its own, no photographs
            assert path.endswith(("preview.jpg", "sheet.jpg", "/{number}.jpg", "/{version}.jpg", "environment.exr", "photograph.webp")), (
                path
            )
            continue
        content = calls["get"]["responses"]["200"]["content"]
        media = answer.headers["content-type"].split(";")[0]
        assert media in content, f"{path} answers {media}; documented: {list(content)}"
        if media == "application/json":
            errors = [str(error) for error in validator(content[media]["schema"], document).iter_errors(answer.json())]
            assert not errors, f"{path}: {errors}"
        asked += 1
    assert asked > 12 and set(FILES) | set(UPLOADS) <= set(document["paths"])


def test_the_page_of_calls_shows_the_examples(service: Service) -> None:
    page = service.client.get("/api/docs").text
    assert "Example: clip of a simulate job" in page and "<script" not in page
