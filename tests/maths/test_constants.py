"""Constants that several files must agree on are written in drgs/maths/constants.py, and nowhere else."""

import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from drgs.maths import constants
from drgs.render.native_source import constexpr_lines

ROOT = Path(__file__).parents[2]
SOURCES = [
    str(path.relative_to(ROOT))
    for folder, endings in (
        ("drgs", (".py", ".h")),
        ("server", (".py",)),
        ("worker", (".py",)),
        ("benchmarks", (".py",)),
        ("web/src", (".ts", ".tsx")),
    )
    for path in sorted((ROOT / folder).rglob("*"))
    if path.suffix in endings and not path.name.endswith(".gen.ts")
]
HOME = "drgs/maths/constants.py"
REPEATS = ("drgs/reference/",)
"""The reference may repeat a number on purpose: it is the specification, and shares no mistake."""

COPIED = {
    0.04: "F0",
    0.2126: "LUMINANCE_RED",
    0.7152: "LUMINANCE_GREEN",
    0.0722: "LUMINANCE_BLUE",
    12.92: "SRGB_SLOPE",
    0.0031308: "SRGB_LINEAR_END",
    0.04045: "SRGB_ENCODED_END",
    1.055: "SRGB_SCALE",
    0.055: "SRGB_OFFSET",
    0.99: "MAX_ALPHA",
    1e14: "VOID_BEYOND",
    1e15: "VOID_ORIGIN",
    1e30: "UNBOUNDED",
}
"""Numbers, wherever they stand in the sources, and the constant that each would be a copy of."""
COPIED_IN_RENDER = {0.03: "MIN_ROUGHNESS", 1e-4: "MIN_TRANSMITTANCE"}
"""Elsewhere these are common numbers."""
SOUGHT = COPIED.keys() | COPIED_IN_RENDER.keys()
OTHERS = {
    ("benchmarks/_plot.py", 0.04): "the margin of a plot's axes",
    ("benchmarks/serve/abuse.py", 0.99): "a percentile",
    ("benchmarks/scenes/embossed_urn.py", 0.04): "half the width of a band of beads",
    ("benchmarks/scenes/made_things.py", 0.04): "red of a blue brick",
    ("benchmarks/paper/character/body.py", 0.04): "radii of a character's parts",
    ("benchmarks/paper/character/skeleton.py", 0.04): "places of a character's joints",
    ("benchmarks/serve/service.py", 0.99): "a percentile",
    ("benchmarks/serve/trials/uploads.py", 1e30): "a place far away",
    ("drgs/deform/matter/mpm/conditions.py", 1e30): "the end of conditions that never end [s]",
    ("drgs/deform/matter/mpm/records.py", 1e30): "the yield stress of matter that never yields [Pa]",
    ("drgs/exchange/gltf_accessors.py", 1e30): "a bound on the numbers of a file",
    ("drgs/reconstruct/capture/masks_by_strokes/masks_by_strokes.py", 0.04): "a share of a picture's longer side",
    ("drgs/reconstruct/capture/find_pit.py", 0.04): "a depth below which a place is rim",
    ("drgs/reconstruct/capture/find_pit.py", 0.055): "a difference of colours",
    ("drgs/reconstruct/capture/sharpen_masks.py", 0.99): "a share of pixels",
    ("drgs/reconstruct/fit/evidence/light_from_paint.py", 0.99): "a share of places",
    ("drgs/reconstruct/capture/hull_rays.py", 0.99): "the coverage of a pixel that the object fills",
    ("drgs/reconstruct/fit/surface/displaced_surface.py", 0.99): "a decay rate of Adam",
    ("drgs/reconstruct/fit/surface/surface_passes.py", 0.04): "a weight of bending",
    ("drgs/reconstruct/fit/surface/try_depths.py", 0.055): "a depth that is tried",
    ("drgs/reconstruct/capture/radiance_grid.py", 0.99): "a decay rate of Adam",
    ("drgs/reconstruct/fit/surfel_parameters.py", 0.04): "a learning rate",
    ("drgs/reconstruct/geometry/extract_mesh/fuse_depth.py", 1e30): "an inverse depth beyond all others",
    ("drgs/render/intersect/horizon.h", 1e30): "the tangent of a horizon that nothing is below, and corners of empty boxes",
    ("drgs/render/intersect/horizon.py", 1e30): "corners of empty boxes",
    ("drgs/render/intersect/horizon_kernels.py", 1e30): "the tangent of a horizon that nothing is below",
    ("drgs/render/intersect/tracer_surfels/surfel_scene.py", 1e-4): "padding of boxes, as a share",
    ("drgs/render/intersect/tracer_surfels/walk_rays.py", 1e-4): "a cosine",
    ("drgs/render/render_bands.py", 1e-4): "the shortest time of a pass that is believed [s]",
    ("drgs/render/visible/rasterize/project.py", 1e30): "the largest coefficient of a surfel that is drawn",
    ("drgs/render/visible/rasterize/tile_backward.h", 1e30): "a squared distance on a disc whose plane is behind the camera",
    ("drgs/render/visible/rasterize/tile_forward.h", 1e30): "the same",
    ("drgs/render/visible/rasterize/tile_kernels.py", 1e30): "the same",
    ("drgs/scene/three_point_lights.py", 0.055): "the radiance of a floor",
    ("web/src/stage/viewport.ts", 0.04): "a camera's smoothing time [s]",
}
"""The same numbers with another meaning: (file, number) and what it is there."""

NUMBER = re.compile(r"(?<![\w.])(?:\d+\.\d*|\.\d+|\d+)(?:[eE][+-]?\d+)?(?=f?(?![\w.]))")
COMMENT = re.compile(r"/\*.*?\*/|//[^\n]*", re.DOTALL)
NAMES = {name for name, value in vars(constants).items() if isinstance(value, float)}


def numbers(name: str) -> Iterator[float]:
    """Of a source file's code, not of its comments and texts; of a Python file without a number that is sought, none."""
    text = (ROOT / name).read_text()
    if name.endswith(".py"):
        if not SOUGHT & {float(number) for number in NUMBER.findall(text.replace("_", ""))}:
            return  # nor in comments and texts; to take these out takes long
        tokens = tokenize.generate_tokens(io.StringIO(text).readline)
        found = [token.string for token in tokens if token.type == tokenize.NUMBER]
    else:
        found = NUMBER.findall(COMMENT.sub("", text))
    for number in found:
        if not number.lower().startswith(("0x", "0b", "0o")) and not number.endswith(("j", "J")):
            yield float(number)


def sought(name: str) -> dict[float, str]:
    return COPIED | (COPIED_IN_RENDER if name.startswith("drgs/render/") else {})


def test_the_scan_reads_every_notation():
    values = {**COPIED, **COPIED_IN_RENDER}
    assert {number: getattr(constants, constant) for number, constant in values.items()} == {number: number for number in values}
    assert [float(number) for number in NUMBER.findall("a = 0.04f + v16(1e-4f) * .5 - x2 / 3;")] == [0.04, 1e-4, 0.5, 3]
    assert set(numbers(HOME)) >= set(values)


def test_constants_are_written_once():
    found = {
        (name, number)
        for name in SOURCES
        if name != HOME and not name.startswith(REPEATS)
        for number in numbers(name)
        if number in sought(name)
    }
    copies = [
        f"{name} writes {number:g}: import {sought(name)[number]}, or say in OTHERS what else it is"
        for name, number in found - OTHERS.keys()
    ]
    assert sorted(copies) == []
    assert sorted(OTHERS.keys() - found) == [], "these no longer occur: take them out of OTHERS"


def test_the_least_opacity_is_not_written_as_a_fraction():
    fraction = re.compile(r"(?<![\w.])1(?:\.0)?f?\s*/\s*255(?:\.0)?f?(?![\w.])")
    code = {name: (ROOT / name).read_text() for name in SOURCES if name != HOME and not name.startswith(REPEATS)}
    without_comments = {
        name: re.sub(r"#[^\n]*", "", text) if name.endswith(".py") else COMMENT.sub("", text) for name, text in code.items()
    }
    copies = [name for name, text in without_comments.items() if fraction.search(re.sub(r'""".*?"""', "", text, flags=re.DOTALL))]
    assert copies == [], "MIN_ALPHA or MIN_COVERAGE"


def test_no_constant_is_defined_a_second_time():
    python = re.compile(rf"^({'|'.join(sorted(NAMES))})\s*(?::[^=]+)?=(?!=)", re.MULTILINE)
    native = re.compile(rf"(?:const|constexpr)\s+(?:float|double|auto)\s+({'|'.join(sorted(NAMES))})\s*=")
    sources = [name for name in SOURCES if name != HOME and not name.startswith(REPEATS)]
    again = [
        (name, match)
        for name in sources
        for match in (*python.findall((ROOT / name).read_text()), *native.findall((ROOT / name).read_text()))
    ]
    assert again == []


def test_luminance_weights_sum_to_one_and_the_parts_of_the_srgb_curve_meet():
    assert pytest.approx(1, abs=1e-12) == constants.LUMINANCE_RED + constants.LUMINANCE_GREEN + constants.LUMINANCE_BLUE
    end = constants.SRGB_SCALE * constants.SRGB_LINEAR_END ** (1 / constants.SRGB_GAMMA) - constants.SRGB_OFFSET
    assert pytest.approx(end, abs=1e-7) == constants.SRGB_SLOPE * constants.SRGB_LINEAR_END
    assert pytest.approx(end, abs=1e-6) == constants.SRGB_ENCODED_END


def test_native_code_gets_the_float32_values_of_warp_kernels():
    values = {name: getattr(constants, name) for name in sorted(NAMES)}
    written = re.findall(r"constexpr float (\w+) = (\S+)f;\n", constexpr_lines(values))
    assert {name: np.float32(text) for name, text in written} == {name: np.float32(value) for name, value in values.items()}
