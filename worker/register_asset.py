"""List a finished asset folder."""

from pathlib import Path

from sqlalchemy import Engine
from sqlalchemy.orm import Session

from worker.asset_folder import count_asset_folder, folder_bytes
from worker.database import AssetRow, now


def register_asset(
    engine: Engine,
    asset_id: str,
    name: str,
    source: str,
    place: Path,
    parent: AssetRow | None = None,
    edits: list[dict] | None = None,
) -> AssetRow:
    """Add its row, or bring it up to date.

    Args:
        source: build, upload or session.
        parent: the version that this one follows.
        edits: what makes it of its parent.

    Raises:
        ValueError: the folder is no asset.
    """
    counts = count_asset_folder(place)
    row = AssetRow(
        id=asset_id,
        name=name,
        created_at=now(),
        source=source,
        bytes=folder_bytes(place),
        surfel_count=counts.surfels,
        vertex_count=counts.vertices,
        face_count=counts.faces,
        parent_id=parent.id if parent else None,
        version=parent.version + 1 if parent else 1,
        edits=edits or [],
    )
    with Session(engine, expire_on_commit=False) as session, session.begin():
        return session.merge(row)
