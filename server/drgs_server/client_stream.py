"""The client's live connection to a session: messages and frames, without a screen (docs/protocol.md). client.py opens it."""

import json
from collections.abc import Iterator
from typing import Any

from pydantic import BaseModel
from websockets.sync.client import ClientConnection

from drgs_server.live.frame_header import FLAG_CONVERGED, FrameHeader, unpack_frame
from drgs_server.live.messages import ServerHello, server_message


class ServerError(Exception):
    """The server said no; the text is its sentence."""

    def __init__(self, status: int, detail: str) -> None:
        super().__init__(detail)
        self.status = status


class Stream:
    """Final. A viewer without a screen: say where to look, take frames as they come."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket = socket
        self._camera_number = 0
        self.messages: list[BaseModel] = []
        """Everything but frames that the server said, in order."""
        self.send(type="hello", v=1, client="drgs.client")
        while not self.messages or not isinstance(self.messages[-1], ServerHello):
            self.receive(timeout_seconds=120)
        self.hello: ServerHello = self.messages[-1]

    def send(self, **message: Any) -> None:
        self._socket.send(json.dumps(message))

    def look(self, width: int, height: int, world_from_camera: Any = None, fov_y_degrees: float | None = None) -> None:
        """Move the camera; the start view where nothing else is said."""
        start = self.hello.start_view
        self._camera_number += 1
        self.send(
            type="camera",
            number=self._camera_number,
            world_from_camera=world_from_camera or start.world_from_camera,
            fov_y_degrees=fov_y_degrees or start.fov_y_degrees,
            width=width,
            height=height,
        )

    def receive(self, timeout_seconds: float | None = None) -> tuple[FrameHeader, bytes] | None:
        """The next frame, acknowledged; or None after a text message, which is kept in `messages`.

        Raises:
            TimeoutError: nothing came.
            ServerError: something the client did, or that the server could not do.
        """
        received = self._socket.recv(timeout=timeout_seconds)
        if isinstance(received, str):
            message = server_message.validate_json(received)
            if message.type == "error":
                raise ServerError(400, message.message)
            self.messages.append(message)
            return None
        header, picture = unpack_frame(received)
        self.send(type="ack", frame_id=header.frame_id)
        return header, picture

    def frames(self, timeout_seconds: float | None = 60) -> Iterator[tuple[FrameHeader, bytes]]:
        """Frames until the converged one, and with it."""
        while True:
            frame = self.receive(timeout_seconds)
            if frame is not None:
                yield frame
                if frame[0].flags & FLAG_CONVERGED:
                    return
