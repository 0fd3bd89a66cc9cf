"""List a finished asset folder."""

from sqlalchemy import Engine
from sqlalchemy.orm import Session

from drgs_worker.store.artifacts import share_artifact
from drgs_worker.store.asset_folder import count_asset_folder, folder_bytes
from drgs_worker.store.data_directory import DataDirectory
from drgs_worker.store.database import AssetRow, now


def register_asset(
    directory: DataDirectory,
    engine: Engine,
    asset_id: str,
    name: str,
    source: str,
    parent: AssetRow | None = None,
    edits: list[dict] | None = None,
) -> AssetRow:
    """Share its folder, and then add its row, or bring it up to date.

    Args:
        source: build, upload or session.
        parent: the version that this one follows.
        edits: what makes it of its parent.

    Raises:
        ValueError: the folder is no asset.
        StoreAway: it could not be shared; there is no row.
    """
    place = directory.asset(asset_id)
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
    share_artifact(directory, "assets", asset_id, place)
    with Session(engine, expire_on_commit=False) as session, session.begin():
        return session.merge(row)
