"""The generated TypeScript is up to date, and the header is what the documentation says."""

import struct

import pytest
from pydantic import ValidationError

from drgs_server.generate_types import CONSTANTS_OUTPUT, OUTPUT, constants_text, typescript_from_schema, typescript_text
from drgs_server.live.frame_header import FRAME_HEADER, FrameHeader, pack_frame, unpack_frame
from drgs_server.live.messages import client_message


def test_the_generated_types_are_up_to_date() -> None:
    assert OUTPUT.read_text() == typescript_text(), "run: python -m drgs_server.generate_types"
    assert CONSTANTS_OUTPUT.read_text() == constants_text(), "run: python -m drgs_server.generate_types"


def test_the_frame_header_has_the_documented_layout() -> None:
    header = FrameHeader(1, 0, 0x0203, 7, 9, 640, 480, 12, 34, 56)
    packed = pack_frame(header, b"picture")
    assert FRAME_HEADER.size == 24 and packed[24:] == b"picture"
    assert packed[:24] == struct.pack("<BBHIIHHHHI", 1, 0, 0x0203, 7, 9, 640, 480, 12, 34, 56)
    assert unpack_frame(packed) == (header, b"picture")
    with pytest.raises(ValueError, match="at least 24 bytes"):
        unpack_frame(b"x" * 23)


def test_numbers_too_large_for_the_header_are_capped() -> None:
    header, _ = unpack_frame(pack_frame(FrameHeader(1, 0, 0, 1, 1, 1, 1, 10**6, 10**6, 10**12), b""))
    assert (header.spp, header.spp_target, header.render_us) == (65535, 65535, 2**32 - 1)


def test_a_schema_that_has_no_typescript_is_refused() -> None:
    with pytest.raises(ValueError):
        typescript_from_schema({"type": "object", "properties": {"a": {"type": "string"}}})


@pytest.mark.parametrize("key", ["a\\u0000b", "\\ud800", ""])
def test_a_key_of_a_client_is_text(key: str) -> None:
    """It is stored with the change, and not all databases hold all that JSON can say."""
    with pytest.raises(ValidationError):
        client_message.validate_json('{"type": "undo", "id": 1, "key": "' + key + '"}')
