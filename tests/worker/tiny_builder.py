"""A builder that takes as long as its capture says, keeps a checkpoint, and writes down every iteration that it runs.

The capture holds plan.json: {"iterations", "seconds" (each), "fail" (sentence), "die_at" (iteration at which the process kills itself)}.
"""

import json
import os
import signal
import time
from collections.abc import Callable

from worker.builders import BuildProgress, BuildRequest, BuildStopped


def build(request: BuildRequest, progress: Callable[[BuildProgress], None], should_stop: Callable[[], bool]) -> None:
    plan = json.loads((request.dataset / "plan.json").read_text())
    work = request.out.with_name(request.out.name + ".build")
    work.mkdir(exist_ok=True)
    checkpoint, ran = work / "checkpoint.json", request.out.parent / "ran.txt"
    first = json.loads(checkpoint.read_text())["next"] if checkpoint.exists() else 0
    with ran.open("a") as log:
        for iteration in range(first, plan["iterations"]):
            if should_stop():
                raise BuildStopped
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
            progress(BuildProgress("fit", iteration + 1, plan["iterations"], fraction, psnr=20 + fraction, preview_jpeg=b"\xff\xd8tiny"))
    draft = request.out.with_name("asset.new")
    draft.mkdir(exist_ok=True)
    (draft / "asset.json").write_text(json.dumps({"counts": {"surfels": 7, "vertices": 12, "faces": 20}}))
    draft.rename(request.out)
