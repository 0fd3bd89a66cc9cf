"""The material variants of a session, from Python: part of drgs_server.client."""

from collections.abc import Callable, Sequence
from typing import Any
from urllib.parse import quote

from drgs.scene.edits import MaterialEdit, MaterialVariant
from drgs_server.api.rest_records import VariantList
from drgs_server.live.messages import EditLog


class SessionVariants:
    """Final. What the object may be made of, by name; each change is one step of undo."""

    def __init__(self, call: Callable[..., Any], session_id: str) -> None:
        """
        Args:
            call: method, path, the model of the answer, and what httpx is told besides.
        """
        self._call = call
        self._path = f"/api/sessions/{session_id}/variants"

    def all(self) -> list[MaterialVariant]:
        """In the order in which they came."""
        found: VariantList = self._call("GET", self._path, VariantList)
        return found.variants

    def keep(self, name: str, edits: Sequence[MaterialEdit | dict] | None = None) -> EditLog:
        """Keep material edits under a name; the same name is overwritten.

        Args:
            edits: None: those in force.
        """
        plain = [edit if isinstance(edit, dict) else edit.model_dump(mode="json", exclude_none=True) for edit in edits or ()]
        return self._change("PUT", name, "", json={} if edits is None else {"edits": plain})

    def rename(self, name: str, to: str) -> EditLog:
        return self._change("POST", name, "/rename", json={"name": to})

    def apply(self, name: str) -> EditLog:
        """Put its edits in the place of all material edits in force."""
        return self._change("POST", name, "/apply")

    def remove(self, name: str) -> EditLog:
        return self._change("DELETE", name, "")

    def _change(self, method: str, name: str, what: str, **options: Any) -> EditLog:
        log: EditLog = self._call(method, f"{self._path}/{quote(name, safe='')}{what}", EditLog, timeout=600, **options)
        return log
