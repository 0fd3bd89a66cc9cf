"""The evidence written down: paper.md for the documents, and index.html, which is the same page with its pictures in a browser.

In: the finished cells by scene. Out: two files. What the page says of who is better is computed from the cells, whichever way it turns out.
"""

import html
import re
from pathlib import Path

import numpy as np

from benchmarks.measures.report_table import markdown_table
from benchmarks.paper.cells import write_whole
from benchmarks.paper.variant import AbstractVariant

INTRODUCTION = """# The paper's evidence, made anew

Comparisons and figures of drgs2026 ([sources](sources.md)), on scenes of which the truth is known, beside drivers built as other systems build theirs.
Written by `python -m benchmarks paper`; each table and figure names the command, the commit, the time and the machine that made it. All ways start from
the same asset and the same photographs, so that what differs is how Gaussians are bound, driven and shaded. Pictures are compared on white; PSNR in dB.
Figures of the paper itself are of other scenes and of other code, and are not beside these.
"""
MISSING = "## What is not here yet"
NO_LPIPS = "- LPIPS: its weights come with no package that we install; `--lpips FILE` adds it to the tables (benchmarks/README.md says which file)."
OTHERS_MISSING = """\
- Deformed truth is of analytic maps (bend, twist, stretch), drawn by Mitsuba, and of one character that is our own. With `--mitsuba` its photographs and the
  truth of its dance are Mitsuba's; without, our renderer draws both, and is no witness of how light is computed.
- What is simulated is shown, and of sand it is said how far its picture is from balls of its particles' volume; no truth of a real fall is there.
- Wire frames (Fig. 3) are of our mesh, thinned out, over the truth; the other ways' meshes are ours with fewer faces.
- The other systems' geometry is ours, which is generous to them, and their barycentrics, scales, offsets and opacities are not learned through pictures, which
  is not. Harmonics are solved by least squares, not by tens of thousands of steps.
"""


def write_pages(out: Path, document: dict, variants: list[AbstractVariant]) -> None:
    """OUT/paper.md and OUT/index.html."""
    text = page(document, variants)
    write_whole(out / "paper.md", text.encode())
    write_whole(out / "index.html", html_page(text).encode())


def page(document: dict, variants: list[AbstractVariant]) -> str:
    """The Markdown page; pictures lie in images/paper beside it."""
    parts = [INTRODUCTION, ways(variants)]
    for title, kind, rows in (
        ("Static views", "static", static_rows(document, variants)),
        ("Deformed, light of the photographs", "deformed", deformed_rows(document, variants, False)),
        ("Deformed, new light", "deformed", deformed_rows(document, variants, True)),
        ("Time and memory", "bind", cost_rows(document, variants)),
    ):
        if rows:
            columns = list(dict.fromkeys(column for row in rows for column in row))
            parts.append(f"## {title}\n{NOTES[title]}\n\n{markdown_table(rows, columns)}\n\n{made_of(document, kind)}\n")
    parts += [honesty(document, variants), figures(document), missing(document, variants)]
    return "\n".join(part for part in parts if part)


NOTABLE = 0.05
"""[dB] below which two of our own ways count as equal."""
WHY_SSIM = "Computed from the tables. What noise rays leave is filtered (SVGF), as in the paper; drawn colours have none. More rays (`--spp`) leave less."
NOTES = {
    "Static views": "Test views at rest under the light of the photographs.",
    "Deformed, light of the photographs": "The true object deformed by a known map, rendered by Mitsuba under the light of the photographs.",
    "Deformed, new light": "The same under a light that no photograph shows; PSNR and LPIPS after one factor a channel, since nobody can tell dark paint from dim light. "
    "Baked ways show the old light.",
    "Time and memory": "Wall-clock seconds of binding and baking, and of a picture of 400×400 (posing included), beside whatever else the machine did (load, below); peak memory of the "
    "whole process while drawing deformed views.",
}


def ways(variants: list[AbstractVariant]) -> str:
    lines = [f"| {variant.title} | {'yes' if variant.relights else 'no'} | {variant.simplified} |" for variant in variants]
    return "\n".join(["## The ways, and what is simplified", "| way | relights | simplified here |", "|---|---|---|", *lines, ""])


def static_rows(document: dict, variants: list[AbstractVariant]) -> list[dict[str, object]]:
    return score_rows(
        {scene: {way: cell["figures"] for way, cell in cells["static"].items()} for scene, cells in document.items()}, variants, "psnr"
    )


def deformed_scores(document: dict, new_light: bool) -> dict[str, dict[str, dict]]:
    """By scene and way, the mean over the scene's deformations of that kind."""
    found: dict[str, dict[str, dict]] = {}
    for scene, cells in document.items():
        for way, cell in cells["deformed"].items():
            kind = [figures for figures in cell["figures"].values() if figures["new_light"] is new_light]
            if kind:
                names = [
                    name for name in ("psnr", "ssim", "psnr_scaled", "lpips", "lpips_scaled") if all(name in figures for figures in kind)
                ]
                found.setdefault(scene, {})[way] = {name: float(np.mean([figures[name] for figures in kind])) for name in names}
    return found


def deformed_rows(document: dict, variants: list[AbstractVariant], new_light: bool) -> list[dict[str, object]]:
    return score_rows(deformed_scores(document, new_light), variants, "psnr_scaled" if new_light else "psnr")


def score_rows(scores: dict[str, dict[str, dict]], variants: list[AbstractVariant], key: str) -> list[dict[str, object]]:
    """A row a way: PSNR, SSIM and, where it was asked for, LPIPS of each scene, and the means over those scenes that every way has.

    Args:
        key: "psnr" or "psnr_scaled", and LPIPS likewise.
    """
    rows, distance = [], lpips_key(key)
    shown = [variant.name for variant in variants if any(variant.name in by_way for by_way in scores.values())]
    shared = [scene for scene, by_way in scores.items() if all(name in by_way for name in shown)]
    for variant in variants:
        own = {scene: by_way[variant.name] for scene, by_way in scores.items() if variant.name in by_way}
        if not own:
            continue
        row: dict[str, object] = {"way": variant.title}
        for scene, figures in own.items():
            row |= {f"{scene} PSNR": f"{figures[key]:.2f}", f"{scene} SSIM": f"{figures['ssim']:.3f}"}
            if any(distance in others for others in scores[scene].values()):
                row[f"{scene} LPIPS"] = f"{figures[distance]:.3f}" if distance in figures else None
        if len(shared) > 1:
            row["mean PSNR"] = f"{np.mean([own[scene][key] for scene in shared]):.2f}"
            row["mean SSIM"] = f"{np.mean([own[scene]['ssim'] for scene in shared]):.3f}"
            if all(distance in scores[scene][name] for scene in shared for name in shown):
                row["mean LPIPS"] = f"{np.mean([own[scene][distance] for scene in shared]):.3f}"
        rows.append(row)
    return rows


def lpips_key(key: str) -> str:
    """Of LPIPS of the pictures that this PSNR is of."""
    return key.replace("psnr", "lpips")


def cost_rows(document: dict, variants: list[AbstractVariant]) -> list[dict[str, object]]:
    rows = []
    for scene, cells in document.items():
        for variant in variants:
            bind = cells["bind"].get(variant.name)
            if bind is None:
                continue
            row: dict[str, object] = {
                "scene": scene,
                "way": variant.title,
                "Gaussians": bind["gaussians"] or None,
                "bind s": bind["cost"]["seconds"],
            }
            row["s a picture, at rest"] = cells["static"].get(variant.name, {}).get("seconds_a_picture")
            deformed = cells["deformed"].get(variant.name, {})
            row |= {"s a picture, deformed": deformed.get("seconds_a_picture"), "MiB": deformed.get("cost", {}).get("peak_memory_mib")}
            rows.append(row)
    return rows


def honesty(document: dict, variants: list[AbstractVariant]) -> str:
    """Where another way is better than ours on particles, and by how much ours is better than the best other elsewhere."""
    titles = {variant.name: variant.title for variant in variants}
    tables = {
        "static views": (
            {scene: {way: cell["figures"] for way, cell in cells["static"].items()} for scene, cells in document.items()},
            "psnr",
        ),
        "deformed, light of the photographs": (deformed_scores(document, False), "psnr"),
        "deformed, new light": (deformed_scores(document, True), "psnr_scaled"),
    }
    lines = []
    for table, (scores, key) in tables.items():
        for scene, by_way in scores.items():
            others = {way: figures for way, figures in by_way.items() if not way.startswith("ours")}
            if "ours_particles" not in by_way or not others:
                continue
            ours = by_way["ours_particles"][key]
            best = max(others, key=lambda way: others[way][key])
            gap = ours - others[best][key]
            told = (
                f"ahead of the best other ({titles[best]}) by {gap:.2f} dB" if gap >= 0 else f"**behind** {titles[best]} by {-gap:.2f} dB"
            )
            lines.append(f"- {scene}, {table}: ours (P) is {told}.")
            for way, figures in by_way.items():
                if way.startswith("ours") and way != "ours_particles" and figures[key] < others[best][key]:
                    lines.append(
                        f"- {scene}, {table}: {titles[way]} is **behind** {titles[best]} by {others[best][key] - figures[key]:.2f} dB."
                    )
                elif way.startswith("ours") and figures[key] > ours + NOTABLE:
                    lines.append(f"- {scene}, {table}: {titles[way]} is better than ours (P) by {figures[key] - ours:.2f} dB.")
            structure = max(others, key=lambda way: others[way]["ssim"])
            if others[structure]["ssim"] > by_way["ours_particles"]["ssim"]:
                more = others[structure]["ssim"] - by_way["ours_particles"]["ssim"]
                lines.append(f"- {scene}, {table}: by SSIM {titles[structure]} is **ahead** of ours (P) by {more:.3f}.")
            distances = {way: figures[lpips_key(key)] for way, figures in by_way.items() if lpips_key(key) in figures}
            alike = min(others.keys() & distances.keys(), key=lambda way: distances[way], default=None)
            if alike is not None and distances[alike] < distances.get("ours_particles", 0):
                less = distances["ours_particles"] - distances[alike]
                lines.append(f"- {scene}, {table}: by LPIPS {titles[alike]} is **ahead** of ours (P) by {less:.3f}.")
    return "\n".join(["## Who is better", WHY_SSIM, "", *lines, ""]) if lines else ""


def missing(document: dict, variants: list[AbstractVariant]) -> str:
    """What the page has not, and the rows that have no LPIPS though it was asked for."""
    lines, asked = [], False
    for kind, told in (("static", "static views"), ("deformed", "deformed views")):
        for scene, cells in document.items():
            asked |= any("lpips" in cell for cell in cells[kind].values())
            own = {variant.title: cells[kind][variant.name] for variant in variants if variant.name in cells[kind]}
            lacking = [title for title, cell in own.items() if "lpips" in cell and cell["lpips"] is None]
            if lacking:
                lines.append(
                    f"- LPIPS of {scene}, {told}: {', '.join(lacking)}. Their pictures are gone or of another run; without their files in `OUT/cells` they are drawn anew."
                )
    lines += ["- LPIPS of the dances."] if asked else [NO_LPIPS]
    return "\n".join([MISSING, *lines, OTHERS_MISSING])


def figures(document: dict) -> str:
    parts = []
    for scene, cells in document.items():
        for cell in cells["figures"].values():
            told = ", ".join(f"{name.replace('_', ' ')} {value:.2f}" for name, value in cell.get("figures", {}).items())
            film = f"[Film: {cell.get('film_shows', 'there and back')}]({cell['film']})\n" if "film" in cell else ""
            curve = f"![Error of each frame]({cell['curve']})\n" if "curve" in cell else ""
            table = f"\n{markdown_table(cell['rows'], list(cell['rows'][0]))}\n\n" if "rows" in cell else ""
            shown = f"![{scene}: {cell['caption']}]({cell['picture']})\n{film}{curve}{table}"
            parts.append(f"### {scene}: {cell['caption']}\n{shown}{told + '. ' if told else ''}{made_by(cell)}\n")
    return "\n".join(["## Figures", *parts]) if parts else ""


def made_of(document: dict, kind: str) -> str:
    """Of a table: each different making, once."""
    cells = [cell for parts in document.values() for cell in parts[kind].values()]
    settings = cells[0]["asked"]
    spent = (
        f"{settings['samples_per_pixel']} rays a pixel, {settings['budget']} Gaussians on faces of their own, {settings['bake']['rounds']} rounds of baking after "
        f"the first, every {settings['test_every']}. test view." if settings["test_every"] > 1 else
        f"{settings['samples_per_pixel']} rays a pixel, {settings['budget']} Gaussians on faces of their own, {settings['bake']['rounds']} rounds of baking after the first."
    )  # fmt: skip
    distances = [cell["lpips"] for cell in cells if cell.get("lpips")]
    networks = "".join(f" {network}; less is better." for network in sorted({distance["network"] for distance in distances}))
    makings = [cell["made"] for cell in (*cells, *distances)]
    times = sorted(made["time"] for made in makings)
    commits = ", ".join(sorted({made["commit"] or "no checkout" for made in makings}))
    machines = ", ".join(sorted({re.sub(r", load \d+$", "", made["machine"]) for made in makings}))
    loads = [int(found[1]) for made in makings if (found := re.search(r"load (\d+)$", made["machine"]))]
    commands = "; ".join(f"`{command}`" for command in sorted({made["command"] for made in makings}))
    load = f", load {min(loads)} to {max(loads)}" if loads else ""
    return f"{spent}{networks} {commands}; commit {commits}; {times[0]} to {times[-1]}; {machines}{load}."


def made_by(cell: dict) -> str:
    made = cell["made"]
    return f"`{made['command']}`; commit {made['commit']}; {made['time']}; {made['machine']}."


def html_page(markdown: str) -> str:
    """The page for a browser: headings, tables, lists and pictures, which are all that it has."""
    lines, body, table, listed = markdown.split("\n"), [], False, False
    for line in lines:
        row, item = line.startswith("|"), line.startswith("- ") or (listed and line.startswith("  "))
        if table and not row:
            body.append("</table>")
        if listed and not item:
            body.append("</ul>")
        if row and not line.startswith("|---"):
            cells = "".join(f"<td>{inline(cell.strip())}</td>" for cell in line.strip("|").split("|"))
            body.append(f"{'' if table else '<table>'}<tr>{cells}</tr>")
        elif line.startswith("#"):
            level = len(line) - len(line.lstrip("#"))
            body.append(f"<h{level}>{inline(line.lstrip('# '))}</h{level}>")
        elif item:
            body.append(f"{'' if listed else '<ul>'}{'<li>' if line.startswith('- ') else ''}{inline(line.removeprefix('- '))}")
        elif not row:
            body.append(inline(line) or "<p>")
        table, listed = row, item
    style = "body{font:15px sans-serif;max-width:75em;margin:2em auto}td{padding:.2em .7em;border-bottom:1px solid #ddd;vertical-align:top}img{max-width:100%}"
    return f"<!doctype html><meta charset='utf-8'><title>The paper's evidence</title><style>{style}</style>" + "\n".join(body)


def inline(text: str) -> str:
    """Pictures, films, links, code and emphasis of one line."""
    text = html.escape(text, quote=False)
    text = re.sub(r"!\[([^\]]*)\]\(([^)]+)\)", r'<img alt="\1" src="\2">', text)
    text = re.sub(r"\[([^\]]*)\]\(([^)]+\.mp4)\)", r'<p><video title="\1" src="\2" controls loop muted autoplay></video>', text)
    text = re.sub(r"\[([^\]]*)\]\([^)]+\)", r"\1", text)
    text = re.sub(r"`([^`]*)`", r"<code>\1</code>", text)
    return re.sub(r"\*\*([^*]*)\*\*", r"<b>\1</b>", text)
