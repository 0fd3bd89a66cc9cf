"""Strokes over pictures of a capture that say what is the object and what is not: one schema for file, REST and page.

{"strokes": [{"picture": "r_007", "shows": "object", "radius": 0.01, "points": [[0.4, 0.5], [0.6, 0.52]]}, ...]}
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

MOST_STROKES = 200
MOST_POINTS = 1000
"""Of one stroke."""
WIDEST = 0.2
DEFAULT_RADIUS = 0.008

Place = tuple[Annotated[float, Field(ge=0, le=1)], Annotated[float, Field(ge=0, le=1)]]


class Stroke(BaseModel):
    """A way over a picture, as the build sees it: upright, and without lens distortion."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True, use_attribute_docstrings=True)

    picture: Annotated[str, Field(min_length=1, max_length=1000)]
    """Name of its file, without its ending."""
    shows: Literal["object", "background"]
    radius: Annotated[float, Field(gt=0, le=WIDEST)] = DEFAULT_RADIUS
    """Half its width, as a share of the picture's longer side."""
    points: Annotated[list[Place], Field(min_length=1, max_length=MOST_POINTS)]
    """x to the right and y down, as shares of the picture's width and height; joined by straight lines."""


StrokeList = Annotated[list[Stroke], Field(max_length=MOST_STROKES)]

_STROKES: TypeAdapter[list[Stroke]] = TypeAdapter(StrokeList)


def read_strokes(path: Path) -> tuple[Stroke, ...]:
    """The strokes of a file.

    Raises:
        ValueError: it is no JSON, or holds something else; one sentence. OSError: it cannot be read.
    """
    try:
        document = json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: no JSON ({error}), expected an object with a list `strokes`.") from error
    if not isinstance(document, dict) or set(document) != {"strokes"}:
        raise ValueError(f"{path}: expected a JSON object with a list `strokes` and nothing else.")
    return parse_strokes(document["strokes"], str(path))


def parse_strokes(plain: object, where: str) -> tuple[Stroke, ...]:
    """Strokes out of plain data.

    Raises:
        ValueError: a sentence that begins with `where`.
    """
    try:
        return tuple(_STROKES.validate_python(plain))
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = ".".join(str(part) for part in first["loc"])
        raise ValueError(f"{where}: strokes{'.' if place else ''}{place}: {first['msg']}.") from error


def plain_strokes(strokes: Sequence[Stroke]) -> list[dict]:
    """For JSON."""
    return [stroke.model_dump(mode="json") for stroke in strokes]
