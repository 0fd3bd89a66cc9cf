"""From reports of the steps of a build to `Progress`, with time left and a preview now and then, and calls of the step's own checkpoint."""

import time
from collections.abc import Callable, Mapping

import simplejpeg
import torch
from jaxtyping import Float
from torch import Tensor

from drgs.maths.color import srgb_from_linear
from drgs.reconstruct.fit.fit_loop import FitReport
from drgs.reconstruct.progress import Progress

PREVIEW_SECONDS = 3.0
"""Between preview pictures."""
CHECKPOINT_SECONDS = 30.0
REPORT_SECONDS = 0.2
"""Between reports of steps."""


class BuildReporter:
    """Final. Turns step reports into Progress, with a preview every few seconds and a checkpoint every half minute."""

    def __init__(self, progress: Callable[[Progress], None] | None, shares: Mapping[str, float], previews: bool = True) -> None:
        self.progress = progress
        self.previews = previews
        self.shares = shares
        self.started = time.monotonic()
        self.begun: dict[str, float] = {}
        """Share of a stage that was over before what reports on it now began."""
        self.last_preview = self.last_checkpoint = self.last_report = self.started

    def report(
        self,
        stage: str,
        share: float,
        message: str,
        report: FitReport | None = None,
        preview: Callable[[], bytes] | None = None,
        checkpoint: Callable[[], None] | None = None,
    ) -> None:
        now = time.monotonic()
        begun = self.begun.get(stage, 0.0)
        share = begun + (1 - begun) * share
        if checkpoint is not None and now - self.last_checkpoint > CHECKPOINT_SECONDS:
            checkpoint()
            self.last_checkpoint = now
        if self.progress is None or (
            report is not None and report.iteration < report.iterations and now - self.last_report < REPORT_SECONDS
        ):
            return
        self.last_report = now
        jpeg = None
        if self.previews and preview is not None and now - self.last_preview > PREVIEW_SECONDS:
            jpeg = preview()
            self.last_preview = time.monotonic()
        names = list(self.shares)
        fraction = sum(self.shares[n] for n in names[: names.index(stage)]) + share * self.shares[stage]
        spent = now - self.started
        eta = None
        if report is not None and report.iteration > 10:  # this stage's rate, scaled to what is left of the whole
            eta = report.seconds / report.iteration * (report.iterations - report.iteration)
            eta += max(0.0, 1 - fraction - (1 - share) * self.shares[stage]) * spent / max(fraction, 0.05)
        counts = (report.iteration, report.iterations) if report else (0, 0)
        self.progress(Progress(stage, *counts, fraction, report.psnr if report else None, message, eta, jpeg))


def encode_preview(radiance_linear: Float[Tensor, "height width 3"], coverage: Float[Tensor, "height width"]) -> bytes:
    """JPEG of a picture on mid grey."""
    alpha = coverage.clamp(0, 1)[..., None]
    image = srgb_from_linear(radiance_linear).clamp(0, 1) * alpha + 0.2 * (1 - alpha)
    return simplejpeg.encode_jpeg((image.detach().cpu() * 255).round().to(torch.uint8).contiguous().numpy(), quality=85)
