"""A picture as it came from the service: its file's bytes, which notebooks show."""


class Picture(bytes):
    """Final. PNG, JPEG or EXR, by its first bytes; the last is not shown, for no browser knows it."""

    def _repr_png_(self) -> bytes | None:
        return bytes(self) if self.startswith(b"\x89PNG") else None

    def _repr_jpeg_(self) -> bytes | None:
        return bytes(self) if self.startswith(b"\xff\xd8") else None

    def __repr__(self) -> str:
        return f"Picture of {len(self)} bytes"
