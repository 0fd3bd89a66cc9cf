"""Alembic's entry: runs the versions on the connection that worker/drgs_worker/store/database.py hands over."""

from alembic import context

from drgs_worker.store.database import Base

connection = context.config.attributes["connection"]
# Batch mode: SQLite cannot alter a column, alembic then rebuilds the table.
context.configure(connection=connection, target_metadata=Base.metadata, render_as_batch=True)
with context.begin_transaction():
    context.run_migrations()
