"""What happens to a service: killed, started on a damaged or foreign folder, two at once, and what its users still refer to taken away.

Each trial has a server and a folder of its own; the one that all other trials ask goes on meanwhile.
"""

import shutil
import sqlite3
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path

from benchmarks.serve.trials.changes import finite_picture
from benchmarks.serve.trials.shapes import ball, ply
from benchmarks.serve.trials.site import STOP_SECONDS, Answer, Site, Trial, first_line

JOB_SECONDS = 240.0


def trials() -> Iterator[Trial]:
    yield Trial("starts", "an empty token in a new folder is refused", _empty_token)
    yield Trial("starts", "an empty token is refused", partial(_refused_start, _write_token("")), quick=False)
    yield Trial("starts", "a token of three characters is refused", partial(_refused_start, _write_token("abc\n")), quick=False)
    yield Trial("starts", "a token of spaces is refused", partial(_refused_start, _write_token(" " * 64)), quick=False)
    yield Trial("starts", "a full folder without its database is refused", partial(_refused_start, _lose_database), quick=False)
    yield Trial("starts", "a full folder with an empty database is refused", partial(_refused_start, _empty_database), quick=False)
    for name in ("app.sqlite", "jobs.sqlite"):
        yield Trial("starts", f"a damaged {name} is told in a sentence", partial(_told_start, name, _overwrite), quick=False)
        yield Trial("starts", f"a {name} cut short is told in a sentence", partial(_told_start, name, _cut), quick=False)
        yield Trial("starts", f"an empty {name} is told in a sentence", partial(_told_start, name, _empty), quick=False)
    yield Trial("starts", "a folder that is a file is refused", _file_as_folder, quick=False)
    yield Trial("kills", "edits that were acknowledged are there after kill -9", _edits_after_kill, quick=False)
    yield Trial("kills", "kill -9 in uploads leaves nothing behind", partial(_leftovers, _uploading), quick=False)
    yield Trial("kills", "kill -9 in saves leaves nothing behind", partial(_leftovers, _saving), quick=False)
    yield Trial("kills", "kill -9 in exports leaves nothing behind", partial(_leftovers, _exporting), quick=False)
    yield Trial("owners", "a clip that an edit names cannot be taken away", _clip_in_use, quick=False)
    yield Trial("owners", "an edit that another version kept is skipped and taken out", _foreign_edit, quick=False)
    yield Trial("owners", "a damaged log hides no other session and can be deleted", _damaged_log, quick=False)
    yield Trial("owners", "a database that is locked for 5 s keeps callers waiting and loses nothing", _locked_database, quick=False)
    yield Trial("owners", "an asset that one server deletes is gone for the other", _two_servers, quick=False)


@contextmanager
def _own_site(site: Site, worker: bool = False) -> Iterator[Site]:
    """A server of its own with one small object."""
    own = Site(Path(tempfile.mkdtemp(dir=site.folder)), worker=worker)
    own.start()
    try:
        own.asset = own.upload("/api/assets", "ball.ply", ply(*ball())).document["id"]
        yield own
    finally:
        own.stop()
        shutil.rmtree(own.folder, ignore_errors=True)


def _begin(own: Site, seconds: float = 60.0) -> tuple[str, str]:
    """Start it once more; what it said first, and what it said in its log since. It is stopped again."""
    before = own.log.stat().st_size if own.log.exists() else 0
    process = own.launch()
    line = first_line(process, seconds)
    if line:
        process.terminate()
    try:
        process.wait(STOP_SECONDS)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    with own.log.open("rb") as log:
        log.seek(before)
        return line, log.read().decode(errors="replace")


def _write_token(token: str) -> Callable[[Site], None]:
    def spoil(own: Site) -> None:
        (own.data / "token").write_text(token)

    return spoil


def _lose_database(own: Site) -> None:
    for path in own.data.glob("app.sqlite*"):
        path.unlink()
    (own.data / "assets" / ("a" * 32)).mkdir()


def _empty_database(own: Site) -> None:
    _lose_database(own)
    (own.data / "app.sqlite").touch()


def _prepared(site: Site) -> Site:
    """A folder that a server has begun and left in order; made once and copied."""
    template = site.folder / "template"
    if not template.exists():
        made = Site(template)
        template.mkdir()
        made.start()
        made.stop()
    own = Site(Path(tempfile.mkdtemp(dir=site.folder)))
    shutil.copytree(template / "data", own.data)
    return own


def _refused_start(spoil: Callable[[Site], None], site: Site) -> str | None:
    own = _prepared(site)
    spoil(own)
    return _refused(own)


def _empty_token(site: Site) -> str | None:
    """Of a folder that no server has begun: the short form needs none beside the one that refuses."""
    own = Site(Path(tempfile.mkdtemp(dir=site.folder)))
    own.data.mkdir()
    _write_token("")(own)
    return _refused(own)


def _refused(own: Site) -> str | None:
    line, said = _begin(own)
    if line:
        return f"it started: {line.partition('#')[0]}"
    return _in_a_sentence(said)


def _in_a_sentence(said: str) -> str | None:
    if "Traceback" in said:
        return f"a stack: {said.strip().splitlines()[-1][:200]}"
    return None if said.strip() else "it ended without a word"


def _overwrite(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[:4096] = b"\xa5" * 4096
    path.write_bytes(data)


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:5000])


def _empty(path: Path) -> None:
    path.write_bytes(b"")


def _told_start(name: str, spoil: Callable[[Path], None], site: Site) -> str | None:
    """It may end in a sentence, or go on with what it has; never with a stack."""
    own = _prepared(site)
    for path in own.data.glob(f"{name}-*"):
        path.unlink()
    spoil(own.data / name)
    line, said = _begin(own)
    return None if line and "Traceback" not in said else _in_a_sentence(said)


def _file_as_folder(site: Site) -> str | None:
    own = Site(Path(tempfile.mkdtemp(dir=site.folder)))
    own.data.write_text("x")
    line, said = _begin(own)
    return f"it started: {line}" if line else _in_a_sentence(said)


def _edits_after_kill(site: Site) -> str | None:
    with _own_site(site) as own:
        session, revision = own.session(), 0
        for k in range(30):
            edit = {"op": "material", "select": {"all": True}, "set": {"roughness": 0.01 * k}}
            answer = own.send("POST", f"/api/sessions/{session}/edits", {"edit": edit})
            revision = answer.document["revision"] if answer.status == 200 else revision
        own.kill()
        own.start()
        found = own.request("GET", f"/api/sessions/{session}")
        if found.status != 200 or found.document["revision"] != revision:
            return f"{revision} edits were acknowledged; afterwards: {found.status} {found.sentence[:100]}"
        return finite_picture(own, session)


def _uploading(own: Site, _session: str) -> None:
    own.upload("/api/assets", "ball.ply", ply(*ball(60)))


def _saving(own: Site, session: str) -> None:
    own.send("POST", f"/api/sessions/{session}/save", {})


def _exporting(own: Site, _session: str) -> None:
    own.request("GET", f"/api/assets/{own.asset}/export?format=glb")


def _leftovers(work: Callable[[Site, str], None], site: Site) -> str | None:
    with _own_site(site) as own:
        session = own.session()

        def quietly() -> None:
            try:
                work(own, session)
            except Exception:  # whatever a killed server does to its callers
                return

        threads = [threading.Thread(target=quietly, daemon=True) for _ in range(3)]
        for thread in threads:
            thread.start()
        time.sleep(1.5)
        own.kill()
        for thread in threads:
            thread.join()
        for half in ("poses/half.new", "environments/half.new", "environments/.half.exr.new"):
            (own.data / half).write_bytes(b"half written")
        own.start()
        time.sleep(1.0)
        left = sorted(path.name for path in (own.data / "uploads").iterdir() if path.name.startswith("."))
        left += [path.name for folder in ("poses", "environments") for path in (own.data / folder).iterdir() if path.suffix == ".new"]
        return f"{len(left)} drafts are left, such as {left[0]}" if left else None


def _clip_in_use(site: Site) -> str | None:
    with _own_site(site, worker=True) as own:
        scene = {"matter": {"preset": "jelly"}, "particles": 500, "duration": 0.2}
        job = own.send("POST", "/api/jobs", {"kind": "simulate", "asset": own.asset, "scene": scene}).document["id"]
        end = time.monotonic() + JOB_SECONDS
        while (state := own.request("GET", f"/api/jobs/{job}").document)["state"] not in ("done", "failed", "cancelled"):
            if time.monotonic() > end:
                return f"the simulation was {state['state']} after {JOB_SECONDS:.0f} s"
            time.sleep(0.5)
        if state["state"] != "done":
            return f"the simulation {state['state']}: {state['error']}"
        session = own.session()
        edit = {"op": "pose", "clip": state["clip"], "time": 0.1}
        applied = own.send("POST", f"/api/sessions/{session}/edits", {"edit": edit})
        if applied.status != 200:
            return f"an edit with the clip is answered {applied.status}: {applied.sentence[:200]}"
        deleted = own.request("DELETE", f"/api/jobs/{job}")
        own.stop()
        own.start()
        if complaint := finite_picture(own, session):
            return f"deleting its job was answered {deleted.status}, and then {complaint}"
        if deleted.status != 409:
            return f"deleting a job whose clip is in use was answered {deleted.status}"
        shutil.rmtree(own.data / "environments" / "clips" / job)
        own.stop()
        own.start()
        undone = own.request("POST", f"/api/sessions/{session}/undo", b"")
        return None if undone.status == 200 else f"with its clip lost, an undo is answered {undone.status}: {undone.sentence[:200]}"


def _kept(own: Site, session: str, edit: str) -> None:
    """Put another edit in the place of a session's second one, while nobody serves it."""
    own.stop()
    with closing(sqlite3.connect(own.data / "app.sqlite")) as database, database:
        database.execute("UPDATE session_events SET edit = ? WHERE session_id = ? AND revision = 2", (edit, session))
    own.start()


def _rotate(own: Site, session: str, degrees: float) -> Answer:
    return own.send("POST", f"/api/sessions/{session}/edits", {"edit": {"op": "environment", "rotation": degrees}})


def _foreign_edit(site: Site) -> str | None:
    with _own_site(site) as own:
        session = own.session()
        for k in range(3):
            _rotate(own, session, k)
        for kept in ('{"op": "explode"}', "5", '{"op": "environment", "intensity": 1e300}'):
            _kept(own, session, kept)
            if complaint := finite_picture(own, session):
                return f"with {kept} in its log {complaint}"
            found = own.request("GET", f"/api/sessions/{session}").document
            if [broken["index"] for broken in found["broken"]] != [1] or own.request("GET", "/api/sessions").status != 200:
                return f"with {kept} in its log broken is {found['broken']}"
        edits = [found["edits"][0], found["edits"][2]]
        whole = own.send("PUT", f"/api/sessions/{session}/edits", {"edits": edits})
        return None if whole.status == 200 and not whole.document["broken"] else f"it cannot be taken out: {whole.status}"


def _damaged_log(site: Site) -> str | None:
    with _own_site(site) as own:
        damaged, other = own.session(), own.session()
        for k in range(3):
            _rotate(own, damaged, k)
        _kept(own, damaged, "no JSON")
        if complaint := own.complaint(own.request("GET", f"/api/sessions/{damaged}"), {409}):
            return complaint
        listed = own.request("GET", "/api/sessions")
        if listed.status != 200 or [found["id"] for found in listed.document["sessions"]] != [other]:
            return f"the list is answered {listed.status}: {listed.sentence[:200]}"
        deleted = own.request("DELETE", f"/api/sessions/{damaged}")
        return None if deleted.status == 204 else f"deleting it is answered {deleted.status}: {deleted.sentence[:200]}"


def _locked_database(site: Site) -> str | None:
    with _own_site(site) as own:
        session = own.session()
        with closing(sqlite3.connect(own.data / "app.sqlite", isolation_level=None, check_same_thread=False)) as database:
            database.execute("BEGIN EXCLUSIVE")
            release = threading.Timer(5.0, database.rollback)
            release.start()
            answer = _rotate(own, session, 30.0)
            well = own.is_well()
            release.join()
        if answer.status != 200:
            return f"an edit is answered {answer.status}: {answer.sentence[:200]}"
        return well or finite_picture(own, session)


def _two_servers(site: Site) -> str | None:
    with _own_site(site) as own:
        second = Site(own.folder)
        second.start()
        try:
            session = second.session(own.asset)
            if complaint := finite_picture(second, session):
                return complaint
            if own.request("DELETE", f"/api/assets/{own.asset}").status != 204:
                return "the asset could not be deleted"
            edit = {"op": "material", "select": {"all": True}, "set": {"roughness": 0.3}}
            answer = second.send("POST", f"/api/sessions/{session}/edits", {"edit": edit})
            return None if answer.status in (404, 409, 410) else f"the other server still edits it: {answer.status}"
        finally:
            second.stop()
