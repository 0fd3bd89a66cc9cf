"""One client's view of a session: what it asked for last, what it was sent, and what is worth doing next.

Inputs come from the event loop, `work()` runs on the render thread; `_lock` guards what both touch. Phases: moving (the client
changed something within MOVING_SECONDS: quick pictures), still (full size, samples add up), converged (one last frame, then nothing).
"""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from drgs_server.live.frame_header import (
    CAMERA_NUMBER_SHIFT,
    CODEC_JPEG,
    CODEC_PNG,
    FLAG_ALPHA,
    FLAG_CONVERGED,
    FLAG_MOVING,
    FRAME_KIND_PICTURE,
    FrameHeader,
    pack_frame,
)
from drgs_server.live.messages import MAX_FRAMES_IN_FLIGHT, CameraMessage, ErrorMessage, Phase, Settings, StatusMessage
from drgs_server.live.pace import CROWDED_SHARE, REDUCED_SECONDS, Pace
from drgs_server.render.encode import encode_jpeg, encode_png, has_alpha
from drgs_server.render.interface import AbstractPicture, AbstractPose

MOVING_SECONDS = 0.2
"""Without input, after which the picture counts as still."""
ANSWER_SECONDS = 0.03
"""Beyond the round trip, in which the next input of a row is waited for once its last one's picture is sent: a refinement begun meanwhile would be thrown
away and keep that picture waiting."""
STILL_FRAME_SECONDS = 0.25
"""Between two frames while samples add up; the first ones come as soon as their samples have doubled."""
STATUS_SECONDS = 0.2
ROUND_TRIP_WEIGHT = 0.2
"""Of the newest measurement."""


@dataclass(frozen=True)
class Posed:
    """The session's present state: what every viewer of it shows."""

    revision: int
    pose: AbstractPose


@dataclass(frozen=True)
class FrameStatistics:
    """Of what was sent to one client."""

    sent: int
    in_flight: int
    round_trip_ms: float | None


@dataclass(frozen=True)
class _Inputs:
    generation: int
    """Rises with everything that changes the picture."""
    camera: CameraMessage
    settings: Settings
    posed: Posed


@dataclass
class _Progress:
    """Of the picture in work."""

    inputs: _Inputs
    picture: AbstractPicture
    scale: float
    begun_at: float
    pace: Pace
    """That said the scale."""
    seconds: float = 0.0
    """That its first part took."""
    rests_until: float = 0.0
    """Nothing is added before, unless something comes in."""
    samples_sent: int = 0
    sent_at: float = 0.0
    converged_sent: bool = False


class Viewer:
    """Final. `deliver` is called on the render thread with frames (bytes), status messages and errors."""

    def __init__(
        self,
        deliver: Callable[[bytes | StatusMessage | ErrorMessage], None],
        posed: Callable[[], Posed | None],
        decodes_png: bool = True,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._deliver = deliver
        self._posed = posed
        self._decodes_png = decodes_png
        self._clock = clock
        self._lock = threading.Lock()
        self._moving_pace, self._resting_pace = Pace(), Pace()
        """While the camera moves; and of edits before a camera that rests, which take less: what it sees is known."""
        self._generation = 0
        self._camera: CameraMessage | None = None
        self._settings = Settings()
        self._visible = True
        self._input_at = -MOVING_SECONDS
        self._in_a_row = False
        """The last input came soon after the one before."""
        self._last_frame_id = 0
        self._acked_frame_id = 0
        self._sent_at: dict[int, float] = {}
        """Of frames that were not acknowledged yet; as many as may be in flight."""
        self._round_trip: float | None = None
        self._progress: _Progress | None = None
        self._rendered_seconds = 0.0
        self._frame_seconds = 0.0
        self._last_frame_at: float | None = None
        self._phase: Phase = "still"
        self._status_at = -STATUS_SECONDS

    # ---- inputs, from the event loop --------------------------------------------------------------------------------

    def set_camera(self, camera: CameraMessage) -> None:
        """Latest wins; the very same one changes nothing. A new number is answered by a frame even where it looks the same: that is how
        a client tells frames from before a change of its settings from those after it."""
        with self._lock:
            before, self._camera = self._camera, camera
            if before != camera:
                self._touch()

    def set_settings(self, settings: Settings) -> None:
        with self._lock:
            if settings != self._settings:
                self._settings = settings
                self._touch()

    def set_visible(self, visible: bool) -> None:
        with self._lock:
            self._visible = visible

    def scene_changed(self) -> None:
        """The session was edited, by whomever."""
        with self._lock:
            self._touch()

    def acknowledge(self, frame_id: int) -> None:
        """This frame and those before it were shown or dropped."""
        with self._lock:
            acked = min(frame_id, self._last_frame_id)
            if acked > self._acked_frame_id and (sent_at := self._sent_at.get(acked)) is not None:
                trip = self._clock() - sent_at
                before = self._round_trip
                self._round_trip = trip if before is None else before + ROUND_TRIP_WEIGHT * (trip - before)
            for known in [known for known in self._sent_at if known <= acked]:
                del self._sent_at[known]
            self._acked_frame_id = max(self._acked_frame_id, acked)

    def _touch(self) -> None:
        self._generation += 1
        self._in_a_row = self.moving
        self._input_at = self._clock()

    @property
    def settings(self) -> Settings:
        return self._settings

    @property
    def picture(self) -> AbstractPicture | None:
        """The newest one, for picking; use it on the render thread."""
        return self._progress.picture if self._progress else None

    def newest(self) -> tuple[int | None, AbstractPicture | None, FrameStatistics]:
        """Revision of the log that the newest picture shows, the picture, and how sending goes."""
        with self._lock:
            progress, trip = self._progress, self._round_trip
            statistics = FrameStatistics(
                self._last_frame_id, self._last_frame_id - self._acked_frame_id, None if trip is None else 1e3 * trip
            )
        if progress is None:
            return None, None, statistics
        return progress.inputs.posed.revision, progress.picture, statistics

    @property
    def moving(self) -> bool:
        return self._clock() - self._input_at < MOVING_SECONDS

    # ---- work, on the render thread ---------------------------------------------------------------------------------

    def tell_error(self, sentence: str) -> None:
        """That work failed; the client goes on."""
        self._deliver(ErrorMessage(message=sentence))

    def due_at(self, crowded: bool = False) -> float | None:
        """When `work()` has something to do: a time of the clock (0 for now), or None until the next input or ack.

        Args:
            crowded: others want the cores.
        """
        with self._lock:
            inputs = self._inputs()
            if inputs is None or self._last_frame_id - self._acked_frame_id >= MAX_FRAMES_IN_FLIGHT:
                return None
        progress = self._progress
        if progress is None:
            return 0.0
        if progress.inputs.generation != inputs.generation:
            # Other work, for which a picture was reduced, gets the rest of the time.
            apart = max(REDUCED_SECONDS, progress.seconds / CROWDED_SHARE) if crowded else REDUCED_SECONDS
            return 0.0 if progress.scale == 1 else progress.begun_at + apart
        if progress.scale < 1:
            return self._input_at + MOVING_SECONDS
        return None if progress.converged_sent else progress.rests_until

    def _inputs(self) -> _Inputs | None:
        posed = self._posed()
        if not self._visible or self._camera is None or posed is None:
            return None
        return _Inputs(self._generation, self._camera, self._settings, posed)

    def work(self) -> None:
        """One slice: begin a picture or refine the one there is, and send it when that is worth a frame."""
        with self._lock:
            inputs = self._inputs()
            moving = self.moving
        if inputs is None:
            return
        progress = self._progress
        start = self._clock()
        changed = progress is None or progress.inputs.generation != inputs.generation
        # The first answer to an input is always the quick one, however late this thread got to it.
        moving = moving or changed
        begun = changed or (progress is not None and progress.scale < 1 and not moving)
        if begun:
            progress = self._progress = self._begin(inputs, moving)
        else:
            assert progress is not None
            if progress.picture.samples < progress.picture.samples_target:
                progress.picture.refine()
        picture = progress.picture
        converged = picture.samples >= picture.samples_target and progress.scale == 1
        self._rendered_seconds += self._clock() - start
        if not (begun or converged or self._worth_a_frame(progress)):
            return
        with self._lock:
            overtaken = self._generation != inputs.generation
        # A drag would never show anything if its pictures were dropped; refinements and last frames can be.
        if overtaken and not begun:
            return
        self._send(progress, moving and begun, converged and not overtaken)
        if begun:
            if self._in_a_row:
                progress.rests_until = self._clock() + min(ANSWER_SECONDS + (self._round_trip or 0.0), MOVING_SECONDS)
            progress.seconds = self._clock() - start
            progress.pace.measured(picture.width, picture.height, progress.scale, progress.seconds)

    def _begin(self, inputs: _Inputs, moving: bool) -> _Progress:
        asked, begun_at = inputs.camera, self._clock()
        rests = self._progress is not None and self._progress.inputs.camera.sees_as(asked)
        pace = self._resting_pace if rests else self._moving_pace
        scale = pace.scale(asked.width, asked.height) if moving else 1.0
        width, height = max(round(asked.width * scale), 1), max(round(asked.height * scale), 1)
        previous = self._progress.picture if self._progress else None
        picture = inputs.posed.pose.begin(asked, inputs.settings, width, height, previous)
        picture.refine()
        return _Progress(inputs, picture, scale, begun_at, pace)

    def _worth_a_frame(self, progress: _Progress) -> bool:
        waited = self._clock() - progress.sent_at
        doubled = progress.picture.samples >= 2 * progress.samples_sent
        return waited >= STILL_FRAME_SECONDS or (doubled and waited >= STILL_FRAME_SECONDS / 3)

    def _send(self, progress: _Progress, moving: bool, converged: bool) -> None:
        start = self._clock()
        picture, inputs = progress.picture, progress.inputs
        pixels = picture.resolve()
        lossless = converged and self._decodes_png
        encoded = encode_png(pixels) if lossless else encode_jpeg(pixels, moving)
        now = self._clock()
        self._rendered_seconds += now - start
        flags = FLAG_MOVING * moving | FLAG_CONVERGED * converged | FLAG_ALPHA * (lossless and has_alpha(pixels))
        with self._lock:
            self._last_frame_id += 1
            frame_id = self._last_frame_id
            self._sent_at[frame_id] = self._clock()
        header = FrameHeader(
            kind=FRAME_KIND_PICTURE,
            codec=CODEC_PNG if lossless else CODEC_JPEG,
            flags=flags | (inputs.camera.number & 0xFF) << CAMERA_NUMBER_SHIFT,
            frame_id=frame_id,
            state_rev=inputs.posed.revision,
            width=picture.width,
            height=picture.height,
            spp=picture.samples,
            spp_target=picture.samples_target,
            render_us=int(self._rendered_seconds * 1e6),
        )
        self._deliver(pack_frame(header, encoded))
        if self._last_frame_at is not None:
            interval = min(now - self._last_frame_at, 1.0)
            self._frame_seconds = interval if not self._frame_seconds else self._frame_seconds + 0.3 * (interval - self._frame_seconds)
        self._last_frame_at = now
        progress.samples_sent, progress.sent_at, progress.converged_sent = picture.samples, now, converged
        self._send_status("converged" if converged else "moving" if moving else "still", progress, now)
        self._rendered_seconds = 0.0

    def _send_status(self, phase: Phase, progress: _Progress, now: float) -> None:
        if phase == self._phase and now - self._status_at < STATUS_SECONDS:
            return
        self._phase, self._status_at = phase, now
        picture = progress.picture
        notes = list(picture.notes)
        if progress.scale < 1:
            notes.append(
                f"moving: {progress.scale:.0%} of the width, because this machine needs longer for all of it; at most {1 / REDUCED_SECONDS:.0f} a second"
            )
        self._deliver(
            StatusMessage(
                phase=phase,
                width=picture.width,
                height=picture.height,
                scale=progress.scale,
                spp=picture.samples,
                spp_target=picture.samples_target,
                frames_per_second=1 / self._frame_seconds if self._frame_seconds else 0.0,
                render_ms=self._rendered_seconds * 1e3,
                notes=notes,
            )
        )
