"""Other jobs than builds, versions and undoable deletion of assets, snapshots of sessions, edits that are sent twice."""

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None


def upgrade() -> None:
    with op.batch_alter_table("assets") as table:
        table.add_column(sa.Column("parent_id", sa.String()))
        table.add_column(sa.Column("version", sa.Integer(), nullable=False, server_default="1"))
        table.add_column(sa.Column("edits", sa.JSON(), nullable=False, server_default="[]"))
        table.add_column(sa.Column("deleted_at", sa.Float()))
        table.create_index("ix_assets_deleted_at", ["deleted_at"])
        table.alter_column("bytes", type_=sa.BigInteger(), existing_type=sa.Integer(), existing_nullable=False)
    with op.batch_alter_table("jobs") as table:
        table.add_column(sa.Column("parameters", sa.JSON(), nullable=False, server_default="{}"))
        table.add_column(sa.Column("priority", sa.Integer(), nullable=False, server_default="100"))
    with op.batch_alter_table("session_events") as table:
        table.add_column(sa.Column("client_key", sa.String()))
        table.create_unique_constraint("one_event_a_key", ["session_id", "client_key"])
    op.create_table(
        "session_snapshots",
        sa.Column("session_id", sa.String(), sa.ForeignKey("sessions.id", ondelete="CASCADE"), primary_key=True),
        sa.Column("name", sa.String(), primary_key=True),
        sa.Column("created_at", sa.Float(), nullable=False),
        sa.Column("revision", sa.Integer(), nullable=False),
        sa.Column("edits", sa.JSON(), nullable=False),
    )


def downgrade() -> None:
    op.drop_table("session_snapshots")
    with op.batch_alter_table("session_events") as table:
        table.drop_constraint("one_event_a_key")
        table.drop_column("client_key")
    with op.batch_alter_table("jobs") as table:
        table.drop_column("priority")
        table.drop_column("parameters")
    with op.batch_alter_table("assets") as table:
        table.drop_index("ix_assets_deleted_at")
        for name in ("deleted_at", "edits", "version", "parent_id"):
            table.drop_column(name)
