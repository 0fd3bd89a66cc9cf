"""What an asset's provenance tells of the photographs that it was built from, and that its other files no longer tell.

In: the views of a finished build. Out: plain JSON.
"""

import math
from collections import Counter
from dataclasses import asdict
from typing import Any

from drgs.scene.views import Views


def facts_of_views(views: Views) -> dict[str, Any]:
    """Lenses, exposures and white balances, and by how many pixels masks and cameras were moved; each where there is something to tell."""
    facts = calibrations(views)
    if views.gains is not None:
        facts["exposure_stops"] = [round(math.log2(gain), 3) for gain in views.gains]
    if views.tints is not None:
        facts["white_balance"] = [{"red": round(red, 3), "blue": round(blue, 3)} for red, _, blue in views.tints]
    if views.masks_moved:
        facts["masks_moved_pixels"] = round(views.masks_moved, 2)
    if views.cameras_moved:
        facts["cameras_moved_pixels"] = round(views.cameras_moved, 2)
    return facts


def calibrations(views: Views) -> dict[str, Any]:
    """The lenses of the photographs before they were undistorted; empty where there were none."""
    counts = Counter(lens for lens in views.lenses if lens is not None)
    return {"lenses": [asdict(lens) | {"pictures": count} for lens, count in counts.items()]} if counts else {}
