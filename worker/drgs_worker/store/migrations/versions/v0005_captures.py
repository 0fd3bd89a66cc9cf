"""Captures that are there before a build."""

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "captures",
        sa.Column("id", sa.String(), primary_key=True),
        sa.Column("name", sa.String(), nullable=False),
        sa.Column("created_at", sa.Float(), nullable=False),
        sa.Column("folder", sa.String(), nullable=False),
    )
    op.create_index("ix_captures_created_at", "captures", ["created_at"])


def downgrade() -> None:
    op.drop_table("captures")
