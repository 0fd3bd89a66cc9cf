"""By which curve exposed radiance becomes a screen's light. A viewer's choice: no edit of the scene, and no matter to linear EXR files."""

from typing import Literal

ToneCurve = Literal["standard", "filmic", "agx", "neutral"]
"""standard: none, what is brighter than white clips. filmic: Hill's fit of ACES, contrasty, highlights roll off. agx: softer, bright colours
fade to white. neutral: Khronos' PBR Neutral, base colours as they are, only highlights are compressed. Formulas: render/tonemap.py."""
