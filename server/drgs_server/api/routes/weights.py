"""REST: painted weights of vertices as files, so that an edit may refer to them instead of holding them: a message of the stream has at most 1 MiB.

A file is called by its content's hash and never changes; the same weights are one file. It is removed a day after nobody names it any more.
"""

import hashlib
import tempfile
from pathlib import Path
from typing import Annotated

import numpy as np
from fastapi import APIRouter, Depends, Request
from fastapi import Path as PathParameter
from fastapi.responses import FileResponse
from starlette.concurrency import run_in_threadpool

from drgs_server.api.context import ServerContext, context_of
from drgs_server.api.problems import ProblemError
from drgs_server.api.rest_records import WeightsInfo
from drgs_worker.store.artifacts import WEIGHTS, has_weights, mark_used, share_artifact

router = APIRouter(prefix="/api/weights", tags=["sessions"])

Context = Annotated[ServerContext, Depends(context_of)]
_BODY = {"requestBody": {"required": True, "content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}}}}


@router.post("", status_code=201, openapi_extra=_BODY)
async def upload_weights(request: Request, context: Context) -> WeightsInfo:
    """Body: a float32 (little-endian) for each vertex of the mesh, in its order, 0..1. A selection's `weights_file` is the answer's `file`."""
    data = await request.body()
    return await run_in_threadpool(_store, context, data)


def _store(context: ServerContext, data: bytes) -> WeightsInfo:
    if not data or len(data) % 4:
        raise ProblemError(422, f"Weights are a float32 for each vertex; found {len(data)} bytes, which is no multiple of 4 above 0.")
    weights = np.frombuffer(data, "<f4")
    if not ((weights >= 0) & (weights <= 1)).all():  # which NaN is not
        raise ProblemError(422, "Weights lie in 0..1; found others.")
    name = f"{hashlib.sha256(data).hexdigest()[:32]}.f32"
    place = context.directory.environments / WEIGHTS / name
    if not mark_used(place):
        place.parent.mkdir(mode=0o700, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".weights-", dir=context.scratch.folder) as folder:
            draft = Path(folder) / name
            draft.write_bytes(data)
            share_artifact(context.directory, WEIGHTS, name, draft)
            draft.rename(place)
    return WeightsInfo(file=f"{WEIGHTS}/{name}", vertices=len(weights))


@router.get("/{weights_name}")
def read_weights(weights_name: Annotated[str, PathParameter(pattern=r"^[0-9a-f]{32}\.f32$")], context: Context) -> FileResponse:
    """The same bytes; they never change."""
    if not has_weights(context.directory, f"{WEIGHTS}/{weights_name}"):
        raise ProblemError(404, f"There are no weights {weights_name}.")
    headers = {"Cache-Control": "private, max-age=86400, immutable"}
    return FileResponse(context.directory.environments / WEIGHTS / weights_name, media_type="application/octet-stream", headers=headers)
