"""What a simulation has made so far: all that the frames to come depend on."""

from dataclasses import dataclass

from drgs.deform.clip import ClipFrame
from drgs.deform.matter.mpm import State


@dataclass(frozen=True, eq=False)
class SimulationProgress:
    """Taken from and given to drgs.deform.matter.simulate.Simulation."""

    frames: tuple[ClipFrame, ...]
    """From frame 0, at rest, on."""
    state: State
    """Matter at the last of them."""
    totals: dict[str, int | bool]
    """For the report."""
    still: int
    """Frames at rest up to the last."""
