"""The OpenAPI document as callers need it: an example of every body, problems as they really are, files as what they are.

In: the document that FastAPI derives from the routes. Out: the same with examples by the name of each schema, RFC 9457 problems in place of
FastAPI's own kind of error, the media types of pictures and downloads, and the multipart bodies of uploads, which routes read by hand.
tests/server/test_openapi.py compares each example with the schema that it illustrates.
"""

from typing import Any

from drgs_server.api.rest_records import Problem

ASSET, JOB, SESSION, CAPTURE = "5c0ffee0" * 4, "b01dface" * 4, "feedbead" * 4, "decade50" * 4
_MATERIAL = {"op": "material", "select": {"all": True}, "set": {"roughness": 0.1, "metallic": 1.0}, "mode": "absolute"}
_LIGHT = {"op": "environment", "file": "studio.exr", "rotation": 30.0, "intensity": 1.0}
_LOG = {"revision": 3, "edits": [_MATERIAL, _LIGHT], "can_undo": True, "can_redo": False, "appended": 2, "undone": [], "broken": []}
_JOB: dict[str, Any] = {
    "id": JOB,
    "kind": "build",
    "name": "Mug",
    "preset": "fast",
    "priority": 100,
    "state": "running",
    "created_at": "2026-11-20T10:00:00Z",
    "finished_at": None,
    "stage": "fit",
    "iteration": 1200,
    "iterations": 4000,
    "fraction": 0.21,
    "psnr": 29.4,
    "eta_seconds": 190.0,
    "message": "",
    "attempts": 1,
    "asset_id": None,
    "capture_id": None,
    "source_asset": None,
    "clip": None,
    "error": None,
    "capture": {
        "summary": "64 pictures of 800x800 with masks; the object fills 21 % of them.",
        "findings": [
            {
                "level": "warning",
                "sentence": "No view from azimuths within 40 degrees of 120.",
                "advice": "Add pictures from there: that side's shape and material will be guessed.",
            }
        ],
    },
    "preview_version": 12,
}
_CAPTURE = {"id": CAPTURE, "name": "Mug", "created_at": "2026-11-20T09:58:00Z", "jobs": [JOB]}
_ASSET = {
    "id": ASSET,
    "name": "Mug",
    "created_at": "2026-11-20T10:04:00Z",
    "bytes": 41_000_000,
    "source": "build",
    "surfel_count": 52_000,
    "vertex_count": 20_400,
    "face_count": 40_800,
    "has_thumbnail": True,
    "version": 1,
    "parent_id": None,
    "edits": [],
    "deleted_at": None,
}
_VIEW = {
    "name": "r_000",
    "width": 400,
    "height": 400,
    "world_from_camera": [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, -4.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]],
    "left": -0.36,
    "right": 0.36,
    "bottom": -0.36,
    "top": 0.36,
}
_ENVIRONMENT = {"name": "studio.exr", "title": "Studio", "width": 1024, "height": 512}
_SESSION = {"id": SESSION, "asset": ASSET, "asset_name": "Mug", "created_at": "2026-11-20T10:10:00Z", "viewers": 1} | _LOG
_SNAPSHOT = {"name": "chrome", "created_at": "2026-11-20T10:12:00Z", "revision": 3, "edits": [_MATERIAL, _LIGHT]}

_SHEET: dict[str, Any] = {
    "count": 64,
    "columns": 10,
    "left": 0.002,
    "top": 0.05,
    "across": 0.1,
    "down": 0.13,
    "width": 0.097,
    "aspect": 0.88,
}
_STROKES = [
    {"picture": "r_007", "shows": "object", "radius": 0.008, "points": [[0.4, 0.5], [0.6, 0.52]]},
    {"picture": "r_007", "shows": "background", "radius": 0.02, "points": [[0.1, 0.7], [0.3, 0.9]]},
]

EXAMPLES: dict[str, dict[str, Any]] = {
    "AssetInfo": {
        "built": _ASSET,
        "version": _ASSET | {"id": "5eed" * 8, "source": "session", "version": 2, "parent_id": ASSET, "edits": [_MATERIAL]},
    },
    "AssetList": {"one": {"assets": [_ASSET], "total": 1}},
    "CaptureInfo": {"built": _CAPTURE},
    "CaptureList": {"one": {"captures": [_CAPTURE], "total": 1}},
    "CaptureLook": {
        "with masks": {
            "ok": True,
            "summary": _JOB["capture"]["summary"],
            "findings": _JOB["capture"]["findings"],
            "has_sheet": True,
            "sheet": _SHEET,
            "camera_count": 64,
            "cameras": [_VIEW],
            "up": [0.0, 0.0, 1.0],
            "box_low": [-0.6, -0.4, -0.5],
            "box_high": [0.6, 0.4, 0.5],
            "box_origin": "masks",
            "outermost": [0.6, 0.0, 0.0, 0.0, 0.4, 0.5],
            "points": [0.1, 0.2, 0.3],
            "colors": [0.8, 0.1, 0.1],
        }
    },
    "CaptureMasks": {"sheet": {"version": "0f" * 16, "sheet": _SHEET}},
    "CaptureRequest": {"complete upload": {"upload": CAPTURE, "name": "Mug"}},
    "MasksRequest": {"two strokes": {"strokes": _STROKES}},
    "EditLog": {"two edits": _LOG | {"digest": "9f86d081884c7d65"}},
    "EditRequest": {
        "material": {"edit": _MATERIAL},
        "sphere": {
            "edit": {
                "op": "material",
                "select": {"sphere": {"center": [0, 0, 0.5], "radius": 0.3, "falloff": 0.1}},
                "set": {"albedo": [0.9, 0.6, 0.2]},
                "mode": "absolute",
            }
        },
        "environment": {"edit": _LIGHT},
        "twist": {"edit": {"op": "deform", "map": {"type": "twist", "rate": 0.6}}},
        "clip of a simulate job": {"edit": {"op": "pose", "clip": f"clips/{JOB}", "time": 0.4}},
    },
    "EditsRequest": {"whole list": {"edits": [_MATERIAL, _LIGHT], "revision": 3}},
    "EnvironmentInfo": {"bundled": _ENVIRONMENT},
    "EnvironmentList": {"one": {"environments": [_ENVIRONMENT]}},
    "WeightsInfo": {"painted": {"file": "weights/" + "9f86d081" * 4 + ".f32", "vertices": 20_400}},
    "Health": {"ok": {"status": "ok"}},
    "JobFileList": {"turntable": {"files": [{"name": "asset-own-0000.png", "bytes": 181_000, "media_type": "image/png"}]}},
    "JobInfo": {
        "running": _JOB,
        "done": _JOB
        | {"state": "done", "stage": "done", "fraction": 1.0, "eta_seconds": None, "asset_id": JOB, "finished_at": "2026-11-20T10:04:00Z"},
        "failed": _JOB
        | {"state": "failed", "eta_seconds": None, "error": "The capture has no cameras.", "finished_at": "2026-11-20T10:00:09Z"},
    },
    "JobList": {"one": {"jobs": [_JOB], "total": 1, "workers_alive": 1}},
    "Problem": {
        "not found": {"type": "about:blank", "title": "Not Found", "status": 404, "detail": f"No asset has the id '{ASSET}'."},
        "busy": {
            "type": "about:blank",
            "title": "Too Many Requests",
            "status": 429,
            "detail": "1000 jobs wait or run already; try again when one is over.",
        },
    },
    "SaveRequest": {"named": {"name": "Chrome mug"}},
    "SessionInfo": {"one viewer": _SESSION},
    "SessionList": {"one": {"sessions": [_SESSION]}},
    "SessionRequest": {"asset": {"asset": ASSET}},
    "SnapshotInfo": {"chrome": _SNAPSHOT},
    "SnapshotList": {"one": {"snapshots": [_SNAPSHOT]}},
    "TrainingViewList": {"one": {"views": [_VIEW], "has_photographs": True}},
    "VariantList": {"one": {"variants": [{"name": "Polished", "edits": [_MATERIAL]}]}},
    "VariantNameRequest": {"another name": {"name": "Chrome"}},
    "VariantRequest": {"those in force": {"edits": None}, "others": {"edits": [_MATERIAL]}},
    "TokenRequest": {"token": {"token": "0" * 64}},
}
"""By schema and a few words."""

_BINARY = {"type": "string", "format": "binary"}
FILES: dict[str, tuple[str, ...]] = {
    "/api/captures/{capture_id}/sheet.jpg": ("image/jpeg",),
    "/api/captures/{capture_id}/pictures/{number}.jpg": ("image/jpeg",),
    "/api/captures/{capture_id}/masks/{version}.jpg": ("image/jpeg",),
    "/api/jobs/{job_id}/preview.jpg": ("image/jpeg",),
    "/api/jobs/{job_id}/files/{name}": ("application/octet-stream", "image/png", "video/mp4", "model/gltf-binary"),
    "/api/assets/{asset_id}/thumb.jpg": ("image/jpeg",),
    "/api/assets/{asset_id}/mesh.glb": ("model/gltf-binary",),
    "/api/assets/{asset_id}/environment.exr": ("image/x-exr",),
    "/api/assets/{asset_id}/export": ("application/octet-stream",),
    "/api/assets/{asset_id}/views/{number}/photograph.webp": ("image/webp",),
    "/api/environments/{name}": ("image/x-exr",),
    "/api/environments/{name}/thumb.jpg": ("image/jpeg",),
    "/api/sessions/{session_id}/frame.{suffix}": ("image/jpeg", "image/png", "image/x-exr"),
    "/api/sessions/{session_id}/vertices": ("application/octet-stream",),
    "/api/sessions/{session_id}/export": ("application/octet-stream",),
    "/api/weights/{weights_name}": ("application/octet-stream",),
}
"""What a GET of these paths answers."""
TEXTS = {
    "/api/jobs/{job_id}/log": "2026-11-20T10:00:01.204+00:00 read: started by render-1-0\n2026-11-20T10:00:09.871+00:00 read: finished\n",
    "/metrics": "# HELP drgs_frames_total Pictures sent to viewers.\n# TYPE drgs_frames_total counter\ndrgs_frames_total 1841.0\n",
}
UPLOADS = {
    "/api/assets": "A zipped asset, or a mesh: .zip, .glb, .ply or .obj.",
    "/api/environments": "A lat-long picture twice as wide as high: .exr or .hdr.",
}
"""What the part `file` of a POST to these paths holds."""


def complete_document(document: dict[str, Any]) -> dict[str, Any]:
    """Changes and returns the document."""
    schemas = document.setdefault("components", {}).setdefault("schemas", {})
    for unused in ("HTTPValidationError", "ValidationError"):
        schemas.pop(unused, None)
    schemas["Problem"] = Problem.model_json_schema(mode="serialization")
    problem = {"schema": {"$ref": "#/components/schemas/Problem"}, "examples": _examples("Problem")}
    for path, calls in document["paths"].items():
        for method, call in calls.items():
            answers = call["responses"]
            answers.pop("422", None)
            if method == "get" and path in FILES:
                answers["200"]["content"] = {media: {"schema": _BINARY} for media in FILES[path]}
            if method == "get" and path in TEXTS:
                answers["200"]["content"] = {"text/plain": {"schema": {"type": "string"}, "examples": {"lines": {"value": TEXTS[path]}}}}
            if method == "post" and path in UPLOADS:
                call["requestBody"] = _upload(UPLOADS[path])
            for place in (call.get("requestBody", {}), *answers.values()):
                for body in place.get("content", {}).values():
                    if (name := _schema_name(body)) is not None:
                        body["examples"] = _examples(name)
            answers["default"] = {
                "description": "A problem, with a sentence that says what to do.",
                "content": {"application/problem+json": problem},
            }
    return document


def _examples(schema: str) -> dict[str, Any]:
    return {title: {"value": value} for title, value in EXAMPLES[schema].items()}


def _schema_name(body: dict[str, Any]) -> str | None:
    """Of a body that is a component, or nothing or a component."""
    schema = body.get("schema", {})
    found = [part["$ref"] for part in (schema, *schema.get("anyOf", ())) if "$ref" in part]
    return found[0].rsplit("/", 1)[1] if found else None


def _upload(what: str) -> dict[str, Any]:
    properties = {"file": _BINARY | {"description": what}, "name": {"type": "string", "maxLength": 100}}
    schema = {"type": "object", "required": ["file"], "properties": properties}
    return {"required": True, "content": {"multipart/form-data": {"schema": schema}}}
