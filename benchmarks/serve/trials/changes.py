"""What a session is asked to become: edits with numbers at the ends of what JSON can say, bodies that are none, and names of users."""

import copy
import json
from collections.abc import Iterator
from functools import partial
from typing import Any
from urllib.parse import quote

import numpy as np

from benchmarks.serve.trials.shapes import read_exr
from benchmarks.serve.trials.site import REFUSED, Site, Trial

EXTREMES: dict[str, str] = {
    "1e-320": "1e-320", "1e38": "1e38", "-1e308": "-1e308", "1e400": "1e400", "ten to the 400": "1" + "0" * 400, "NaN": "NaN",
    "1e9": "1e9", "-1": "-1", "2**31": str(2**31), "Infinity": "Infinity", "minus nothing": "-0.0", "1e-30": "1e-30",
}  # fmt: skip
"""As they are written into the body."""
QUICK_EXTREMES = ("1e-320", "1e38", "ten to the 400", "NaN")
EDITS: dict[str, dict] = {
    "a sphere": {
        "op": "material",
        "select": {"sphere": {"center": [0.0, 0.0, 1.0], "radius": 0.5, "falloff": 0.2}},
        "set": {"albedo": [0.9, 0.1, 0.1], "roughness": 0.5, "metallic": 0.5},
    },
    "a box": {"op": "material", "select": {"box": {"minimum": [0.0] * 3, "maximum": [1.0] * 3, "falloff": 0.1}}, "set": {"roughness": 0.5}},
    "a flood": {"op": "material", "select": {"similar": {"point": [0.0, 0.0, 1.0], "tolerance": 0.5}}, "set": {"metallic": 1.0}},
    "a region": {"op": "material", "select": {"region": 0}, "set": {"roughness": 2.0}, "mode": "multiply"},
    "a light": {"op": "environment", "file": "sun-and-sky.exr", "rotation": 30.0, "intensity": 1.0},
    "a twist": {"op": "deform", "map": {"type": "twist", "rate": 0.6}},
    "a bend": {"op": "deform", "map": {"type": "bend", "curvature": 0.3}},
    "a stretch": {"op": "deform", "map": {"type": "stretch", "factor": 1.2}},
    "a handle": {
        "op": "deform",
        "handles": {"drag": [{"point": [0.0, 0.0, 1.0], "radius": 0.3, "target": [0.0, 0.0, 1.5], "turn": [0.0, 0.0, 5.0]}]},
    },
    "a fall": {
        "op": "simulate",
        "scene": {"matter": {"preset": "jelly", "density": 1000.0}, "particles": 200, "duration": 0.1},
        "time": 0.05,
    },
}
BODIES: dict[str, bytes] = {
    "nothing": b"", "null": b"null", "a list": b"[]", "a brace": b"{", "no text": b"\xff\xfe\x00", "a number": b"5", "no edit": b'{"edit": null}',
    "an empty edit": b'{"edit": {}}', "an unknown op": b'{"edit": {"op": "explode"}}', "a long op": b'{"edit": {"op": "' + b"x" * 1_000_000 + b'"}}',
    "a long field": b'{"edit": {"op": "material", "' + b"x" * 1_000_000 + b'": 1}}', "brackets without end": b'{"edit": ' + b"[" * 100_000,
    "deep brackets": b'{"edit": ' + b"[" * 50_000 + b"]" * 50_000 + b"}", "a number of 10 000 digits": b'{"edit": {"op": "deform", "map": {"type": "twist", "rate": '
    + b"9" * 10_000 + b"}}}", "half a character": b'{"edit": {"op": "pose", "clip": "\\ud800", "time": 0}}',
    "a clip elsewhere": b'{"edit": {"op": "pose", "clip": "../../../etc", "time": 0}}', "a clip that is none": b'{"edit": {"op": "pose", "clip": "clips/'
    + b"0" * 32 + b'", "time": 0}}', "a light elsewhere": b'{"edit": {"op": "environment", "file": "../token"}}',
    "a light that is none": b'{"edit": {"op": "environment", "file": "none.exr"}}', "a file of vertices": b'{"edit": {"op": "deform", "vertices": "/etc/passwd"}}',
    "two selections": b'{"edit": {"op": "material", "select": {"all": true, "region": 0}, "set": {"roughness": 1}}}',
    "no selection": b'{"edit": {"op": "material", "select": {"all": false}, "set": {"roughness": 1}}}',
    "weights of another mesh": b'{"edit": {"op": "material", "select": {"vertex_weights": [1, 1]}, "set": {"roughness": 1}}}',
    "a lattice of one point": b'{"edit": {"op": "deform", "map": {"type": "lattice", "minimum": [0,0,0], "maximum": [1,1,1], "control_points": [[[[0,0,0]]]]}}}',
    "an empty lattice": b'{"edit": {"op": "deform", "map": {"type": "lattice", "minimum": [0,0,0], "maximum": [1,1,1], "control_points": []}}}',
    "a ragged lattice": b'{"edit": {"op": "deform", "map": {"type": "lattice", "minimum": [0,0,0], "maximum": [1,1,1], "control_points": [[[[0,0,0]]],[]]}}}',
    "a vertex that is none": b'{"edit": {"op": "deform", "handles": {"pin": [{"vertices": [999999999]}], "drag": [{"vertices": [0], "target": [1,1,1]}]}}}',
    "matter that is none": b'{"edit": {"op": "simulate", "scene": {"matter": {"preset": "porridge"}}, "time": 0.1}}',
    "a mesh elsewhere": b'{"edit": {"op": "simulate", "scene": {"acts": [{"shape": {"mesh": {"file": "/etc/passwd"}}}]}, "time": 0.1}}',
}  # fmt: skip
CALLS: tuple[tuple[str, dict], ...] = (
    ("/api/sessions", {"asset": "0"}),
    ("/api/login", {"token": "x"}),
    ("/api/jobs", {"kind": "build", "dataset": "x", "name": "n", "preset": "fast"}),
    ("/api/jobs", {"kind": "export", "asset": "0", "formats": ["glb"]}),
    ("/api/jobs", {"kind": "simulate", "asset": "0", "scene": {"matter": {"preset": "jelly"}}}),
    ("/api/jobs", {"kind": "redecouple", "asset": "0", "preset": "full"}),
    ("/api/jobs", {"kind": "render", "asset": "0", "environments": ["own"], "variants": [{"name": "a", "edits": []}]}),
)
ODD_TEXTS = ("\0", "\ud800", "a\0b", "~nobody-of-this-name/x", "x" * 400, "", "\u202e", "../..")
KINDS: tuple[Any, ...] = (None, "x", [], {}, True, "1e5", [[[]]])
QUICK_KINDS: tuple[Any, ...] = ("x", [], "1e5")
"""For what is computed long wherever it is taken."""
RIGHT_NAMES = ("Version 1", "before", "v2", "a", "x" * 80, "Grün – süß", "日本語", "a-b_c.d (1)", "100 %", "it's", "x1f", "n", "0")
UNSEEN_NAMES = ("\u200b", "\ufeff", "\u2060\u200e", "\u3164", "\u2800", "\u0300", "\ufe0f")
WRONG_NAMES = ("a\nb", "a\x00b", "\x1f", "a\tb", "a\x7fb", "x" * 500, "\r", "a\u2028b", "\x85", " ", "\u202eabc")
BAD_QUERIES: dict[str, tuple[str, ...]] = {
    "width": ("0", "-1", "15", "4097", "1e3", "NaN", "9" * 30, "", "64;rm", "0x40", "64.5", "true"),
    "height": ("0", "4097", "", "-64", "Infinity"),
    "spp": ("0", "-1", "65536", "1.5", "1e9", "9" * 400),
    "bounces": ("-1", "9", "x"),
    "exposure_stops": ("11", "-11", "nan", "inf", "1e308"),
    "tone_curve": ("", "none", "x" * 5000),
    "background": ("red", "../x", ""),
    "channel": ("all", "final.exr", ""),
    "denoise": ("2", "maybe"),
    "fov_y_degrees": ("0", "-5", "175", "180", "nan", "1e-320"),
    "world_from_camera": (
        "1", ",".join(["1"] * 16), ",".join(["0"] * 16), ",".join(["nan"] * 16), ",".join(["x"] * 16), "1,0,0,0,0,1,0,0,0,0,1,1e300,0,0,0,1",
        "-1,0,0,0,0,1,0,0,0,0,1,3,0,0,0,1", "2,0,0,0,0,2,0,0,0,0,2,3,0,0,0,1", "1,0,0,0,0,1,0,0,0,0,1,3,0,0,1,1", "1," * 600, "1,0,0,0,0,1,0,0,0,0,1,inf,0,0,0,1",
    ),
    "unknown": ("1",),
}  # fmt: skip


def trials() -> Iterator[Trial]:
    for title, edit in EDITS.items():
        for way in number_places(edit):
            place = ".".join(map(str, way))
            for word, text in EXTREMES.items():
                quick = word in QUICK_EXTREMES and title != "a fall"
                yield Trial("numbers", f"{title}: {place} = {word}", partial(_extreme, edit, way, text), quick)
    for title, body in BODIES.items():
        yield Trial("bodies", title, partial(_body, body))
    for title, edit in EDITS.items():
        long = title == "a fall"
        yield Trial("kinds", f"{title} with its fields of other kinds", partial(_other_kinds, edit, KINDS), quick=not long)
        if long:
            yield Trial("kinds", f"{title} with its fields of some other kinds", partial(_other_kinds, edit, QUICK_KINDS))
    for kind in ("text/plain", "application/xml", "multipart/form-data", "application/json; charset=utf-16", ""):
        yield Trial("bodies", f"content type {kind!r}", partial(_content_type, kind))
    for name, values in BAD_QUERIES.items():
        for value in values:
            yield Trial("queries", f"{name}={value[:40]}", partial(_query, name, value))
    for suffix in ("gif", "exr.png", "jpg%00", "", "JPG"):
        yield Trial("queries", f"frame.{suffix}", partial(_suffix, suffix))
    for name in RIGHT_NAMES:
        yield Trial("names", f"snapshot {name[:30]!r} is taken", partial(_right_name, name))
    for name in WRONG_NAMES:
        yield Trial("names", f"snapshot {name[:30]!r} is refused", partial(_wrong_name, name))
        yield Trial("names", f"job {name[:30]!r} is refused or cleaned", partial(_job_name, name))
    for name in UNSEEN_NAMES:
        yield Trial("names", f"snapshot {name!a}, which nobody sees, is refused", partial(_wrong_name, name))
    for number, (path, document) in enumerate(CALLS):
        yield Trial("texts", f"{path} with odd strings in call {number}", partial(_odd_texts, path, document))
    for query in ("assets?search=%00", "assets/%00", "sessions/a%00b", "jobs/%00/log"):
        yield Trial("texts", f"/api/{query} is no address", partial(_odd_address, f"/api/{query}"))
    for path in ("undo", "redo", "snapshots/none/restore"):
        yield Trial("bodies", f"{path} where there is nothing", partial(_nothing_to_do, path))


def number_places(document: Any, way: tuple = ()) -> Iterator[tuple]:
    """Ways to all numbers in a document."""
    if isinstance(document, dict | list):
        for key, inner in document.items() if isinstance(document, dict) else enumerate(document):
            yield from number_places(inner, (*way, key))
    elif isinstance(document, int | float) and not isinstance(document, bool):
        yield way


def replaced(document: Any, way: tuple, value: Any) -> Any:
    changed = copy.deepcopy(document)
    node = changed
    for key in way[:-1]:
        node = node[key]
    node[way[-1]] = value
    return changed


def finite_picture(site: Site, session: str, query: str = "width=24&height=24&spp=1") -> str | None:
    """Whether a session can be looked at: a picture comes, and no number in it is without bounds."""
    answer = site.request("GET", f"/api/sessions/{session}/frame.exr?{query}")
    if answer.status != 200:
        return f"its picture is answered {answer.status}: {answer.sentence[:200]}"
    wrong = [name for name, values in read_exr(answer.body).items() if not np.isfinite(values).all()]
    return f"its picture holds numbers that are not finite in {wrong}" if wrong else None


def _shared_session(site: Site) -> str:
    """One session for all trials that leave it as it was."""
    if not site.shared_session:
        site.shared_session = site.session()
    return site.shared_session


def _apply(site: Site, body: bytes) -> str | None:
    """Refused in a sentence, or done so that a picture can be made; undone again."""
    session = _shared_session(site)
    answer = site.request("POST", f"/api/sessions/{session}/edits", body, {"Content-Type": "application/json"})
    if answer.status != 200:
        return site.complaint(answer)
    complaint = finite_picture(site, session)
    undone = site.request("POST", f"/api/sessions/{session}/undo", b"")
    if undone.status != 200:
        complaint = complaint or f"it cannot be undone: {undone.status} {undone.sentence[:200]}"
        site.shared_session = ""
    return complaint


def _extreme(edit: dict, way: tuple, text: str, site: Site) -> str | None:
    marked = json.dumps({"edit": replaced(edit, way, "@number@")}).replace('"@number@"', text)
    return _apply(site, marked.encode())


def _body(body: bytes, site: Site) -> str | None:
    session = _shared_session(site)
    return site.complaint(site.request("POST", f"/api/sessions/{session}/edits", body, {"Content-Type": "application/json"}))


def _other_kinds(edit: dict, kinds: tuple[Any, ...], site: Site) -> str | None:
    def places(node: Any, way: tuple = ()) -> Iterator[tuple]:
        if way:
            yield way
        if isinstance(node, dict | list):
            for key, inner in node.items() if isinstance(node, dict) else enumerate(node):
                yield from places(inner, (*way, key))

    for way in places(edit):
        for value in kinds:
            body = json.dumps({"edit": replaced(edit, way, value)}).encode()
            if complaint := _apply(site, body):
                return f"{'.'.join(map(str, way))} = {value!r}: {complaint}"
    return None


def _content_type(kind: str, site: Site) -> str | None:
    session = _shared_session(site)
    body = b'{"edit": {"op": "explode"}}'
    return site.complaint(site.request("POST", f"/api/sessions/{session}/edits", body, {"Content-Type": kind} if kind else None))


def _query(name: str, value: str, site: Site) -> str | None:
    words = {"width": "24", "height": "24", "spp": "1"} | {name: value}
    query = "&".join(f"{key}={quote(word)}" for key, word in words.items())
    return site.complaint(site.request("GET", f"/api/sessions/{_shared_session(site)}/frame.png?{query}"))


def _suffix(suffix: str, site: Site) -> str | None:
    return site.complaint(site.request("GET", f"/api/sessions/{_shared_session(site)}/frame.{suffix}?width=24&height=24&spp=1"))


def _right_name(name: str, site: Site) -> str | None:
    path = f"/api/sessions/{_shared_session(site)}/snapshots/{quote(name, safe='')}"
    taken = site.request("PUT", path)
    if taken.status != 200 or taken.document["name"] != name:
        return f"answered {taken.status}: {taken.sentence[:100]}"
    restored, deleted = site.request("POST", f"{path}/restore"), site.request("DELETE", path)
    return None if (restored.status, deleted.status) == (200, 204) else f"restored {restored.status}, deleted {deleted.status}"


def _wrong_name(name: str, site: Site) -> str | None:
    return site.complaint(site.request("PUT", f"/api/sessions/{_shared_session(site)}/snapshots/{quote(name, safe='')}"))


def _job_name(name: str, site: Site) -> str | None:
    answer = site.send("POST", "/api/jobs", {"kind": "export", "asset": site.asset, "formats": ["ply"], "name": name})
    if answer.status != 202:
        return site.complaint(answer)
    site.request("POST", f"/api/jobs/{answer.document['id']}/cancel")
    shown = answer.document["name"]
    return None if shown.isprintable() and len(shown) <= 100 else f"it is shown as {shown!r}"


def _odd_texts(path: str, document: dict, site: Site) -> str | None:
    """In place of each string of a body."""

    def places(node: Any, way: tuple = ()) -> Iterator[tuple]:
        if isinstance(node, str):
            yield way
        elif isinstance(node, dict | list):
            for key, inner in node.items() if isinstance(node, dict) else enumerate(node):
                yield from places(inner, (*way, key))

    for way in places(document):
        for text in ODD_TEXTS:
            if complaint := site.complaint(site.send("POST", path, replaced(document, way, text), bearer=path != "/api/login")):
                return f"{'.'.join(map(str, way))} = {text[:20]!a}: {complaint}"
    return None


def _odd_address(path: str, site: Site) -> str | None:
    return site.complaint(site.request("GET", path), {400, 404, 422})


def _nothing_to_do(path: str, site: Site) -> str | None:
    return site.complaint(site.request("POST", f"/api/sessions/{site.session()}/{path}", b""), REFUSED)
