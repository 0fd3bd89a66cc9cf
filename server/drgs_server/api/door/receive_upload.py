"""Uploaded files: one `file` part streamed to disk by the form parser, and a few short fields beside it."""

from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import IO

from fastapi import Request
from starlette.datastructures import FormData, UploadFile

from drgs_server.api.problems import ProblemError
from drgs_worker.store.user_names import check_name, name_from_file

MAX_FIELDS = 16


@dataclass(frozen=True)
class Upload:
    """Close it when done; its temporary file goes with it."""

    form: FormData
    file: UploadFile
    suffix: str
    """Lower case, one of those that were allowed."""
    stem: str
    """Of the sender's file name, as a name: shown as a title, never used as a path."""

    @property
    def stream(self) -> IO[bytes]:
        return self.file.file

    def field(self, name: str) -> str | None:
        value = self.form.get(name)
        return value.strip()[:100] if isinstance(value, str) and value.strip() else None

    def name(self) -> str:
        """The field `name`, or the sender's file name where there is none.

        Raises:
            ProblemError: it is no name.
        """
        value = self.form.get("name")
        if not isinstance(value, str) or not value.strip():
            return self.stem
        try:
            return check_name(value)
        except ValueError as error:
            raise ProblemError(422, f"name: {error}") from error

    def given(self, *names: str) -> dict[str, str]:
        """Those fields that were sent."""
        return {name: value for name in names if (value := self.field(name)) is not None}

    async def close(self) -> None:
        await self.form.close()


async def receive_upload(request: Request, suffixes: set[str]) -> Upload:
    """Read the multipart body.

    Raises:
        ProblemError: no part `file`, or its name ends otherwise than allowed.
    """
    form = await request.form(max_files=1, max_fields=MAX_FIELDS, max_part_size=1 << 20)
    file = form.get("file")
    name = PurePosixPath((file.filename or "").replace("\\", "/")).name if isinstance(file, UploadFile) else ""
    path = PurePosixPath(name)
    if not isinstance(file, UploadFile) or path.suffix.lower() not in suffixes:
        await form.close()
        raise ProblemError(422, f"Expected a multipart part `file` whose name ends in {', '.join(sorted(suffixes))}; found {name[:80]!r}.")
    return Upload(form, file, path.suffix.lower(), name_from_file(path.stem, "upload"))
