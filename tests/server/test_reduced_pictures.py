"""What is done between moving pictures: those that were made smaller leave time to other work, and none is refined that the next one will replace."""

import pytest

from drgs_server.live.frame_header import unpack_frame
from drgs_server.live.messages import CameraMessage, ErrorMessage, Settings, StatusMessage
from drgs_server.live.pace import CROWDED_SHARE, REDUCED_SECONDS
from drgs_server.live.viewer import ANSWER_SECONDS, MOVING_SECONDS, Posed, Viewer
from drgs_server.render.interface import AbstractPicture
from tests.server.painter import PaintedPose, Painter, Painting


class SlowPose(PaintedPose):
    """Painting takes the clock's time, by the pixel."""

    def __init__(self, seconds: float) -> None:
        super().__init__(Painter(), 0)
        self.seconds, self.now = seconds, 0.0

    def begin(self, camera: CameraMessage, settings: Settings, width: int, height: int, previous: AbstractPicture | None) -> Painting:
        self.now += self.seconds * width * height / (camera.width * camera.height)
        return super().begin(camera, settings, width, height, previous)


def moved(viewer: Viewer, number: int) -> None:
    pose = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 2.0 + 0.01 * number), (0.0, 0.0, 0.0, 1.0))
    viewer.set_camera(CameraMessage(type="camera", number=number, world_from_camera=pose, fov_y_degrees=40, width=640, height=480))


@pytest.mark.parametrize(("seconds", "waits"), [(0.02, False), (0.15, True), (0.3, True)])
def test_only_after_a_reduced_picture_the_next_one_waits(seconds: float, waits: bool) -> None:
    pose, said = SlowPose(seconds), list[bytes | StatusMessage | ErrorMessage]()
    viewer = Viewer(said.append, lambda: Posed(0, pose), clock=lambda: pose.now)
    for number in range(6):
        moved(viewer, number)
        pose.now = max(pose.now, viewer.due_at() or 0.0)
        began = pose.now
        viewer.work()
        viewer.acknowledge(10_000)
    moved(viewer, 6)
    assert viewer.due_at() == (pytest.approx(began + REDUCED_SECONDS) if waits else 0.0)
    notes = [note for message in said if isinstance(message, StatusMessage) for note in message.notes]
    assert any(f"at most {1 / REDUCED_SECONDS:.0f} a second" in note for note in notes) == waits
    took = pose.now - began
    crowded = began + max(REDUCED_SECONDS, took / CROWDED_SHARE)
    assert viewer.due_at(crowded=True) == (pytest.approx(crowded) if waits else 0.0)


def test_one_input_is_refined_at_once_and_those_in_a_row_when_the_next_one_does_not_come() -> None:
    pose = SlowPose(0.02)
    viewer = Viewer(lambda said: None, lambda: Posed(0, pose), clock=lambda: pose.now)

    def work() -> None:
        viewer.work()
        viewer.acknowledge(10_000)

    moved(viewer, 0)
    work()
    assert viewer.due_at() == 0.0, "nothing says that there will be another one"
    pose.now += 2 * MOVING_SECONDS
    moved(viewer, 1)
    work()
    assert viewer.due_at() == 0.0
    moved(viewer, 2)
    work()
    assert viewer.due_at() == pytest.approx(pose.now + ANSWER_SECONDS)
    moved(viewer, 3)
    assert viewer.due_at() == 0.0, "it is not waited with"
    work()
    pose.now += ANSWER_SECONDS
    work()
    due = viewer.due_at()
    assert due is not None and due <= pose.now, "refined from then on"


def test_that_moving_pictures_are_slow_makes_none_of_an_edit_smaller_before_a_camera_that_rests() -> None:
    pose, widths = SlowPose(0.15), list[int]()

    def heard(said: bytes | StatusMessage | ErrorMessage) -> None:
        if isinstance(said, bytes):
            widths.append(unpack_frame(said)[0].width)

    viewer = Viewer(heard, lambda: Posed(0, pose), clock=lambda: pose.now)
    for number in range(6):
        moved(viewer, number)
        pose.now = max(pose.now, viewer.due_at() or 0.0)
        viewer.work()
        viewer.acknowledge(10_000)
    assert widths[-1] < 640
    pose.now += 2 * MOVING_SECONDS
    pose.seconds = 0.03  # what the camera sees is known
    for _ in range(3):
        viewer.scene_changed()
        pose.now += MOVING_SECONDS
        viewer.work()
        viewer.acknowledge(10_000)
        assert widths[-1] == 640
    moved(viewer, 7)
    viewer.work()
    assert widths[-1] < 640, "the camera moves again, and what its pictures take is remembered"
