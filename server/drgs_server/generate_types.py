"""Write web/src/session/protocol.gen.ts from the pydantic models of the stream and of REST, and constants.gen.ts beside it from drgs.

Run `python -m drgs_server.generate_types` after changing messages.py, frame_header.py, rest_records.py, drgs/maths/constants.py
or drgs/exchange/export_formats.py; a test fails until it was run.
Input: JSON Schema as pydantic states it. Client messages and requests are written as their validator reads them (fields
with defaults are optional), answers as they are serialised (every field is there).
"""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel
from pydantic.json_schema import models_json_schema

from drgs.exchange import export_formats
from drgs.exchange.export_formats import FILE_KINDS, SPLAT_KINDS
from drgs.maths import constants
from drgs.scene.edits import Edit
from drgs_server.api import rest_records
from drgs_server.live import frame_header, messages

Mode = Literal["validation", "serialization"]

OUTPUT = Path(__file__).resolve().parents[2] / "web" / "src" / "session" / "protocol.gen.ts"
CONSTANTS_OUTPUT = OUTPUT.with_name("constants.gen.ts")

_VIEWER_CONSTANTS = (
    "F0",
    "LUMINANCE_RED",
    "LUMINANCE_GREEN",
    "LUMINANCE_BLUE",
    "SRGB_SLOPE",
    "SRGB_LINEAR_END",
    "SRGB_ENCODED_END",
    "SRGB_SCALE",
    "SRGB_OFFSET",
    "SRGB_GAMMA",
    "MIDDLE_GREY",
    "STILL_BOUNCES",
)
_EXPORT_CONSTANTS = ("DEFAULT_FACES", "FEWEST_FACES", "MOST_FACES")
_CONSTANTS = (
    "PROTOCOL_VERSION",
    "MAX_FRAMES_IN_FLIGHT",
    "CLOSE_VERSION_MISMATCH",
    "MAX_SIDE",
    "MAX_PIXELS",
    "MAX_STILL_PIXELS",
    "MAX_LAYERED_PIXELS",
    "MAX_STILL_SAMPLES",
    "LEAST_SHOWN_ERROR",
    "NO_CERTAINTY",
)
_FRAME_CONSTANTS = (
    "FRAME_KIND_PICTURE",
    "CODEC_JPEG",
    "CODEC_PNG",
    "FLAG_MOVING",
    "FLAG_CONVERGED",
    "FLAG_ALPHA",
    "CAMERA_NUMBER_SHIFT",
)

_REQUESTS: tuple[type[BaseModel], ...] = (
    rest_records.CaptureRequest,
    rest_records.MasksRequest,
    rest_records.BuildRequest,
    rest_records.PoseRequest,
    rest_records.RedecoupleRequest,
    rest_records.SimulateRequest,
    rest_records.RenderRequest,
    rest_records.ExportRequest,
    rest_records.SessionRequest,
    rest_records.EditRequest,
    rest_records.EditsRequest,
    rest_records.SaveRequest,
    rest_records.TokenRequest,
)
_ANSWERS: tuple[type[BaseModel], ...] = (
    rest_records.CaptureInfo,
    rest_records.CaptureList,
    rest_records.CaptureLook,
    rest_records.CaptureMasks,
    rest_records.JobInfo,
    rest_records.JobList,
    rest_records.JobFileList,
    rest_records.AssetInfo,
    rest_records.AssetList,
    rest_records.TrainingViewList,
    rest_records.EnvironmentInfo,
    rest_records.EnvironmentList,
    rest_records.SessionInfo,
    rest_records.SessionList,
    rest_records.WeightsInfo,
    rest_records.SnapshotInfo,
    rest_records.SnapshotList,
    rest_records.Problem,
)

_HEADER_TYPE = """/** The 24 little-endian bytes before each picture; see docs/protocol.md. */
export interface FrameHeader {
  kind: number;
  codec: number;
  flags: number;
  frameId: number;
  stateRev: number;
  width: number;
  height: number;
  spp: number;
  sppTarget: number;
  renderMicroseconds: number;
}

export const FRAME_HEADER_BYTES = 24;

export function readFrameHeader(buffer: ArrayBuffer): FrameHeader {
  const view = new DataView(buffer, 0, FRAME_HEADER_BYTES);
  return {
    kind: view.getUint8(0),
    codec: view.getUint8(1),
    flags: view.getUint16(2, true),
    frameId: view.getUint32(4, true),
    stateRev: view.getUint32(8, true),
    width: view.getUint16(12, true),
    height: view.getUint16(14, true),
    spp: view.getUint16(16, true),
    sppTarget: view.getUint16(18, true),
    renderMicroseconds: view.getUint32(20, true),
  };
}
"""


def _union(members: Iterable[str]) -> str:
    return " | ".join(dict.fromkeys(members))


def typescript_from_schema(schema: dict) -> str:
    """The TypeScript type of one JSON Schema node.

    Raises:
        ValueError: the node uses something this writer does not know.
    """
    if "$ref" in schema:
        return schema["$ref"].rsplit("/", 1)[1]
    if "const" in schema:
        return json.dumps(schema["const"])
    if "enum" in schema:
        return _union(json.dumps(value) for value in schema["enum"])
    for key in ("anyOf", "oneOf"):
        if key in schema:
            return _union(typescript_from_schema(member) for member in schema[key])
    kind = schema.get("type")
    if kind in ("number", "integer"):
        return "number"
    if kind in ("string", "boolean", "null"):
        return kind
    if kind == "array":
        if "prefixItems" in schema:
            return "[" + ", ".join(typescript_from_schema(member) for member in schema["prefixItems"]) + "]"
        item = typescript_from_schema(schema["items"])
        return f"({item})[]" if " | " in item else f"{item}[]"
    if kind == "object":
        if "properties" not in schema:
            return "Record<string, unknown>"
        raise ValueError("an object with properties must be a named model")
    if not kind:
        return "unknown"
    raise ValueError(f"no TypeScript for {schema}")


def _comment(text: str, indent: str) -> str:
    lines = [line.strip() for line in text.strip().splitlines()]
    if len(lines) == 1:
        return f"{indent}/** {lines[0]} */\n"
    return f"{indent}/**\n" + "".join(f"{indent} * {line}".rstrip() + "\n" for line in lines) + f"{indent} */\n"


def _interface(name: str, schema: dict) -> str:
    # x-optional: came later than the rest, so that pages may make such a message without it.
    required = {field for field in schema.get("required", ()) if not schema["properties"][field].get("x-optional")}
    text = _comment(schema["description"], "") if "description" in schema else ""
    text += f"export interface {name} {{\n"
    for field, node in schema.get("properties", {}).items():
        if "description" in node:
            text += _comment(node["description"], "  ")
        text += f"  {field}{'' if field in required else '?'}: {typescript_from_schema(node)};\n"
    return text + "}\n"


def typescript_text() -> str:
    """The whole of protocol.gen.ts."""
    pairs: list[tuple[type[BaseModel], Mode]] = [(model, "validation") for model in (*_REQUESTS, *_union_models(messages.ClientMessage))]
    pairs += [(model, "serialization") for model in (*_ANSWERS, *_union_models(messages.ServerMessage))]
    names, document = models_json_schema(pairs, ref_template="#/$defs/{model}")
    wanted = {key: node["$ref"].rsplit("/", 1)[1] for key, node in names.items()}
    definitions = document["$defs"]

    text = "// Written by `python -m drgs_server.generate_types` from messages.py and frame_header.py of server/drgs_server/live and server/drgs_server/api/rest_records.py. Do not edit.\n\n"
    for module, names_there in ((messages, _CONSTANTS), (frame_header, _FRAME_CONSTANTS)):
        for constant in names_there:
            text += f"export const {constant} = {json.dumps(getattr(module, constant))};\n"
    text += "\n" + _HEADER_TYPE + "\n"
    for name in sorted(definitions):
        node = definitions[name]
        if node.get("type") == "object" and "properties" in node:
            text += _interface(_plain_name(name), _renamed(node)) + "\n"
        else:
            text += f"export type {_plain_name(name)} = {typescript_from_schema(_renamed(node))};\n\n"
    unions: tuple[tuple[str, Mode, tuple[type[BaseModel], ...]], ...] = (
        ("ClientMessage", "validation", _union_models(messages.ClientMessage)),
        ("ServerMessage", "serialization", _union_models(messages.ServerMessage)),
    )
    for union, mode, models in unions:
        text += f"export type {union} =\n  | " + "\n  | ".join(_plain_name(wanted[model, mode]) for model in models) + ";\n\n"
    edits = _union_models(Edit)
    spelled = " | ".join(model.__name__ for model in edits)
    text = text.replace(f"({spelled})[]", "Edit[]").replace(spelled, "Edit")
    text += "export type Edit =\n  | " + "\n  | ".join(model.__name__ for model in edits) + ";\n"
    return text


def constants_text() -> str:
    """The whole of constants.gen.ts: numbers of drgs/maths/constants.py that the viewer reckons with, and the kinds of file to save."""
    text = "// Written by `python -m drgs_server.generate_types` from drgs/maths/constants.py and drgs/exchange/export_formats.py. Do not edit.\n\n"
    for constant in _VIEWER_CONSTANTS:
        text += f"export const {constant} = {getattr(constants, constant)!r};\n"
    for constant in _EXPORT_CONSTANTS:
        text += f"export const {constant} = {getattr(export_formats, constant)!r};\n"
    text += f"\nexport type DownloadFormat = {_union(json.dumps(name) for name in FILE_KINDS)};\n\n"
    text += _comment("In the order in which they are offered.", "")
    text += (
        "export const FILE_KINDS: { format: DownloadFormat; suffix: string; title: string; description: string; textured: boolean }[] = [\n"
    )
    for name, kind in FILE_KINDS.items():
        fields = {"format": name, "suffix": kind.suffix, "title": kind.title, "description": kind.description, "textured": kind.textured}
        text += "  { " + ", ".join(f"{key}: {json.dumps(value)}" for key, value in fields.items()) + " },\n"
    text += f"];\n\nexport type SplatFormat = {_union(json.dumps(name) for name in SPLAT_KINDS)};\n\n"
    text += _comment("What the browser writes of the Gaussians by itself.", "")
    text += "export const SPLAT_KINDS: { format: SplatFormat; suffix: string; title: string; description: string }[] = [\n"
    for splat_format, kind in SPLAT_KINDS.items():
        fields = {"format": splat_format, "suffix": kind.suffix, "title": kind.title, "description": kind.description}
        text += "  { " + ", ".join(f"{key}: {json.dumps(value)}" for key, value in fields.items()) + " },\n"
    return text + "];\n"


def _union_models(annotated: object) -> tuple[type[BaseModel], ...]:
    """The models of Annotated[A | B | ..., Field(discriminator)]."""
    return annotated.__origin__.__args__  # type: ignore[attr-defined]


def _plain_name(name: str) -> str:
    """Where a model is written both ways pydantic says X-Input and X-Output; TypeScript gets XInput and X."""
    return name.replace("-Input", "Input").replace("-Output", "")


def _renamed(node: Any) -> Any:
    if isinstance(node, dict):
        return {key: _plain_ref(value) if key == "$ref" else _renamed(value) for key, value in node.items()}
    if isinstance(node, list):
        return [_renamed(member) for member in node]
    return node


def _plain_ref(reference: str) -> str:
    head, name = reference.rsplit("/", 1)
    return f"{head}/{_plain_name(name)}"


def main() -> None:
    OUTPUT.parent.mkdir(parents=True, exist_ok=True)
    for path, text in ((OUTPUT, typescript_text()), (CONSTANTS_OUTPUT, constants_text())):
        path.write_text(text)
        print(f"wrote {path}")


if __name__ == "__main__":
    main()
