"""Builds and re-decouplings: the builder's stages, each a durable step, then the asset's move to its place."""

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from drgs.reconstruct.progress import POSED, STAGE_SHARES
from drgs.scene.strokes import Stroke, parse_strokes
from drgs_worker.jobs.builders import BuildRequest, Corner
from drgs_worker.jobs.requests import CameraName, LightName, MaskName
from drgs_worker.jobs.retry_while_unavailable import retry_while_unavailable
from drgs_worker.jobs.steps.job_run import AbstractJobRun, JobContext
from drgs_worker.store.artifacts import fetch_capture, refresh_job
from drgs_worker.store.register_asset import register_asset

KEPT_CHECKPOINTS = {
    "particles": ("stage1.safetensors", "mesh.safetensors", "surface.safetensors"),
    "mesh": ("stage1.safetensors", "mesh.safetensors", "surface.safetensors", "mesh_surfels.safetensors"),
}
"""Of a finished build of either binding: what a re-decoupling starts from."""
FOUND_BEFORE = ("masks.safetensors", "ground.safetensors", "ground_again.safetensors", "light.safetensors", "hollows.safetensors")
"""What it would look for once more otherwise; not every build did."""


class BuildRun(AbstractJobRun):
    """Final. One generator runs through the stages, so that a build that nothing disturbs reads its capture once."""

    def __init__(self, job: JobContext) -> None:
        self._job = job
        self._stages: Iterator[str] | None = None
        self._binding: str = job.parameters.get("binding", "particles")
        self._light: LightName = job.parameters.get("light", "auto")
        self._masks: MaskName = job.parameters.get("masks", "given")  # as in builds of before there was a choice
        self._cameras: CameraName = job.parameters.get("cameras", "given")
        x, y, z = job.parameters.get("up", (0.0, 0.0, 1.0))
        self._up: tuple[float, float, float] = (x, y, z)
        self._box = _corners(job.parameters.get("box"))
        self._strokes: tuple[Stroke, ...] = parse_strokes(job.parameters.get("strokes", []), "job")
        self.steps: tuple[str, ...] = (*STAGE_SHARES[self._binding], "register")

    def run(self, step: str) -> None:
        job = self._job
        if step == "register":
            self._register()
            return
        request = self._request()
        if request.out.exists():
            return  # packed; the crash came before the step was recorded
        if self._stages is None:
            dataset = retry_while_unavailable(lambda: fetch_capture(job.directory, request.dataset), job.should_stop)
            request = replace(request, dataset=dataset)
            if not request.dataset.is_dir():
                raise ValueError(f"The capture {request.dataset.name} is gone; it was removed after the job was made.")
            self._stages = job.builder(request, job.progress, job.should_stop)
        if step not in self._stages:  # runs it up to and with this stage; finished ones come from their checkpoints
            raise ValueError(f"the builder ended before its stage {step!r}")

    def _request(self) -> BuildRequest:
        job = self._job
        assert job.dataset is not None
        given = job.parameters
        out = job.folder / "asset"
        return BuildRequest(
            job.dataset,
            out,
            given["preset"],
            given["seed"],
            job.device,
            binding=self._binding,
            light=self._light,
            up=self._up,
            box=self._box,
            strokes=self._strokes,
            masks=self._masks,
            cameras=self._cameras,
        )

    def _register(self) -> None:
        """Does nothing that was already done."""
        job = self._job
        built, place = job.folder / "asset", job.directory.asset(job.job_id)
        if built.exists() and not place.exists():
            built.rename(place)
        retry_while_unavailable(lambda: register_asset(job.directory, job.engine, job.job_id, job.name, "build"), job.should_stop)
        work = Path(f"{built}.build")
        for path in work.iterdir() if work.is_dir() else ():
            if path.name in (*KEPT_CHECKPOINTS[self._binding], *FOUND_BEFORE, POSED):
                continue
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink()


class RedecoupleRun(BuildRun):
    """Final. A build that starts from another one's geometry."""

    def __init__(self, job: JobContext) -> None:
        super().__init__(job)
        self.steps = ("copy", *self.steps)

    def run(self, step: str) -> None:
        if step == "copy":
            self._copy()
        else:
            super().run(step)

    def _copy(self) -> None:
        job = self._job
        retry_while_unavailable(lambda: refresh_job(job.directory, job.parameters["asset"]), job.should_stop)
        source, work = job.directory.job(job.parameters["asset"]) / "asset.build", job.folder / "asset.build"
        work.mkdir(exist_ok=True)
        for name in (*KEPT_CHECKPOINTS[self._binding], *FOUND_BEFORE):
            if not (source / name).is_file():
                if name in FOUND_BEFORE:
                    continue
                raise ValueError("This asset's geometry was not kept by a build on this service; build it here first.")
            draft = work / f"{name}.part"
            shutil.copyfile(source / name, draft)
            draft.rename(work / name)
        if (source / POSED).is_dir() and not (work / POSED).exists():
            draft = work / f"{POSED}.part"
            shutil.rmtree(draft, ignore_errors=True)
            shutil.copytree(source / POSED, draft)
            draft.rename(work / POSED)

    def _request(self) -> BuildRequest:
        job, given = self._job, self._job.parameters
        assert job.dataset is not None
        out = job.folder / "asset"
        preset, seed = given["built_preset"], given["built_seed"]
        return BuildRequest(
            job.dataset,
            out,
            preset,
            seed,
            job.device,
            given["preset"],
            self._binding,
            self._light,
            self._up,
            self._box,
            self._strokes,
            self._masks,
            self._cameras,
        )


def _corners(box: dict[str, list[float]] | None) -> tuple[Corner, Corner] | None:
    """Of a request's box as the job's row keeps it."""
    if box is None:
        return None
    (a, b, c), (d, e, f) = box["low"], box["high"]
    return (a, b, c), (d, e, f)
