"""Names of users: one type, wherever they come in. What is allowed comes back as it went in, what is not is refused with a sentence."""

import string
import unicodedata
from urllib.parse import quote

import pytest
from conftest import Service
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from pydantic import TypeAdapter, ValidationError
from test_rest import is_problem, zipped

from drgs_worker.store.user_names import LONGEST_NAME, UserName, name_from_file

GOOD = [
    "Version 1",
    "before",
    "v2",
    "x00",
    "1f",
    "Grüße",
    "杯子",
    "\u0645\u06cc\u200c\u062e",
    "a.b",
    ".hidden",
    "\N{TEACUP WITHOUT HANDLE}",
    "50 %?#&+",
    "n" * 100,
]
BAD = ["", " ", ".", "..", "a/b", "a\\b", "two\nlines", "nul\0", "\x1b[2J", "\x7f", "\x85", "a\u2028b", "\u202egnp.exe", "n" * 101]
UNSEEN = [
    "\u200b",
    "\ufeff",
    "\u2060\u200e",
    "\xad",
    "\u3164",
    "\u2800 \u2800",
    "\u115f\u1160",
    "\u0300\u0301",
    "\ufe0f",
    "\u034f",
    "\U000e0041",
]
ADAPTER = TypeAdapter(UserName)


@pytest.mark.parametrize("name", GOOD)
def test_names_that_people_choose_are_taken(name: str) -> None:
    assert ADAPTER.validate_python(name) == name


@pytest.mark.parametrize("name", BAD)
def test_what_is_no_line_of_text_is_no_name(name: str) -> None:
    with pytest.raises(ValidationError):
        ADAPTER.validate_python(name)


@pytest.mark.parametrize("name", UNSEEN)
def test_what_cannot_be_seen_is_no_name(name: str) -> None:
    """Two of them would look alike in every list."""
    with pytest.raises(ValidationError):
        ADAPTER.validate_python(name)
    assert name_from_file(name, "upload") == "upload"


@given(st.text(max_size=130))
@example("e\u0301")
@example(" two words ")
@settings(max_examples=300, deadline=None)
def test_a_name_is_a_line_that_stays_as_it_is(text: str) -> None:
    try:
        name = ADAPTER.validate_python(text)
    except ValidationError:
        return
    assert ADAPTER.validate_python(name) == name == unicodedata.normalize("NFC", name).strip()
    assert 0 < len(name) <= LONGEST_NAME and name.isprintable() | any(unicodedata.category(c) in ("Zs", "Cf", "Cn", "Co") for c in name)
    assert not set(name) & set("/\\\0\n\r") and name not in (".", "..") and len(name.splitlines()) == 1
    name.encode()


@given(st.text(st.characters(exclude_categories=[]), max_size=300))
@settings(max_examples=200, deadline=None)
def test_every_file_has_a_name_to_be_called_by(stem: str) -> None:
    name = name_from_file(stem, "upload")
    assert ADAPTER.validate_python(name) == name


def test_snapshots_come_back_by_their_names(service: Service) -> None:
    url = f"/api/sessions/{service.open_session()}/snapshots"

    @settings(max_examples=25, deadline=None, database=None, derandomize=True, suppress_health_check=list(HealthCheck))
    @given(
        st.text(st.sampled_from(string.printable + "éß杯\u202e\u2028\0"), min_size=1, max_size=12).filter(
            lambda text: text not in (".", "..")
        )
    )
    @example("Version 1")
    @example("before")
    @example("v2")
    def take(text: str) -> None:
        address = f"{url}/{quote(text, safe='')}"
        taken = service.client.put(address)
        try:
            name = ADAPTER.validate_python(text)
        except ValidationError:
            assert taken.status_code in (404, 405, 422), (text, taken.text)  # a slash makes it another address
            return
        assert taken.status_code == 200 and taken.json()["name"] == name
        assert name in {found["name"] for found in service.client.get(url).json()["snapshots"]}
        assert service.client.post(f"{address}/restore").status_code == 200
        assert service.client.delete(address).status_code == 204

    take()


def test_assets_jobs_versions_and_environments_have_the_same_names(service: Service) -> None:
    session = service.open_session()
    upload = {"file": ("capture.zip", zipped({"transforms.json": b"{}"}))}
    for name in ("two\nlines", "a/b", "n" * 101):
        for answer in (
            service.client.post("/api/jobs", files=upload, data={"name": name}),
            service.client.post("/api/jobs", json={"dataset": "sample", "name": name}),
            service.client.post("/api/assets", files={"file": ("a.obj", b"v")}, data={"name": name}),
            service.client.post("/api/environments", files={"file": ("a.exr", b"v")}, data={"name": name}),
            service.client.post(f"/api/sessions/{session}/save", json={"name": name}),
        ):
            assert "name" in is_problem(answer, 422)
    made = service.client.post("/api/jobs", files={"file": ("my\u202emug.zip", zipped({"transforms.json": b"{}"}))})
    assert made.status_code == 202 and made.json()["name"] == "my-mug"
