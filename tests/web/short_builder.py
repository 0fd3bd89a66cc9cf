"""The real builder with a tenth of a draft's iterations: a whole build, its training included, in the time that a test has.

A worker that DRGS_BUILDER tells to use it goes through every stage as any other does; only the pictures it ends with are rougher.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from unittest.mock import patch

from drgs_worker.jobs.builders import BuildRequest, build_with_drgs
from drgs_worker.jobs.progress import Tell

FIT_ITERATIONS, MATERIAL_ITERATIONS = 40, 15


def build(request: BuildRequest, tell: Tell, should_stop: Callable[[], bool]) -> Iterator[str]:
    from drgs.reconstruct.build_asset import PRESETS

    draft = PRESETS["draft"]
    fit = replace(draft.fit, iterations=FIT_ITERATIONS)
    passes = replace(draft.surface, passes=1, surface=replace(draft.surface.surface, steps_a_round=MATERIAL_ITERATIONS))
    materials = replace(draft.materials, iterations=MATERIAL_ITERATIONS)
    with patch.dict(PRESETS, draft=replace(draft, fit=fit, surface=passes, materials=materials)):
        yield from build_with_drgs(request, tell, should_stop)
