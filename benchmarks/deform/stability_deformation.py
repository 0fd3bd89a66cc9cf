"""Deformation and simulation at their extremes: what becomes of each, and where the limit is. Rewrites its section of docs/stability.md.

    python -m benchmarks stability_deformation [--json] [--page FILE] [--largest 100000]

--largest is the greatest number of particles that falls (1000000 takes about 6 GB and some minutes). About a minute on two cores without it.
"""

import argparse
import json
from dataclasses import asdict
from pathlib import Path

from benchmarks._stability_page import PAGE, markers, rewritten
from benchmarks.deform import _matter_sweeps as sweeps
from benchmarks.deform._matter_sweeps import Row

BETWEEN = markers("deformation and matter", "stability_deformation")
INTRODUCTION = """
## Deformation and matter
Written by `python -m benchmarks stability_deformation`, which replaces all from here to the section's limits. Not finite: NaN and infinite
values in all that came out; it must be 0. Energy left: kinetic, elastic and gravity's energy against that at the start. tests/stress asks the
same of smaller sweeps.
"""
NOTES = {
    "surfels": "Surfels under F: even, along one axis, sheared with stretches of 30 and 0.1, and nearly flat, each turned at random. What a length of 1 becomes.",
    "meshes": "A ball whose vertices a file moves: F from its faces, and surfels of length 1 on its vertices.",
    "handles": "A bar of length 4 held at both ends. `missed`: mean distance of held vertices from their targets, as surfels see it.",
    "neighbourhoods": "Points carried by particles; errors in spacings of the particles, for a rigid and an affine motion.",
    "strained matter": "A cube falling at 1 m/s, let go with such an elastic F in the particles of a corner (5 %; see surfels), at rest elsewhere.",
    "stiffness": "The cube hits the floor at 3 m/s; stiff ones for a shorter time.",
    "incompressibility": "The same at E = 1e5 Pa.",
    "speed": "The same at 10 m/s, every law.",
    "time steps": "C of dt = C dx / (wave speed + speed), E = 1e7 Pa. The settings refuse more than 0.9; what lies past that was done behind their back.",
    "numbers": "How many particles.",
    "room": "Particles that would leave the room.",
}
LIMITS = """
### Limits of deformation and matter
- **Surfels** feel singular values of F between 1/100 and 100, with det F > 0: flat, folded and inverted gradients are moved to the nearest
  such matrix. What a simulation hands to surfels is limited to stretches of 1/10 to 10, on sand and fluids to 1/3 to 3.
- **Meshes** with holes, flipped faces, overlaps and floaters are filled with matter all the same, 98 % of it inside and its volume within 2 %,
  5 % where a bottom is missing (tests/deform/matter/test_fill_particles.py); a sheet encloses nothing and is refused.
- **Neighbourhoods** of any rank carry affine motions; a point far from all particles is carried too, and a simulation lets it go rigidly with
  the nearest beyond three cells. Far off the origin float32 positions cost the digits, not the weights.
- **Handles** go up to 1000 sizes of the object away; further is refused. Where targets contradict a shape (a half turn, one end through the
  other) the pose is finite, and the same each time.
- **Poisson's ratio** up to 0.49, **C** up to 0.9; more is refused. Past that, up to twice the limit, nothing becomes NaN, but what happens is
  not right: energy grows by two orders of magnitude, unless a failure makes the step smaller.
- **Strained matter**: a frame that yields a value that is not finite, or a particle outside its tile, starts again from the last good state
  with half the time step, four times; where that does not help, what failed is frozen where it is, up to three times more, then everything.
  The report counts it, and surfels never see such values. Stretches of 10 to 30 in some particles do that to the elastic laws and their
  neighbours, a compression to a twentieth to fluids. Sand, clay and snow yield instead.
- **Speed**: a hundred m/s into a wall is right; ten thousand, a thousand times faster than its waves, end in a corner, finite and meaningless.
- **Substeps**: 2000 a call by default; more are refused with a sentence that names wave speed and cell size.
- **The room** is three times the object's size on every side unless the scene says otherwise. Particles cannot leave it, and `reached_wall` in
  the report says that they tried; one that starts outside is refused.
- **Thin parts**: what is thinner than one cell of the grid, such as a teapot's handle at 20 000 particles, has no matter between its sides to
  hold it together, and may tear; below three cells it bends too easily. `drgs simulate` says before the first frame where, and how many
  particles would do.
- **Matter that parts**: a particle that lost 15 % of its bonds is loose: longer than at rest by 1.5 cells (by 0.4 in sand and snow). Faces over it are cut, and grains shown, at
  most 50 000; a fluid never parts. Rigid motion cuts nothing, to the bit ([why](decisions/0009-matter-that-parts.md)).
- **CUDA**: these figures are the CPU's.
"""


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks stability_deformation", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", action="store_true", help="print the rows instead of writing the page")
    parser.add_argument("--page", type=Path, default=PAGE)
    parser.add_argument("--largest", type=int, default=100_000)
    given = parser.parse_args(arguments)
    if given.largest < 1:
        raise ValueError(f"--largest is {given.largest}; expected at least 1")
    page = given.page.read_text()
    rewritten(page, BETWEEN, "")  # complain before measuring
    found = measure(given.largest)
    if given.json:
        print(json.dumps({name: [asdict(row) for row in rows] for name, rows in found.items()}))
        return
    given.page.write_text(rewritten(page, BETWEEN, section(found)))
    print(f"Wrote {given.page}")


def measure(largest: int) -> dict[str, list[Row]]:
    """All sweeps, by section."""
    counts = [count for count in (1, 8, 100, 1000, 10_000, 100_000, 1_000_000) if count < largest]
    return {
        "surfels": sweeps.surfel_rows(200),
        "meshes": sweeps.mesh_rows(),
        "handles": sweeps.handle_rows(),
        "neighbourhoods": sweeps.neighbourhood_rows(),
        "strained matter": sweeps.strained_rows(512, 0.02),
        "stiffness": sweeps.stiffness_rows(512, 0.1),
        "incompressibility": sweeps.poisson_rows(512, 0.1),
        "speed": sweeps.speed_rows(512, 0.1),
        "time steps": sweeps.time_step_rows(1000, 0.1),
        "numbers": sweeps.count_rows([*counts, largest], 0.05),
        "room": sweeps.room_rows(512, 0.1),
    }


def _text(value: float | int | None) -> str:
    if value is None:
        return "–"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def section(found: dict[str, list[Row]]) -> str:
    """The page's section."""
    lines = [INTRODUCTION.rstrip("\n")]
    for name, rows in found.items():
        columns = list(dict.fromkeys(key for row in rows for key in row.values if key != "wall_seconds"))
        lines += [
            "",
            f"### {name.capitalize()}",
            NOTES[name],
            "",
            "| case | " + " | ".join(key.replace("_", " ") for key in columns) + " | not finite |",
        ]
        lines.append("|---" * (len(columns) + 2) + "|")
        for row in rows:
            if row.refused is not None:
                continue
            values = [_text(row.values.get(key)) for key in columns]
            lines.append(f"| {row.case} | " + " | ".join(values) + f" | {row.not_finite} |")
        lines += ["", *(f"- {row.case}: refused: {row.refused}" for row in rows if row.refused is not None)]
        while not lines[-1]:
            lines.pop()
    return "\n".join(lines) + "\n" + LIMITS
