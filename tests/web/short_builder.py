"""The real builder with a tenth of a draft's iterations and a third of its faces: a whole build, its training included, in the time that a test has.

A worker that DRGS_BUILDER tells to use it goes through every stage as any other does; only the pictures it ends with are rougher.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from unittest.mock import patch

from drgs_worker.jobs.builders import BuildRequest, build_with_drgs
from drgs_worker.jobs.progress import Tell

FIT_ITERATIONS, MATERIAL_ITERATIONS = 40, 15
POINTS, MOST_SURFELS, SIDE = 3000, 4000, 128
MESH, PASS = {"resolution": 96, "face_limit": 10_000}, {"resolution": 80, "face_limit": 8000}
"""Of the first surface, and of the one that is fitted."""
HULL = {"coarse_cells": 32, "fine_cells": 96}
GRID = {"levels": ((12, 4),), "rays_a_step": 64}
"""In which hollows are looked for."""


def build(request: BuildRequest, tell: Tell, should_stop: Callable[[], bool]) -> Iterator[str]:
    from drgs.reconstruct.capture.find_hollows import HollowSettings
    from drgs.reconstruct.capture.radiance_grid import RadianceGridSettings
    from drgs.reconstruct.capture.visual_hull import VisualHullSettings
    from drgs.reconstruct.presets import PRESETS

    draft = PRESETS["draft"]
    fit = replace(draft.fit, iterations=FIT_ITERATIONS, densify=replace(draft.fit.densify, budget=MOST_SURFELS))
    surface = replace(draft.surface.surface, steps_a_round=MATERIAL_ITERATIONS)
    passes = replace(draft.surface, passes=1, surface=surface, mesh=replace(draft.surface.mesh, **PASS))
    materials = replace(draft.materials, iterations=MATERIAL_ITERATIONS, points_a_step=256)
    mesh, hull = replace(draft.mesh, **MESH), VisualHullSettings(**HULL)
    hollows = HollowSettings(RadianceGridSettings(**GRID))
    short = replace(
        draft, points=POINTS, image_side=SIDE, fit=fit, mesh=mesh, surface=passes, materials=materials, hull=hull, hollows=hollows
    )
    with patch.dict(PRESETS, draft=short):
        yield from build_with_drgs(request, tell, should_stop)
