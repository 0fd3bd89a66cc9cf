"""REST: the views that an asset was built from, for comparing pictures with photographs."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

from fastapi import APIRouter, Depends
from fastapi import Path as PathParameter
from fastapi.responses import Response

from drgs.exchange.photographs import PHOTOGRAPHS, read_photograph
from drgs_server.api.context import ServerContext, context_of
from drgs_server.api.problems import ProblemError
from drgs_server.api.rest_records import TrainingView, TrainingViewList
from drgs_server.api.routes.assets import asset_folder
from drgs_worker.store.training_views import has_photographs, training_views

router = APIRouter(prefix="/api/assets/{asset_id}/views", tags=["assets"])

Context = Annotated[ServerContext, Depends(context_of)]
ViewNumber = Annotated[int, PathParameter(ge=0, le=1_000_000)]
KEEP_SECONDS = 86_400
"""A browser need not ask again: photographs of an asset never change."""


@router.get("")
def list_training_views(asset_id: str, context: Context) -> TrainingViewList:
    """The cameras of the capture, in its order."""
    folder = asset_folder(context, asset_id)
    try:
        views = [TrainingView.model_validate(asdict(view)) for view in training_views(folder)]
    except ValueError as error:
        raise ProblemError(422, f"{error}.") from error
    return TrainingViewList(views=views, has_photographs=has_photographs(folder))


@router.get("/{number}/photograph.webp")
def read_view_photograph(asset_id: str, number: ViewNumber, context: Context) -> Response:
    """A small copy of what that camera saw, with alpha where the capture has masks. Numbers count the views from 0."""
    folder: Path = asset_folder(context, asset_id)
    try:
        picture = read_photograph(folder / PHOTOGRAPHS, number)
    except ValueError as error:
        raise ProblemError(422, "The photographs that were kept with this asset are damaged; build it again.") from error
    if picture is None:
        raise ProblemError(404, f"No photograph {number} was kept with this asset.")
    return Response(picture, media_type="image/webp", headers={"Cache-Control": f"private, max-age={KEEP_SECONDS}, immutable"})
