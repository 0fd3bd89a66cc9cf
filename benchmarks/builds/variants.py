"""Variants of a preset: a name and settings that differ, by dotted path on `Preset` (fit.densify.budget = 60000).

As a JSON or TOML file {name: {path: value}}, or as words: `base` (nothing differs), `many:fit.densify.budget=60000,materials.iterations=600`.
The path `preset` names another preset to begin with: `short:preset=full,surface.passes=6`.
A variant is checked against the preset before anything is built.
"""

import dataclasses
import json
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from drgs.reconstruct.presets import PRESETS

BASE = "base"


@dataclass(frozen=True)
class Variant:
    """A name, and by dotted path the values that differ from the preset's."""

    name: str
    overrides: dict[str, Any] = field(default_factory=dict)
    preset: str | None = None
    """That it begins with; None: that of the others."""


def read_variants(words: list[str]) -> list[Variant]:
    """Of files and words, in their order.

    Raises:
        ValueError: a file or word is not understood, or a name occurs twice.
    """
    variants: list[Variant] = []
    for word in words:
        if word.endswith((".json", ".toml")):
            variants += _from_file(Path(word))
        else:
            variants.append(_from_word(word))
    names = [variant.name for variant in variants]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"the variant {twice[0]} is given twice; expected names that differ")
    for name in names:
        if not name or not all(letter.isalnum() or letter in "-_." for letter in name):
            raise ValueError(f"the variant's name {name!r} names a folder; expected letters, digits, '-', '_' and '.'")
    return variants


def _from_file(path: Path) -> list[Variant]:
    try:
        text = path.read_text()
        document = json.loads(text) if path.suffix == ".json" else tomllib.loads(text)
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: is not a readable file of variants ({error})") from error
    if not isinstance(document, dict) or not all(isinstance(overrides, dict) for overrides in document.values()):
        raise ValueError(f'{path}: expected {{"name": {{"fit.iterations": 2000, ...}}, ...}}')
    return [_variant(name, _flat(overrides)) for name, overrides in document.items()]


def _variant(name: str, overrides: dict[str, Any]) -> Variant:
    preset = overrides.pop("preset", None)
    if preset is not None and preset not in PRESETS:
        raise ValueError(f"the variant {name} begins with the preset {preset!r}; expected one of {', '.join(PRESETS)}")
    return Variant(name, overrides, preset)


def _flat(overrides: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested tables, which is how TOML reads dotted keys, as dotted paths."""
    flat: dict[str, Any] = {}
    for key, value in overrides.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return flat


def _from_word(word: str) -> Variant:
    name, colon, rest = word.partition(":")
    if not colon:
        if word != BASE:
            raise ValueError(f"{word!r} is no variant; expected {BASE}, NAME:path=value,... or a .json or .toml file")
        return Variant(BASE)
    overrides = {}
    for part in rest.split(","):
        path, equals, value = part.partition("=")
        if not equals:
            raise ValueError(f"{part!r} of the variant {name} sets nothing; expected path=value")
        try:
            overrides[path] = json.loads(value)
        except json.JSONDecodeError:
            overrides[path] = value
    return _variant(name, overrides)


def apply_overrides(settings: Any, overrides: dict[str, Any]) -> Any:
    """The frozen record with these values in it.

    Raises:
        ValueError: a path does not exist, or a value is of another type than the one it replaces.
    """
    for path, value in overrides.items():
        settings = _with(settings, path.split("."), value, path)
    return settings


def _with(record: Any, keys: list[str], value: Any, path: str) -> Any:
    names = [entry.name for entry in dataclasses.fields(record)]
    key, *rest = keys
    if key not in names:
        raise ValueError(f"{path}: {type(record).__name__} has no {key!r}; it has {', '.join(names)}")
    present = getattr(record, key)
    if rest and not dataclasses.is_dataclass(present):
        raise ValueError(f"{path}: {key} is {present!r}, a value; expected the path to end there")
    inner = _with(present, rest, value, path) if rest else _checked(present, value, path)
    return dataclasses.replace(record, **{key: inner})


def _checked(present: Any, value: Any, path: str) -> Any:
    """The value as the type of the one it replaces; what is None may become anything plain."""
    if dataclasses.is_dataclass(present):
        names = [entry.name for entry in dataclasses.fields(present)]
        raise ValueError(f"{path}: is a {type(present).__name__}; expected a path into it: {', '.join(f'{path}.{name}' for name in names)}")
    if present is None or type(present) is type(value):
        return value
    if isinstance(present, float) and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if isinstance(present, tuple) and isinstance(value, list):
        return tuple(value)
    raise ValueError(f"{path}: {value!r} is no {type(present).__name__}; now it is {present!r}")
