"""The WebSocket protocol of the server: uvicorn's own, but for text that is none. uvicorn writes a stack into the log for it, and where the caller's
close came together with it, raises out of the event loop."""

import logging

from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.protocol import State

CLOSE_NO_TEXT = 1007
"""Of RFC 6455: a message does not hold what its type says."""

log = logging.getLogger(__name__)


class TextStream(WebSocketsSansIOProtocol):
    """One stream."""

    def send_receive_event_to_app(self) -> None:
        """Called by uvicorn with a whole message in `frames`."""
        if self.curr_msg_data_type != "text" or self.close_sent or _is_text(self.frames):
            super().send_receive_event_to_app()
            return
        self.frames = []
        log.warning("a stream was closed, since a message of it was no text")
        if self.conn.state is State.OPEN:  # else its end is on the way
            self.conn.send_close(CLOSE_NO_TEXT, "text messages are UTF-8")
            self.handle_parser_exception()


def _is_text(frames: list[bytes]) -> bool:
    try:
        b"".join(frames).decode()
    except UnicodeDecodeError:
        return False
    return True
