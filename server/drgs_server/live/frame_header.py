"""The binary frames of the stream: 24 bytes that say what the picture is, then the picture file. docs/protocol.md has the layout.

`generate_types.py` writes the constants, and a reader of the header, for the viewer. Source: service reference, section 4.3.
"""

import struct
from dataclasses import dataclass

FRAME_HEADER = struct.Struct("<BBHIIHHHHI")
"""24 bytes, little-endian, then the picture file."""
FRAME_KIND_PICTURE = 1
CODEC_JPEG = 0
CODEC_PNG = 1
FLAG_MOVING = 1
"""Reduced size or samples, because the viewer is changing something."""
FLAG_CONVERGED = 2
"""Last frame until something changes."""
FLAG_ALPHA = 4
CAMERA_NUMBER_SHIFT = 8
"""Bits 8..15 of the flags hold the low 8 bits of the number of the camera shown."""


@dataclass(frozen=True)
class FrameHeader:
    """Meaning of the 24 bytes before a picture."""

    kind: int
    codec: int
    flags: int
    frame_id: int
    """Counts up from 1, a viewer."""
    state_rev: int
    """Revision of the edit log that the picture shows."""
    width: int
    height: int
    spp: int
    spp_target: int
    render_us: int
    """Time spent rendering since the last frame [microseconds]."""


def pack_frame(header: FrameHeader, picture: bytes) -> bytes:
    """Header and picture as one WebSocket message."""
    return (
        FRAME_HEADER.pack(
            header.kind,
            header.codec,
            header.flags,
            header.frame_id,
            header.state_rev,
            header.width,
            header.height,
            min(header.spp, 65535),
            min(header.spp_target, 65535),
            min(header.render_us, 2**32 - 1),
        )
        + picture
    )


def unpack_frame(message: bytes) -> tuple[FrameHeader, bytes]:
    """Inverse of `pack_frame`.

    Raises:
        ValueError: the message is shorter than a header.
    """
    if len(message) < FRAME_HEADER.size:
        raise ValueError(f"a frame has at least {FRAME_HEADER.size} bytes; found {len(message)}")
    return FrameHeader(*FRAME_HEADER.unpack_from(message)), message[FRAME_HEADER.size :]
