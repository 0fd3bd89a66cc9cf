"""REST: uploads in parts, which go on after a lost connection.

The protocol is tus 1.0.0 with its extensions creation and termination (https://tus.io/protocols/resumable-upload), so that its clients work, too:
POST announces a file, PATCH sends bytes from where it is, HEAD tells where that is. What a part's connection brought before it was lost has arrived.
An upload that is complete is used by its id (captures.py) and gone then.
"""

import base64
import binascii
from pathlib import PurePosixPath
from typing import Annotated

from fastapi import APIRouter, Depends, Header, Request, Response
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect

from drgs_server.api.context import ServerContext, context_of
from drgs_server.api.door.while_connected import CallerLeft
from drgs_server.api.problems import ProblemError
from drgs_worker.store.user_names import name_from_file

TUS_VERSION = "1.0.0"
EXTENSIONS = "creation,termination"
_SAID = {"Tus-Resumable": TUS_VERSION}
PART_TYPE = "application/offset+octet-stream"
_MOST_OFFSET = 2**63 - 1
"""The largest a database or a file system counts to."""

Context = Annotated[ServerContext, Depends(context_of)]
Length = Annotated[int, Header(alias="Upload-Length", ge=1, le=_MOST_OFFSET)]
Offset = Annotated[int, Header(alias="Upload-Offset", ge=0, le=_MOST_OFFSET)]
Metadata = Annotated[str, Header(alias="Upload-Metadata", max_length=4000)]


def _speaks_tus(version: Annotated[str | None, Header(alias="Tus-Resumable")] = None) -> None:
    """Dependency: the caller says which protocol this is."""
    if version != TUS_VERSION:
        said = "none" if version is None else repr(version[:20])
        raise ProblemError(412, f"Tus-Resumable: expected {TUS_VERSION}, found {said}.", headers=_SAID | {"Tus-Version": TUS_VERSION})


router = APIRouter(prefix="/api/uploads", tags=["uploads"])
_tus = [Depends(_speaks_tus)]
_PART = {"requestBody": {"required": True, "content": {PART_TYPE: {"schema": {"type": "string", "format": "binary"}}}}}


@router.options("", status_code=204, response_class=Response)
async def read_abilities(context: Context) -> Response:
    """What uploads may be, in headers."""
    abilities = {"Tus-Version": TUS_VERSION, "Tus-Extension": EXTENSIONS}
    return Response(status_code=204, headers=_SAID | abilities | {"Tus-Max-Size": str(context.settings.limits.upload_bytes)})


@router.post("", status_code=201, dependencies=_tus, response_class=Response)
async def announce_upload(context: Context, length: Length, metadata: Metadata = "") -> Response:
    """Announce a file of `Upload-Length` bytes; `Location` is where its parts go, the last part of that its id. The file's name is the value
    `filename` of `Upload-Metadata`, in base64."""
    name = PurePosixPath(_filename(metadata).replace("\\", "/")).stem
    made = await run_in_threadpool(context.incoming.announce, name_from_file(name, "Capture"), length)
    return Response(status_code=201, headers=_SAID | {"Location": f"/api/uploads/{made.id}", "Upload-Offset": "0"})


def _filename(metadata: str) -> str:
    """Of pairs of a key and a value in base64, with commas between."""
    pairs = (pair.strip().partition(" ") for pair in metadata.split(","))
    value = next((value for key, _, value in pairs if key in ("filename", "name")), "")
    try:
        return base64.b64decode(value, validate=True).decode()
    except (binascii.Error, ValueError) as error:
        raise ProblemError(422, f"Upload-Metadata: expected `filename` and UTF-8 text in base64; found {value[:40]!r}.") from error


@router.head("/{upload_id}", dependencies=_tus, response_class=Response)
async def read_offset(upload_id: str, context: Context) -> Response:
    """`Upload-Offset`: how much has come, and so where the next part begins."""
    async with context.incoming.alone(upload_id):  # a file that is being written to has lengths in between
        found = await run_in_threadpool(context.incoming.read, upload_id)
    where = {"Upload-Offset": str(found.offset), "Upload-Length": str(found.length)}
    return Response(headers=_SAID | where | {"Cache-Control": "no-store"})


@router.patch("/{upload_id}", status_code=204, dependencies=_tus, response_class=Response, openapi_extra=_PART)
async def append_part(upload_id: str, request: Request, context: Context, offset: Offset) -> Response:
    """Bytes that begin at `Upload-Offset`; 409 where the upload is elsewhere. All that comes is kept, also of a part that is cut off."""
    if request.headers.get("content-type", "") != PART_TYPE:
        raise ProblemError(415, f"Parts of an upload are sent as {PART_TYPE}.")
    try:
        found = await context.incoming.append(upload_id, offset, request.stream())
    except ClientDisconnect as error:
        raise CallerLeft from error
    return Response(status_code=204, headers=_SAID | {"Upload-Offset": str(found.offset)})


@router.delete("/{upload_id}", status_code=204, dependencies=_tus, response_class=Response)
async def delete_upload(upload_id: str, context: Context) -> Response:
    """Forget what has come."""
    await run_in_threadpool(context.incoming.read, upload_id)
    async with context.incoming.alone(upload_id):
        await run_in_threadpool(context.incoming.remove, upload_id)
    return Response(status_code=204, headers=_SAID)
