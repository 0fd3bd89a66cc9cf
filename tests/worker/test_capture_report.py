"""What the doctor finds is told before a build begins, once, also when the build cannot begin."""

from pathlib import Path

import pytest

from drgs.reconstruct.progress import Progress
from drgs_worker.jobs.builders import BuildRequest, build_with_drgs
from drgs_worker.jobs.capture_report import CaptureReport, examine_capture
from tests.reconstruct.tiny_capture import write_nerf_synthetic


def told_until_read(capture: Path, out: Path, **more: str) -> tuple[list[Progress | CaptureReport], str | None]:
    """What a build says until its first stage is over, and why it ended there."""
    told: list[Progress | CaptureReport] = []
    request = BuildRequest(capture, out, "draft", 0, "cpu", **more)
    try:
        next(build_with_drgs(request, told.append, lambda: False))
    except ValueError as error:
        return told, str(error)
    return told, None


@pytest.mark.slow
def test_a_build_tells_what_the_doctor_found_before_it_reads_the_capture(tmp_path: Path) -> None:
    capture = write_nerf_synthetic(tmp_path / "capture")
    told, error = told_until_read(capture, tmp_path / "asset")
    assert error is None and [made.message for made in told[:3] if isinstance(made, Progress)] == [
        "checking the capture",
        "reading the capture",
    ]
    report = told[1]
    assert isinstance(report, CaptureReport) and "24 pictures of 72x56 with masks; the object fills" in report.summary
    assert [finding.level for finding in report.findings if finding.level != "info"] == []


def test_a_capture_that_cannot_be_read_says_why_and_what_to_do(tmp_path: Path) -> None:
    (tmp_path / "capture").mkdir()
    told, error = told_until_read(tmp_path / "capture", tmp_path / "asset")
    report = told[1]
    assert isinstance(report, CaptureReport) and error is not None
    (finding,) = report.findings
    assert finding.level == "error" and finding.sentence == error
    assert "transforms.json" in finding.advice and report.summary == ""


@pytest.mark.slow
def test_a_build_that_goes_on_does_not_examine_again_and_a_re_decoupling_not_at_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    capture = write_nerf_synthetic(tmp_path / "capture")
    kept = tmp_path / "asset.build" / "capture.json"
    first = examine_capture(capture, kept)
    monkeypatch.setattr("drgs.evaluate.doctor.doctor", lambda folder: pytest.fail("examined again"))
    assert examine_capture(capture, kept) == first
    told, error = told_until_read(capture, tmp_path / "other", materials="full")
    assert error is None and not any(isinstance(made, CaptureReport) for made in told)
