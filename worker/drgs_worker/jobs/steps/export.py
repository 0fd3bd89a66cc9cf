"""Exports: files for other programs, each written by the file tool in a process of its own."""

import json
import os

from drgs.exchange.export_formats import FILE_KINDS, TEXTURED_FORMATS, VARIANT_FORMATS
from drgs.reconstruct.progress import Progress
from drgs.scene.edits import plain_edit
from drgs_worker.jobs.begin_tool import begin_tool
from drgs_worker.jobs.progress import JobStopped
from drgs_worker.jobs.requests import ExportRequest
from drgs_worker.jobs.steps.job_run import AbstractJobRun, JobContext

POLL_SECONDS = 0.2
END_SECONDS = 10.0
"""For a tool that is told to stop; the kernel ends it."""


class ExportRun(AbstractJobRun):
    """Final."""

    def __init__(self, job: JobContext) -> None:
        self._job = job
        self._asked = ExportRequest.model_validate(job.parameters)
        self._formats = {f"export {format}": format for format in self._asked.formats}
        self.steps = tuple(self._formats)

    def run(self, step: str) -> None:
        job, format = self._job, self._formats[step]
        job.files.mkdir(exist_ok=True)
        out = job.files / f"asset-{format}{FILE_KINDS[format].suffix}"
        draft = out.with_name(f"draft-{out.name}")
        source = job.fetch_asset(self._asked.asset)
        faces = self._asked.faces if format in TEXTURED_FORMATS else None
        variants = self._variants() if format in VARIANT_FORMATS else ()
        tool = begin_tool("export", str(source), str(draft), format, str(faces or 0), *variants)
        try:
            while not tool.wait(POLL_SECONDS):
                if job.should_stop():
                    tool.stop()
                    tool.wait(END_SECONDS)
                    raise JobStopped
        except BaseException:
            draft.unlink(missing_ok=True)
            raise
        finally:
            tool.close()
        code, errors = tool.result()
        if code != 0:
            draft.unlink(missing_ok=True)
            lines = errors.strip().splitlines()
            raise ValueError(lines[-1][:1000] if code == 2 and lines else f"writing {format} failed: {errors[-500:]}")
        os.replace(draft, out)
        done = self.steps.index(step) + 1
        job.progress(Progress("export", done, len(self.steps), done / len(self.steps), message=out.name))

    def _variants(self) -> tuple[str, ...]:
        """What the tool is told of them: the file that they are in, and where their edits find theirs."""
        job, variants = self._job, self._asked.variants
        if not variants:
            return ()
        job.fetch_edit_files([edit for variant in variants for edit in variant.edits])
        listed = job.folder / "variants.json"
        listed.write_text(json.dumps({variant.name: [plain_edit(edit) for edit in variant.edits] for variant in variants}))
        return str(listed), str(job.directory.environments)
