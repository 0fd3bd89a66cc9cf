"""The doctor on light: how pictures are exposed, and what the lamps stood still with."""

from collections.abc import Sequence
from dataclasses import asdict

import numpy as np
import torch

from drgs.evaluate.doctor.findings import Finding, Section
from drgs.reconstruct.capture.exposure_gains import spread
from drgs.reconstruct.capture.exposures import VARIED_STOPS, brightness_stops, jumps
from drgs.reconstruct.capture.initial_points import InitialPoints
from drgs.reconstruct.capture.load_views.capture import Capture
from drgs.reconstruct.capture.turning_light import light_found
from drgs.scene.views import Views

CLIPPED_BYTE = 254
MUCH_CLIPPED = 0.05


def exposure(views: Views, points: InitialPoints, known: Sequence[str]) -> Section:
    """What pictures lose at both ends and how differently they are exposed, but for those of which something is said already (`known`)."""
    kept = [camera.name not in known for camera in views.cameras]
    kept = kept if any(kept) else [True] * len(kept)
    object_pixels = torch.cat(
        [image[mask > 200] for image, mask, is_kept in zip(views.images_srgb, views.coverage, kept, strict=True) if is_kept]
    )
    clipped_share = float((object_pixels >= CLIPPED_BYTE).any(-1).sum()) / max(1, len(object_pixels))
    black_share = float((object_pixels <= 1).all(-1).sum()) / max(1, len(object_pixels))
    stops = brightness_stops(views, points)
    findings = []
    if clipped_share > MUCH_CLIPPED:
        findings.append(
            Finding(
                "warning",
                f"{100 * clipped_share:.1f} % of the object's pixels are over-exposed.",
                "Expose for the highlights: clipped ones hide how bright the light and how smooth the surface is.",
            )
        )
    if black_share > 0.3:
        findings.append(
            Finding("warning", f"{100 * black_share:.0f} % of the object's pixels are black.", "Use longer exposures or more light.")
        )
    of_others = np.where(kept, stops, np.nan)
    if jumps(of_others, views) > VARIED_STOPS:
        findings.append(
            Finding(
                "warning",
                f"The same points differ in brightness by {spread(of_others):.2f} stops between views; a build takes that for their exposures, "
                "unless the light turns with the camera.",
                "Lock exposure and white balance, and keep the light still.",
            )
        )
    summary = {
        "clipped_share": round(clipped_share, 4),
        "black_share": round(black_share, 4),
        "brightness_variation_stops": round(spread(stops), 4),
    }
    return summary, findings


def light(capture: Capture, views: Views, points: InitialPoints) -> Section:
    """What the light stood still with."""
    found = light_found(capture, views, points)
    findings = []
    if found.frame == "camera":
        findings.append(
            Finding(
                "info",
                f"The light stands still with the camera, as on a turntable, for {found.why}.",
                "If the camera went around the object all the same, build with --light object.",
            )
        )
    if found.wants_trial:
        findings.append(
            Finding(
                "info",
                f"The light may stand still with the camera, as on a turntable: {found.why}.",
                "A build tries both; say --light object or --light camera if you know.",
            )
        )
    return {key: value for key, value in asdict(found).items() if value is not None}, findings
