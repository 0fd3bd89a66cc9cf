"""What machines share: put, fetched, compared, replaced; on a folder, in memory, and on a real S3 server; and what happens when it is away."""

import json
import os
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from sqlalchemy.orm import Session
from test_jobs import Bench

from drgs_worker.jobs.progress import JobStopped
from drgs_worker.jobs.queue import JobQueue
from drgs_worker.jobs.retry_while_unavailable import retry_while_unavailable
from drgs_worker.store import artifacts
from drgs_worker.store.artifact_store import (
    PIECE_BYTES,
    ArtifactDamaged,
    ArtifactMissing,
    ArtifactStore,
    Manifest,
    StoreAway,
    StoredFile,
    encode_manifest,
    open_artifact_store,
)
from drgs_worker.store.data_directory import DataDirectory, open_data_directory
from drgs_worker.store.database import AssetRow, open_database
from drgs_worker.store.register_asset import register_asset
from tests.new_databases import put_new_databases
from tests.worker import store_server as servers

ASSET = "a" * 32


@pytest.fixture(scope="module")
def s3() -> Iterator[servers.StoreServer]:
    with servers.store_server() as server:
        yield server


@pytest.fixture(params=["file", "memory", "s3"])
def store(request: pytest.FixtureRequest, tmp_path: Path, s3: servers.StoreServer) -> ArtifactStore:
    address = {"file": f"file://{tmp_path / 'store'}", "memory": "memory://", "s3": f"s3://{servers.BUCKET}/{uuid.uuid4().hex}"}
    return open_artifact_store(address[request.param])


def make_folder(folder: Path, **files: bytes) -> Path:
    for name, data in ({"asset.json": b"{}", "deep/empty": b"", "mesh.glb": b"glTF" * 1000} | files).items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.slow
def test_a_folder_comes_back_byte_for_byte(store: ArtifactStore, tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "made", big=os.urandom(PIECE_BYTES + 17))
    assert not store.has("assets", "one")
    store.put("assets", "one", folder)
    store.get("assets", "one", tmp_path / "came")
    assert contents(tmp_path / "came") == contents(folder)
    assert store.has("assets", "one") and store.list("assets") == ["one"] and store.list("clips") == []
    assert store.get_file("assets", "one", "mesh.glb") == b"glTF" * 1000
    with pytest.raises(ArtifactMissing, match=r"no thumb\.jpg"):
        store.get_file("assets", "one", "thumb.jpg")
    store.get("assets", "one", tmp_path / "came")  # a second process at the same time: nothing changes, nothing fails
    assert contents(tmp_path / "came") == contents(folder)
    store.delete("assets", "one")
    store.delete("assets", "one")
    assert store.list("assets") == []
    with pytest.raises(ArtifactMissing):
        store.get("assets", "one", tmp_path / "again")
    assert sorted(path.name for path in tmp_path.iterdir() if path.name != "store") == ["came", "made"]


def test_a_file_comes_back_byte_for_byte(store: ArtifactStore, tmp_path: Path) -> None:
    (tmp_path / "sky.exr").write_bytes(b"exr")
    store.put("environments", "sky.exr", tmp_path / "sky.exr")
    store.get("environments", "sky.exr", tmp_path / "came.exr")
    assert (tmp_path / "came.exr").read_bytes() == b"exr"


def test_writing_anew_sends_what_changed_and_forgets_what_is_gone(s3: servers.StoreServer, tmp_path: Path) -> None:
    prefix = uuid.uuid4().hex
    store = open_artifact_store(f"s3://{servers.BUCKET}/{prefix}")
    folder = make_folder(tmp_path / "made")
    store.put("jobs", "one", folder)
    before = {key: s3.client.head_object(Bucket=servers.BUCKET, Key=key)["LastModified"] for key in s3.keys(prefix)}
    (folder / "asset.json").write_bytes(b"[]")
    (folder / "log.txt").write_bytes(b"went on")
    time.sleep(1.1)  # S3 tells time in seconds
    manifest = store.put("jobs", "one", folder, lambda path: path == "log.txt")
    after = {key: s3.client.head_object(Bucket=servers.BUCKET, Key=key)["LastModified"] for key in s3.keys(prefix)}
    kept = {key for key in before.keys() & after.keys() if before[key] == after[key]}
    assert len(kept) == 2 and len(after) == 4 and "log.txt" not in manifest.files
    here = make_folder(tmp_path / "here", stale=b"x", **{".lock": b""})
    store.update("jobs", "one", here, manifest, lambda path: path.startswith("."))
    assert contents(here) == {path: data for path, data in contents(folder).items() if path != "log.txt"} | {".lock": b""}


def flip(data: bytes) -> bytes:
    return bytes([data[0] ^ 1]) + data[1:]


@pytest.mark.parametrize(
    ("name", "damage"),
    [("flipped", flip), ("cut short", lambda data: data[:-1]), ("longer", lambda data: data + b"x"), ("emptied", lambda data: b"")],
)
def test_a_damaged_object_is_refused_with_a_sentence(
    name: str, damage: Callable[[bytes], bytes], s3: servers.StoreServer, tmp_path: Path
) -> None:
    prefix = uuid.uuid4().hex
    store = open_artifact_store(f"s3://{servers.BUCKET}/{prefix}")
    manifest = store.put("assets", ASSET, make_folder(tmp_path / "made"))
    key = f"{prefix}/assets/{ASSET}/{manifest.files['mesh.glb'].sha256}"
    s3.client.put_object(Bucket=servers.BUCKET, Key=key, Body=damage(b"glTF" * 1000))
    if name == "longer":  # only the bytes that the manifest speaks of are read
        store.get("assets", ASSET, tmp_path / "came")
        assert contents(tmp_path / "came") == contents(tmp_path / "made")
        return
    with pytest.raises(ArtifactDamaged, match=r"mesh\.glb has other bytes") as refusal:
        store.get("assets", ASSET, tmp_path / "came")
    assert str(refusal.value).endswith(".")
    s3.client.delete_object(Bucket=servers.BUCKET, Key=key)
    with pytest.raises(ArtifactDamaged, match="one of its files is gone"):
        store.get("assets", ASSET, tmp_path / "came")
    assert [path.name for path in tmp_path.iterdir()] == ["made"]


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"[]",
        b'{"format": "drgs artifact", "version": 2, "files": {}}',
        *(encode_manifest(Manifest({path: StoredFile(1, "0" * 64)})) for path in ("../up", "/etc/passwd", "a//b", "a\\b", "")),
        encode_manifest(Manifest({"a": StoredFile(1, "../x")})),
        encode_manifest(Manifest({"a": StoredFile(-1, "0" * 64)})),
    ],
)
def test_a_manifest_that_leads_out_of_its_folder_is_refused(text: bytes, tmp_path: Path) -> None:
    store = open_artifact_store(f"file://{tmp_path / 'store'}")
    store.put("assets", "one", make_folder(tmp_path / "made"))
    (tmp_path / "store/assets/one/manifest.json").write_bytes(text)
    with pytest.raises(ArtifactDamaged, match="manifest of assets/one is damaged"):
        store.get("assets", "one", tmp_path / "came")
    assert not (tmp_path / "came").exists()


def test_a_store_that_is_away_says_so_within_seconds(s3: servers.StoreServer, tmp_path: Path) -> None:
    store = open_artifact_store(f"s3://{servers.BUCKET}/{uuid.uuid4().hex}")
    folder = make_folder(tmp_path / "made")
    with s3.away():
        start = time.monotonic()
        with pytest.raises(StoreAway, match=r"does not answer, or refuses this service; nothing was changed\. Try again"):
            store.put("assets", "one", folder)
        assert time.monotonic() - start < 8
        stop_at = time.monotonic() + 0.1
        with pytest.raises(JobStopped):
            retry_while_unavailable(lambda: store.put("assets", "one", folder), lambda: time.monotonic() > stop_at)
    retry_while_unavailable(lambda: store.put("assets", "one", folder), lambda: False)
    assert store.has("assets", "one")
    with pytest.raises(StoreAway, match="does not exist; make the bucket"):
        open_artifact_store("s3://no-such-bucket").put("assets", "one", folder)


@pytest.mark.parametrize("url", ["ftp://x", "s3:/x", "/folder", "http://bucket"])
def test_an_address_of_another_kind_is_refused(url: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="expected one of file:///, memory://, s3://"):
        open_data_directory(tmp_path / "data", artifact_url=url)


class Machines:
    """Two data folders, one database, one store."""

    def __init__(self, root: Path) -> None:
        put_new_databases(root)
        self.urls = (f"sqlite:///{root / 'app.sqlite'}", f"sqlite:///{root / 'jobs.sqlite'}", f"s3://{servers.BUCKET}/{uuid.uuid4().hex}")
        self.first: DataDirectory = open_data_directory(root / "first", *self.urls)
        self.second: DataDirectory = open_data_directory(root / "second", *self.urls)
        self.engine = open_database(self.first)


@pytest.fixture
def machines(tmp_path: Path, s3: servers.StoreServer) -> Machines:
    return Machines(tmp_path)


COUNTS = json.dumps({"counts": {"surfels": 0, "vertices": 8, "faces": 12}}).encode()


def test_an_asset_of_one_machine_is_opened_on_another(machines: Machines) -> None:
    made = make_folder(machines.first.asset(ASSET), **{"asset.json": COUNTS})
    register_asset(machines.first, machines.engine, ASSET, "ball", "upload")
    assert contents(artifacts.fetch_asset(machines.second, ASSET)) == contents(made)


def test_what_one_machine_deleted_leaves_the_others_caches(machines: Machines) -> None:
    make_folder(machines.first.asset(ASSET), **{"asset.json": COUNTS})
    register_asset(machines.first, machines.engine, ASSET, "ball", "upload")
    artifacts.fetch_asset(machines.second, ASSET)
    make_folder(machines.second.job("j"))
    artifacts.share_job(machines.second, "j")
    make_folder(machines.second.jobs / "young")
    make_folder(machines.second.uploads / ".draft")
    for path in (machines.second.asset(ASSET), machines.second.job("j"), machines.second.uploads / ".draft"):
        os.utime(path, (0, 0))
    assert artifacts.remove_deleted_elsewhere(machines.second, machines.engine) == 0  # the one has a row, the other is in the store
    with Session(machines.engine) as session, session.begin():
        session.delete(session.get_one(AssetRow, ASSET))
    artifacts.unshare_artifact(machines.first, "assets", ASSET)
    artifacts.unshare_artifact(machines.first, "jobs", "j")
    assert artifacts.remove_deleted_elsewhere(machines.second, machines.engine) == 2
    assert not machines.second.asset(ASSET).exists() and not machines.second.job("j").exists()
    assert (machines.second.jobs / "young").exists() and (machines.second.uploads / ".draft").exists()


def test_an_asset_that_cannot_be_shared_is_not_listed(machines: Machines, s3: servers.StoreServer) -> None:
    make_folder(machines.first.asset(ASSET), **{"asset.json": COUNTS})
    with s3.away(), pytest.raises(StoreAway):
        register_asset(machines.first, machines.engine, ASSET, "ball", "upload")
    with Session(machines.engine) as session:
        assert session.get(AssetRow, ASSET) is None
    register_asset(machines.first, machines.engine, ASSET, "ball", "upload")
    with Session(machines.engine) as session:
        assert session.get(AssetRow, ASSET) is not None


def test_a_job_goes_on_where_its_last_step_ended_on_another_machine(machines: Machines) -> None:
    first, second = machines.first.job("j"), machines.second.job("j")
    make_folder(first, **{"log.txt": b"read\n", ".lock": b"", "half.part": b"x"})
    artifacts.share_job(machines.first, "j")
    artifacts.refresh_job(machines.second, "j")
    assert contents(second).keys() - {".stored", ".lock"} == {"asset.json", "deep/empty", "mesh.glb", "log.txt"}
    (first / "log.txt").write_bytes(b"read\nfit")
    artifacts.refresh_job(machines.first, "j")  # nobody has come further: what is here is kept
    assert (first / "log.txt").read_bytes() == b"read\nfit"
    (second / "log.txt").write_bytes(b"read\nfit by the second\n")
    (second / "deep/empty").unlink()
    artifacts.share_job(machines.second, "j")
    artifacts.fetch_job(machines.first, "j")
    assert (first / "log.txt").read_bytes() == b"read\nfit by the second\n" and not (first / "deep/empty").exists()
    assert (first / "half.part").exists() and (first / ".lock").exists()


def test_a_capture_is_looked_for_where_this_machine_keeps_uploads(machines: Machines, tmp_path: Path) -> None:
    job = "c" * 32
    make_folder(machines.first.uploads / job / "mug")
    artifacts.share_artifact(machines.first, "captures", job, machines.first.uploads / job)
    there = machines.first.uploads / job / "mug"
    assert artifacts.fetch_capture(machines.first, there) == there
    elsewhere = Path("/gone/first/uploads") / job / "mug"
    found = artifacts.fetch_capture(machines.second, elsewhere)
    assert found == machines.second.uploads / job / "mug" and contents(found) == contents(there)
    for strange in (Path("/gone/uploads"), Path("/gone/uploads/mug"), Path("/gone")):
        assert artifacts.fetch_capture(machines.second, strange) == strange


class TwoMachines(Bench):
    """The queue as one machine's API sees it; workers on the other."""

    def __init__(self, root: Path, machines: Machines, server: servers.StoreServer) -> None:
        self.root, self.machines, self.server = root, machines, server
        self.directory, self.engine = machines.first, machines.engine
        self.queue = JobQueue(self.directory, self.engine)
        self.workers = []

    def start_worker(self) -> subprocess.Popen:
        names = ("DRGS_DATABASE_URL", "DRGS_QUEUE_URL", "DRGS_ARTIFACT_URL")
        environment = self.environment() | dict(zip(names, self.machines.urls, strict=True)) | self.server.environment()
        worker = subprocess.Popen(
            [sys.executable, "-m", "drgs_worker", "--data", str(self.machines.second.root)], env=environment, cwd=self.root
        )
        self.workers.append(worker)
        return worker


@pytest.mark.slow
def test_an_upload_of_one_machine_is_built_by_a_worker_of_another_and_waits_for_a_store_that_is_away(
    tmp_path: Path, machines: Machines, s3: servers.StoreServer
) -> None:
    bench = TwoMachines(tmp_path, machines, s3)
    try:
        job = bench.submit(iterations=10, seconds=0.05)
        artifacts.share_artifact(machines.first, "captures", job, machines.first.uploads / job)
        bench.start_worker()
        bench.wait(lambda: bench.row(job).iteration >= 3)
        with s3.away():
            time.sleep(1.0)
            assert bench.state(job) == "running"
        bench.wait_for(job, "done")
        assert (artifacts.fetch_asset(machines.first, job) / "asset.json").is_file()
        artifacts.refresh_job(machines.first, job)
        log = machines.first.job_log(job).read_text()
        assert log.count("finished") == 7 and bench.row(job).attempts == 1
        assert machines.first.preview(job).read_bytes() == b"\xff\xd8tiny"
        assert not (machines.second.job(job) / "asset").exists()
    finally:
        bench.end()
