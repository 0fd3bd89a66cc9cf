"""Drive a running server from Python: builds, assets, sessions, pictures (docs/protocol.md).

    client = Client("http://127.0.0.1:8000/#token=...")       # the address that `drgs serve` prints
    for job in client.watch(client.submit_build("captures/teapot", preset="fast")):
        print(job.stage, f"{job.fraction:.0%}", job.psnr)
    session = client.open_session(job.asset_id)
    session.edit({"op": "environment", "file": "studio.exr", "rotation": 30})
    Path("teapot.png").write_bytes(session.frame(width=800, height=600, spp=256))

Speaks only HTTP and WebSocket; imports neither torch nor the renderer. Final states of a job: done, failed, cancelled; a job that
the server does not know is an error, never done.
"""

import tempfile
import time
import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, TypeVar
from urllib.parse import quote, urlsplit

import httpx
from pydantic import BaseModel, TypeAdapter
from websockets.sync.client import ClientConnection, connect

from drgs.exchange.export_formats import DownloadFormat
from drgs.scene.edits import Edit, Triple
from drgs.scene.strokes import Stroke, plain_strokes
from drgs_server.api.rest_records import (
    AssetInfo,
    AssetList,
    CaptureInfo,
    CaptureList,
    EnvironmentInfo,
    EnvironmentList,
    JobFile,
    JobFileList,
    JobInfo,
    JobList,
    SessionInfo,
    SessionList,
    SnapshotInfo,
    SnapshotList,
)
from drgs_server.client_stream import ServerError, Stream
from drgs_server.client_upload import as_zip, send_in_parts, server_error
from drgs_server.client_variants import SessionVariants
from drgs_server.live.messages import EditLog, Settings
from drgs_server.picture import Picture
from drgs_worker.jobs.requests import (
    BindingName,
    CameraName,
    ExportRequest,
    LightName,
    MaskName,
    PoseRequest,
    RedecoupleRequest,
    RenderRequest,
    SimulateRequest,
)

Model = TypeVar("Model", bound=BaseModel)
Preset = Literal["draft", "fast", "full"]

FINAL_STATES = ("done", "failed", "cancelled")
_edit = TypeAdapter(Edit)


class Client:
    """Final. Use it as a context manager, or close it."""

    def __init__(self, address: str = "http://127.0.0.1:8000", token: str | None = None, timeout_seconds: float = 60.0) -> None:
        """
        Args:
            address: with or without `#token=...`.
            token: instead of the address's.
        """
        parts = urlsplit(address)
        token = token or parts.fragment.removeprefix("token=")
        if not token:
            raise ValueError("Client: no token; give the whole address that `drgs serve` printed, or token=")
        self.address = f"{parts.scheme}://{parts.netloc}"
        self._headers = {"Authorization": f"Bearer {token}"}
        self._http = httpx.Client(base_url=self.address, headers=self._headers, timeout=timeout_seconds)

    def __enter__(self) -> "Client":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        self._http.close()

    # ---- jobs -------------------------------------------------------------------------------------------------------

    def submit_build(
        self,
        dataset: Path | str,
        preset: Preset = "fast",
        seed: int = 0,
        name: str | None = None,
        idempotency_key: str | None = None,
        binding: BindingName = "particles",
        light: LightName = "auto",
        up: Triple = (0.0, 0.0, 1.0),
        box: tuple[Triple, Triple] | None = None,
        strokes: Sequence[Stroke] = (),
        masks: MaskName = "auto",
        cameras: CameraName = "auto",
    ) -> JobInfo:
        """Start a build.

        Args:
            dataset: `sample`, a folder or zip of this machine (uploaded), `capture:ID`, which was uploaded before, or `server:PATH`, a folder that
                the server may read.
            binding: particles: surfels lie where they were fitted. mesh: they are rebuilt on the faces of the mesh.
            light: what the lamps stood still with: the object, or (on a turntable) the camera; auto: asked of the pictures.
            up: direction of the capture's world that points up; the asset's world is turned so that it is z.
            box: low and high corner in the asset's world: what lies outside is not built. None: all of the object is.
            strokes: over some pictures, what is the object and what is not: the masks of all follow from them. None: the capture's own count.
            masks: auto: they are moved to where the photographs show the object to end. given: they stay.
            cameras: auto: they are moved to where their photographs fit the surface best, if they are off. given: they stay.
            idempotency_key: the same key gives the same job, however often this is called.
        """
        headers = {"Idempotency-Key": idempotency_key} if idempotency_key else {}
        if not (isinstance(dataset, str) and (dataset == "sample" or dataset.startswith(("server:", "capture:")))):
            dataset = f"capture:{self.upload_capture(Path(dataset), name).id}"
        body = {
            "dataset": dataset.removeprefix("server:"),
            "preset": preset,
            "binding": binding,
            "light": light,
            "masks": masks,
            "cameras": cameras,
            "up": up,
            "box": None if box is None else {"low": box[0], "high": box[1]},
            "strokes": plain_strokes(strokes) or None,
            "seed": seed,
            "name": name,
        }
        return self._call("POST", "/api/jobs", JobInfo, json=body, headers=headers)

    def upload_capture(self, path: Path, name: str | None = None, progress: Callable[[float], None] = lambda _: None) -> CaptureInfo:
        """Send a folder or a zip, for builds to read. It goes on by itself after a lost connection or a restart of the server.

        Args:
            progress: is told the share that has arrived, 0..1.
        """
        with as_zip(path) as file:
            upload = send_in_parts(self._http, file, f"{path.stem}.zip", progress)
        return self._call("POST", "/api/captures", CaptureInfo, json={"upload": upload, "name": name}, timeout=600)

    def captures(self, limit: int = 50, offset: int = 0) -> CaptureList:
        return self._call("GET", "/api/captures", CaptureList, params={"limit": limit, "offset": offset})

    def delete_capture(self, capture_id: str) -> None:
        self._request("DELETE", f"/api/captures/{capture_id}")

    def submit(
        self,
        request: PoseRequest | RedecoupleRequest | SimulateRequest | RenderRequest | ExportRequest | dict,
        idempotency_key: str | None = None,
    ) -> JobInfo:
        """Start a job on an asset, or find the poses of a capture's photographs (worker/drgs_worker/jobs/requests.py, or the same as plain data)."""
        headers = {"Idempotency-Key": idempotency_key} if idempotency_key else {}
        body = request if isinstance(request, dict) else request.model_dump(mode="json", exclude_none=True)
        return self._call("POST", "/api/jobs", JobInfo, json=body, headers=headers)

    def job_files(self, job_id: str) -> list[JobFile]:
        """What a render or an export has made."""
        return self._call("GET", f"/api/jobs/{job_id}/files", JobFileList).files

    def download_file(self, job_id: str, name: str, out: Path) -> None:
        """Write one of a job's files to `out`."""
        self._download(f"/api/jobs/{job_id}/files/{name}", out)

    def job_log(self, job_id: str) -> str:
        """When each step started and finished, a line each."""
        return self._bytes(f"/api/jobs/{job_id}/log").decode()

    def delete_job(self, job_id: str) -> None:
        self._request("DELETE", f"/api/jobs/{job_id}")

    def jobs(self, limit: int = 50, offset: int = 0) -> JobList:
        return self._call("GET", "/api/jobs", JobList, params={"limit": limit, "offset": offset})

    def job(self, job_id: str) -> JobInfo:
        return self._call("GET", f"/api/jobs/{job_id}", JobInfo)

    def cancel(self, job_id: str) -> JobInfo:
        return self._call("POST", f"/api/jobs/{job_id}/cancel", JobInfo)

    def retry(self, job_id: str) -> JobInfo:
        return self._call("POST", f"/api/jobs/{job_id}/retry", JobInfo)

    def resume(self, job_id: str) -> JobInfo:
        return self._call("POST", f"/api/jobs/{job_id}/resume", JobInfo)

    def preview(self, job_id: str) -> bytes:
        """JPEG."""
        return self._bytes(f"/api/jobs/{job_id}/preview.jpg")

    def watch(self, job: JobInfo | str, interval_seconds: float = 0.5) -> Iterator[JobInfo]:
        """The job each time something about it changed, the last time in its final state."""
        job_id = job if isinstance(job, str) else job.id
        last: JobInfo | None = None
        while True:
            found = self.job(job_id)
            if found.state == "unknown":
                raise ServerError(
                    404, f"The queue does not know job {job_id}; it may have been lost before it was queued. Submit it again."
                )
            if found != last:
                yield found
            if found.state in FINAL_STATES:
                return
            last = found
            time.sleep(interval_seconds)

    def wait(self, job: JobInfo | str, bar: bool = True) -> JobInfo:
        """The job once it is done, with a progress bar on stderr meanwhile where that is a terminal.

        Raises:
            ServerError: it failed or was cancelled; the text is its reason.
        """
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

        console = Console(stderr=True)
        columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
        found: JobInfo | None = None
        with Progress(*columns, console=console, disable=not (bar and console.is_terminal), transient=True) as progress:
            task = progress.add_task("queued", total=1.0)
            for found in self.watch(job):
                progress.update(task, completed=found.fraction, description=f"{found.name}: {found.stage or found.state} {found.message}")
        assert found is not None
        if found.state != "done":
            raise ServerError(409, found.error or f"The job {found.name} was {found.state}.")
        return found

    # ---- assets and environments ------------------------------------------------------------------------------------

    def assets(self, limit: int = 50, offset: int = 0, search: str | None = None) -> AssetList:
        """
        Args:
            search: part of the name, whatever its case.
        """
        found = {"search": search} if search else {}
        return self._call("GET", "/api/assets", AssetList, params={"limit": limit, "offset": offset, **found})

    def asset(self, asset_id: str) -> AssetInfo:
        return self._call("GET", f"/api/assets/{asset_id}", AssetInfo)

    def upload_asset(self, path: Path, name: str | None = None) -> AssetInfo:
        """The folder of an asset, the same zipped, or a mesh (GLB, PLY, OBJ).

        Raises:
            ValueError: a folder that is no asset's.
        """
        if not path.is_dir():
            return self._upload("/api/assets", path, name, AssetInfo)
        if not (path / "asset.json").is_file():
            raise ValueError(f"{path}: has no asset.json; expected the folder of an asset, the same zipped, or a mesh")
        with tempfile.TemporaryDirectory(prefix="drgs-upload-") as folder:
            packed = Path(folder) / f"{path.resolve().name}.zip"
            with zipfile.ZipFile(packed, "w") as archive:
                for file in sorted(path.rglob("*")):
                    archive.write(file, file.relative_to(path))
            return self._upload("/api/assets", packed, name, AssetInfo)

    def delete_asset(self, asset_id: str) -> None:
        """`undelete_asset` brings it back for a day."""
        self._request("DELETE", f"/api/assets/{asset_id}")

    def undelete_asset(self, asset_id: str) -> AssetInfo:
        return self._call("POST", f"/api/assets/{asset_id}/undelete", AssetInfo)

    def export(self, asset_id: str, format: DownloadFormat, out: Path, faces: int | None = None) -> None:
        """Write the asset to the file `out`, in another program's format.

        Args:
            faces: the most that a textured mesh (glb, mesh, usdz, usd) has; None: 30 000.
        """
        self._download(f"/api/assets/{asset_id}/export", out, params=_export_query(format, faces))

    def environments(self) -> list[EnvironmentInfo]:
        return self._call("GET", "/api/environments", EnvironmentList).environments

    def upload_environment(self, path: Path, name: str | None = None) -> EnvironmentInfo:
        """A lat-long EXR or Radiance HDR."""
        return self._upload("/api/environments", path, name, EnvironmentInfo)

    # ---- sessions ---------------------------------------------------------------------------------------------------

    def open_session(self, asset_id: str) -> "RemoteSession":
        return RemoteSession(self, self._call("POST", "/api/sessions", SessionInfo, json={"asset": asset_id}))

    def session(self, session_id: str) -> "RemoteSession":
        return RemoteSession(self, self._call("GET", f"/api/sessions/{session_id}", SessionInfo))

    def sessions(self) -> list[SessionInfo]:
        return self._call("GET", "/api/sessions", SessionList).sessions

    # ---- how ---------------------------------------------------------------------------------------------------------

    def _request(self, method: str, path: str, **options: Any) -> httpx.Response:
        response = self._http.request(method, path, **options)
        if response.is_error:
            raise server_error(response)
        return response

    def _call(self, method: str, path: str, model: type[Model], **options: Any) -> Model:
        return model.model_validate_json(self._request(method, path, **options).content)

    def _bytes(self, path: str, **options: Any) -> bytes:
        return self._request("GET", path, **options).content

    def _download(self, path: str, out: Path, **options: Any) -> None:
        with self._http.stream("GET", path, timeout=600, **options) as response:
            if response.is_error:
                response.read()
                raise server_error(response)
            with out.open("wb") as file:
                for chunk in response.iter_bytes():
                    file.write(chunk)

    def _upload(self, path: str, file: Path, name: str | None, model: type[Model]) -> Model:
        with file.open("rb") as stream:
            return self._call("POST", path, model, files={"file": (file.name, stream)}, data={"name": name} if name else {}, timeout=600)

    def _connect(self, session_id: str) -> ClientConnection:
        address = self.address.replace("http", "ws", 1) + f"/api/sessions/{session_id}/stream"
        return connect(address, additional_headers=self._headers, compression=None, max_size=64 << 20)


def _export_query(format: DownloadFormat, faces: int | None) -> dict[str, str | int]:
    return {"format": format} if faces is None else {"format": format, "faces": faces}


class RemoteSession:
    """Final. One open asset: edits in order, pictures of any camera."""

    def __init__(self, client: Client, info: SessionInfo) -> None:
        self._client = client
        self.id = info.id
        self.asset_id = info.asset
        self.variants = SessionVariants(client._call, info.id)

    def info(self) -> SessionInfo:
        return self._client._call("GET", f"/api/sessions/{self.id}", SessionInfo)

    def edit(self, edit: Edit | dict, key: str | None = None) -> EditLog:
        """Append an edit (drgs.scene.edits, or the same as plain data).

        Args:
            key: the same one appends one edit, however often it is sent.
        """
        headers = {"Idempotency-Key": key} if key else {}
        values = _edit.dump_python(_edit.validate_python(edit), mode="json", exclude_none=True)
        return self._client._call("POST", f"/api/sessions/{self.id}/edits", EditLog, json={"edit": values}, headers=headers, timeout=600)

    def put_edits(self, edits: Sequence[Edit | dict], revision: int | None = None) -> EditLog:
        """Put these edits in place of all that are in force; one step of undo.

        Args:
            revision: of the log that they are meant for; the call fails once there is a newer one.
        """
        values = [_edit.dump_python(_edit.validate_python(edit), mode="json", exclude_none=True) for edit in edits]
        body = {"edits": values, "revision": revision}
        return self._client._call("PUT", f"/api/sessions/{self.id}/edits", EditLog, json=body, timeout=600)

    def undo(self) -> EditLog:
        return self._client._call("POST", f"/api/sessions/{self.id}/undo", EditLog, timeout=600)

    def redo(self) -> EditLog:
        return self._client._call("POST", f"/api/sessions/{self.id}/redo", EditLog, timeout=600)

    def snapshots(self) -> list[SnapshotInfo]:
        """Oldest first."""
        return self._client._call("GET", f"/api/sessions/{self.id}/snapshots", SnapshotList).snapshots

    def take_snapshot(self, name: str) -> SnapshotInfo:
        """Keep the edits in force under a name; the same name is overwritten."""
        return self._client._call("PUT", f"/api/sessions/{self.id}/snapshots/{quote(name, safe='')}", SnapshotInfo)

    def restore_snapshot(self, name: str) -> EditLog:
        """Put a snapshot's edits in place of those in force; one step of undo."""
        return self._client._call("POST", f"/api/sessions/{self.id}/snapshots/{quote(name, safe='')}/restore", EditLog, timeout=600)

    def save(self, name: str | None = None) -> AssetInfo:
        """A new version of the asset with the edits in force put into it."""
        return self._client._call("POST", f"/api/sessions/{self.id}/save", AssetInfo, json={"name": name}, timeout=600)

    def export(self, format: DownloadFormat, out: Path, faces: int | None = None) -> None:
        """Write the object with the edits in force put into it as a file for other programs; the server keeps nothing of it.

        Args:
            faces: the most that a textured mesh (glb, mesh, usdz, usd) has; None: 30 000.
        """
        self._client._download(f"/api/sessions/{self.id}/export", out, params=_export_query(format, faces))

    def frame(
        self,
        width: int = 512,
        height: int = 512,
        spp: int = 128,
        world_from_camera: list[list[float]] | None = None,
        fov_y_degrees: float | None = None,
        format: Literal["png", "jpg", "exr"] = "png",
        **settings: Any,
    ) -> Picture:
        """One finished picture: the bytes of its file, which notebooks show.

        Args:
            format: exr holds linear radiance, or with `channel="all"` every channel as a layer of its own.
            world_from_camera: 4x4 OpenGL camera-to-world; the start view when absent.
            settings: exposure_stops, tone_curve, background, channel, bounces, denoise, turn_light, environment (a stored one, or `captured`, in the place
                of the light in force).
        """
        query: dict[str, Any] = {"width": width, "height": height, "spp": spp, **settings}
        if world_from_camera is not None:
            query["world_from_camera"] = ",".join(repr(float(value)) for row in world_from_camera for value in row)
        if fov_y_degrees is not None:
            query["fov_y_degrees"] = fov_y_degrees
        return Picture(self._client._bytes(f"/api/sessions/{self.id}/frame.{format}", params=query, timeout=600))

    def delete(self) -> None:
        self._client._request("DELETE", f"/api/sessions/{self.id}")

    @contextmanager
    def stream(self, settings: Settings | None = None) -> Iterator[Stream]:
        """A live connection; frames come as the server has them."""
        with self._client._connect(self.id) as socket:
            stream = Stream(socket)
            if settings is not None:
                stream.send(type="settings", settings=settings.model_dump())
            yield stream
