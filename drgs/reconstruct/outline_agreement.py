"""Whether a finished mesh is the object of the photographs at all: how far its outlines agree with their masks.

Poses that do not belong to the pictures, or masks that mean something else, give an asset that is well fitted to nothing; whoever builds should
hear of it. In: a mesh, views with masks. Out: intersection over union of what both fill.
"""

import torch

from drgs.render.intersect.trace_rays import build_tracer, trace_rays
from drgs.scene.camera import pixel_rays_world, scaled_camera
from drgs.scene.mesh import TriangleMesh
from drgs.scene.views import Views

MOST_VIEWS = 12
"""Evenly chosen; each is asked at ASKED_SIDE."""
ASKED_SIDE = 160
"""[pixels]"""
POOR = 0.8
"""Below this something is wrong with the capture: assets of six public captures agree to 0.98 and more."""


@torch.no_grad()
def outline_agreement(mesh: TriangleMesh, views: Views) -> float:
    """0..1 over MOST_VIEWS of the views together; 0 where neither fills a pixel."""
    tracer, device = build_tracer(mesh), mesh.vertices.device
    both = either = 0
    step = max(1, len(views.cameras) // MOST_VIEWS)
    for camera, coverage in list(zip(views.cameras, views.coverage, strict=True))[::step]:
        small = scaled_camera(camera, min(1.0, ASKED_SIDE / max(camera.width, camera.height))).to(device)
        mask = coverage.to(device).float()[None, None] / 255
        masked = torch.nn.functional.interpolate(mask, (small.height, small.width), mode="area")[0, 0] > 0.5
        origin, directions = pixel_rays_world(small)
        direction = directions.reshape(-1, 3).contiguous()
        covered = trace_rays(origin.expand_as(direction).contiguous(), direction, tracer).hit.reshape(masked.shape)
        both += int((covered & masked).sum())
        either += int((covered | masked).sum())
    return both / either if either else 0.0


def complaint(agreement: float) -> str | None:
    """A sentence for whoever builds; None where all is well."""
    if agreement >= POOR:
        return None
    return (
        f"the outlines of what was built agree with the masks to {agreement:.0%} only, expected {POOR:.0%} or more; "
        "look at the poses and masks with drgs doctor, or build with a finer preset"
    )
