"""Progress is told by one record: a job's row and its answer hold the same fields, of the same types."""

import types
from typing import get_args, get_type_hints

import pytest

from drgs.reconstruct.progress import STAGE_SHARES, TOLD, Progress, plain_progress
from drgs_server.api.rest_records import JobInfo
from drgs_worker.jobs.requests import BindingName
from drgs_worker.store.database import JobRow

HINTS = get_type_hints(Progress)


def without_none(hint: object) -> type:
    """The type of a field that may be None, too."""
    (kept,) = {kind for kind in (get_args(hint) if isinstance(hint, types.UnionType) else (hint,)) if kind is not type(None)}
    return kept


@pytest.mark.parametrize("name", TOLD)
def test_every_field_of_progress_is_a_column_and_a_field_of_the_answer(name: str) -> None:
    assert JobInfo.model_fields[name].annotation == HINTS[name]
    column = JobRow.__table__.columns[name]
    assert column.type.python_type is without_none(HINTS[name])
    assert column.nullable == (type(None) in get_args(HINTS[name]))


def test_plain_progress_holds_all_but_the_picture() -> None:
    progress = Progress("fit", 3, 9, 0.4, 28.5, "", 12.0, b"\xff\xd8")
    assert Progress(**plain_progress(progress), preview_jpeg=progress.preview_jpeg) == progress


def test_every_binding_has_its_stages() -> None:
    assert set(STAGE_SHARES) == set(get_args(BindingName))
    assert all(sum(shares.values()) == pytest.approx(1) for shares in STAGE_SHARES.values())
