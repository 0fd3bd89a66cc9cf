"""A builder that takes as long as its capture says, keeps a checkpoint, and writes down every iteration that it runs.

The capture holds plan.json: {"iterations" (of the fit), "seconds" (each), "fail" (sentence), "die_at" (iteration at which the process
kills itself), "stage_seconds" (of every other stage), "found" (report on the capture)}. Each stage that really runs is written to stages.txt.
"""

import json
import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from drgs.reconstruct.progress import STAGE_SHARES, Progress
from drgs_worker.jobs.builders import BuildRequest
from drgs_worker.jobs.capture_report import CaptureReport
from drgs_worker.jobs.progress import JobStopped, Tell


def build(request: BuildRequest, progress: Tell, should_stop: Callable[[], bool]) -> Iterator[str]:
    plan = json.loads((request.dataset / "plan.json").read_text())
    work = request.out.with_name(request.out.name + ".build")
    work.mkdir(exist_ok=True)
    for stage in STAGE_SHARES[request.binding]:
        if stage == "fit":
            fit(request, plan, work, progress, should_stop)
        elif stage == "pack":
            pack(request, plan)
        else:
            other_stage(request.out.parent, stage, plan, work, progress, should_stop)
        yield stage


def note(folder: Path, stage: str, what: str) -> None:
    with (folder / "stages.txt").open("a") as log:
        log.write(f"{os.getpid()} {stage} {what}\n")


def other_stage(folder: Path, stage: str, plan: dict, work: Path, progress, should_stop) -> None:
    result = work / f"{stage}.safetensors"
    if result.exists() and stage != "read":  # reading is repeated, as in the real builder
        return
    note(folder, stage, "begins")
    progress(Progress(stage, 0, 0, 0.0))
    if stage == "read" and "found" in plan:
        progress(CaptureReport.model_validate(plan["found"]))
    until = time.monotonic() + plan.get("stage_seconds", 0)
    while time.monotonic() < until:
        if should_stop():
            raise JobStopped
        time.sleep(0.02)
    result.write_text(stage)
    note(folder, stage, "ends")


def pack(request: BuildRequest, plan: dict) -> None:
    note(request.out.parent, "pack", "begins")
    time.sleep(plan.get("stage_seconds", 0))
    draft = request.out.with_name("asset.new")
    draft.mkdir(exist_ok=True)
    (draft / "asset.json").write_text(json.dumps({"counts": {"surfels": 7, "vertices": 12, "faces": 20}, "materials": request.materials}))
    draft.rename(request.out)


def fit(request: BuildRequest, plan: dict, work: Path, progress, should_stop) -> None:
    checkpoint, ran = work / "checkpoint.json", request.out.parent / "ran.txt"
    first = json.loads(checkpoint.read_text())["next"] if checkpoint.exists() else 0
    with ran.open("a") as log:
        for iteration in range(first, plan["iterations"]):
            if should_stop():
                raise JobStopped
            if "fail" in plan:
                raise ValueError(plan["fail"])
            if iteration == plan.get("die_at"):
                os.kill(os.getpid(), signal.SIGKILL)
            time.sleep(plan["seconds"])
            log.write(f"{os.getpid()} {iteration}\n")
            log.flush()
            draft = work / "checkpoint.new"
            draft.write_text(json.dumps({"next": iteration + 1}))
            draft.rename(checkpoint)
            fraction = (iteration + 1) / plan["iterations"]
            progress(Progress("fit", iteration + 1, plan["iterations"], fraction, psnr=20 + fraction, preview_jpeg=b"\xff\xd8tiny"))
    if first < plan["iterations"]:
        (work / "stage1.safetensors").write_text("surfels")
    for name in plan.get("folders", ()):
        (work / name).mkdir(exist_ok=True)
        (work / name / "transforms.json").write_text("{}")
