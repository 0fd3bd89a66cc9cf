"""Light transport at its extremes: float32 against the float64 twins, energy, and what is refused. Rewrites its section of docs/stability.md.

    python -m benchmarks stability [--json] [--page FILE] [--largest-sky 4096]

Deformation and matter have theirs from `stability_deformation`. About a minute on two cores; the largest sky takes 4 GB, half the height a
quarter.
"""

import argparse
import json
from dataclasses import asdict
from pathlib import Path

from benchmarks._stability_page import PAGE, markers, rewritten
from benchmarks.render import _light_sweeps as sweeps
from benchmarks.render._light_sweeps import Row

BETWEEN = markers("light transport", "stability")

INTRODUCTION = """
## Light transport
Written by `python -m benchmarks stability`, which replaces all from here to the section's limits. Errors are relative: |found - truth| over
truth + 0.1 % of the truth's mean, over all points, pixels and channels. Not finite: NaN or infinite values among radiance, variance, visibility
and, of pictures, radiance after denoising; it must be 0. tests/stress asks the same of smaller sweeps.
"""
NOTES = {
    "estimator": "Direct light at points against the float64 twin on the same random numbers, 32 rays each; every row over roughness, metallic or angle.",
    "energy": "Light that comes back under an even sky of 1, largest over angles up to 89.99°; more than 1.001 would be energy from nothing.",
    "pictures": "Two spheres of radius 1, one bounce, all horizons known. Truth: the same picture at the origin at scale 1, or of the sound mesh.",
    "surfels": "The rasteriser against its float64 twin, 600 surfels on a sphere of radius 1.",
    "refused": "What is refused, and how.",
}
LIMITS = """
### Limits of light transport
- **Roughness** below 0.03 is rendered as 0.03; at 0.03 the mirror's peak still has four correct digits.
- **White dielectrics**: the contract's BRDF adds specular light to a diffuse part that lost none. Each part alone returns no more than
  what comes; together, an albedo above 0.96 returns more (at roughness 0 and 89.99° 1.94 for an albedo of 1). Real paints lie
  below; nothing is refused.
- **Environments**: texels from 0 to 1e12, finite; others are refused (files: negative values become 0 with a warning). Brightness itself
  costs no digits: the sampling table knows ratios only.
- **Size**: the mesh's box must measure 1e-5 to 1e9 world units; squared areas leave float32 beyond.
- **Distance**: the mesh may lie up to 1e5 times its own span from the origin; further is refused. Vertices are float32, and rays start the
  further off the surface the further the mesh is away: at 1e3 spans shadows of what is nearer than 1e-3 of the span are lost, at 1e5 spans
  of what is nearer than a tenth, and outlines move by 6e-3 of it. Keep things near the origin.
- **Triangles without area, doubled or sharing edges with more than one other** change nothing. Two triangles at one place that face opposite
  ways do: the ray meets either, and a back is black. `drgs import` warns of them; give such sheets a thickness.
- **Normals**: where a vertex normal faces away from the camera on a triangle that faces it, the point is black, as in any path tracer.
- **Pictures** of no area are refused.
- **Surfels** of no area are not drawn, nor what is nearer to the camera than 1 % of half the surfels' span. Opacity is cut at 0.99, below
  1/255 nothing is drawn.
"""


def measure(largest_sky: int) -> dict[str, list[Row]]:
    """All sweeps, by section."""
    return {
        "estimator": [
            *sweeps.roughness_rows(200),
            *sweeps.angle_rows(200),
            *sweeps.light_rows(100),
            sweeps.large_sky_row(largest_sky // 4),
            sweeps.large_sky_row(largest_sky),
        ],
        "energy": sweeps.furnace_rows(512, 256),
        "pictures": [*sweeps.placement_rows(48), *sweeps.mesh_rows(32), *(row for row in sweeps.image_rows() if row.refused is None)],
        "surfels": sweeps.surfel_rows(600, 64),
        "refused": [*(row for row in sweeps.image_rows() if row.refused), *sweeps.refused_rows()],
    }


def section(found: dict[str, list[Row]]) -> str:
    """The page's section."""
    lines = [INTRODUCTION]
    for name, rows in found.items():
        lines.append(f"\n### {name.capitalize()}\n{NOTES[name]}\n")
        if name == "refused":
            lines += ["| case | sentence |", "|---|---|"]
            lines += [f"| {row.case} | {row.refused or '**not refused**'} |" for row in rows]
            continue
        column = "largest share returned" if name == "energy" else "largest error | mean error"
        lines += [f"| case | {column} | not finite |", "|---|---|---|" + ("" if name == "energy" else "---|")]
        for row in rows:
            numbers = f"{row.energy:.4f}" if name == "energy" else f"{number(row.max_error)} | {number(row.mean_error)}"
            lines.append(f"| {row.case} | {numbers} | {row.not_finite} |")
    return "\n".join(lines) + "\n" + LIMITS


def number(value: float | None) -> str:
    return "–" if value is None else "0" if value == 0 else f"{value:.1e}"


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks stability", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", action="store_true", help="also print the rows")
    parser.add_argument("--page", type=Path, default=PAGE, help="page to rewrite")
    parser.add_argument("--largest-sky", type=int, default=4096, help="height [texels]")
    given = parser.parse_args(arguments)
    page = given.page.read_text()
    rewritten(page, BETWEEN, "")  # complain before measuring
    found = measure(given.largest_sky)
    given.page.write_text(rewritten(page, BETWEEN, section(found)))
    if given.json:
        print(json.dumps({name: [asdict(row) for row in rows] for name, rows in found.items()}))


if __name__ == "__main__":
    import sys

    main(sys.argv[1:])
