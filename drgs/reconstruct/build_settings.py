"""What a user chooses of a build, and what is wrong with it.

In: what the command line, the API or a script says. Out: BuildSettings; a sentence for what cannot be built so.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from drgs.reconstruct.capture.build_box import BuildBox
from drgs.reconstruct.capture.turn_up import UP, Direction, rotation_to_up
from drgs.reconstruct.capture.turning_light import LIGHT_CHOICES, LightChoice
from drgs.reconstruct.presets import PRESETS
from drgs.reconstruct.progress import STAGE_SHARES
from drgs.scene.strokes import Stroke

BINDINGS = tuple(STAGE_SHARES)


@dataclass(frozen=True)
class BuildSettings:
    """What a user chooses."""

    preset: str = "fast"
    """draft, fast or full."""
    binding: str = "particles"
    """particles: surfels lie on the surface as it was fitted. mesh: those on its faces are fitted to the photographs once more."""
    device: str = "auto"
    """auto, cpu or cuda."""
    seed: int = 0
    resume: bool = False
    light: LightChoice = "auto"
    """What the lamps stood still with while the photographs were taken."""
    masks: Literal["auto", "given"] = "auto"
    """Where they end: auto: where the photographs show the object to end (sharpen_masks); given: as the capture or the strokes have it."""
    cameras: Literal["auto", "given"] = "auto"
    """Where photographs were taken from: auto: where they fit the surface best, if the given places are off (register_cameras); given: where the capture, or
    COLMAP, has them."""
    up: Direction = UP
    """Direction of the capture's world that points up. The asset's world is the capture's, turned so that it is z (turn_up.rotation_to_up)."""
    box: BuildBox | None = None
    """Of the asset's world: what lies outside is not built. None: all of the object is."""
    strokes: tuple[Stroke, ...] = ()
    """What is the object in some pictures, and what is not: the masks of all follow from them, whatever masks the capture has. None: its own count."""
    materials: str | None = None
    """Preset of the stage `materials` alone: None is `preset`. It is how material and light are separated anew on kept geometry."""


def check_settings(settings: BuildSettings, out: Path) -> None:
    """Whether an asset can be built so.

    Args:
        out: the asset folder to write; OUT.build beside it will hold checkpoints.

    Raises:
        ValueError: it cannot; one sentence.
    """
    checkpoints = Path(f"{out}.build")
    if checkpoints.exists() and not checkpoints.is_dir():
        raise ValueError(
            f"{checkpoints}: is a file; expected a folder for the checkpoints of this build, or nothing: move it away, or choose another OUT"
        )
    for name in (settings.preset, settings.materials or settings.preset):
        if name not in PRESETS:
            raise ValueError(f"preset {name!r} is unknown; expected one of {', '.join(PRESETS)}")
    if settings.masks not in ("auto", "given"):
        raise ValueError(f"masks {settings.masks!r} is unknown; expected auto or given")
    if settings.cameras not in ("auto", "given"):
        raise ValueError(f"cameras {settings.cameras!r} is unknown; expected auto or given")
    if settings.light not in LIGHT_CHOICES:
        raise ValueError(f"light {settings.light!r} is unknown; expected one of {', '.join(LIGHT_CHOICES)}")
    if settings.light == "camera" and PRESETS[settings.preset].materials_on == "surfels":
        raise ValueError("light 'camera' needs materials that are fitted on the mesh; expected a preset that does so")
    if settings.binding not in BINDINGS:
        raise ValueError(f"binding {settings.binding!r} is unknown; expected one of {', '.join(BINDINGS)}")
    rotation_to_up(settings.up)
