"""The environments that are computed when they are asked for: their names, and the files behind the names.

`sun-and-sky-25.exr` is a clear day with the sun 25 degrees high, `sun-and-sky.exr` one at its usual height. A name tells all, so that every
machine makes the same file, and a session that names one can be opened anywhere.
"""

import re

import numpy as np

from drgs.scene.sun_and_sky import HIGHEST, LOWEST, USUAL_ELEVATION, paint_sun_and_sky
from drgs.scene.three_point_lights import paint_three_point_lights

LISTED = {"sun-and-sky.exr": "Sun and sky", "three-point-lights.exr": "Three-point"}
"""File names and titles of those that the list of environments holds."""
SIZE = (512, 256)
"""Width and height of all of them."""
_SUN_AND_SKY = re.compile(r"sun-and-sky(?:-([1-9][0-9]?))?\.exr")


def is_made(name: str) -> bool:
    """Whether a file of this name is computed."""
    sky = _SUN_AND_SKY.fullmatch(name)
    return name in LISTED or (sky is not None and LOWEST <= int(sky[1]) <= HIGHEST)


def make_environment(name: str) -> bytes:
    """The EXR of a name for which `is_made`, rounded to half floats, which compress well."""
    from drgs.exchange.exr import encode_environment

    if name == "three-point-lights.exr":
        radiance = paint_three_point_lights(SIZE[1])
    else:
        sky = _SUN_AND_SKY.fullmatch(name)
        assert sky is not None
        radiance = paint_sun_and_sky(float(sky[1] or USUAL_ELEVATION), SIZE[1])
    return encode_environment(radiance.astype(np.float16).astype(np.float32))
