"""What the plan saves on an asset, and what each skip changes.

    python -m benchmarks plan ASSET [--json] [--size 200] [--spp 128] [--bounces 1] [--env FILE] [--primary mesh]

saved: processor time with the plan against without it (`--no-skip`) at equal error, error falling as 1 / time: 1 - (time x relmse with) / (time x
relmse without), relmse against our own picture of --truth samples without the plan. Horizons are found as rays pay for them, from none at the
start; saved_later is that of later frames of the same shape, when they are known.
skips: each one alone against nothing skipped, same seed: largest difference of a pixel (what is exact must have 0), the mean's relative
difference with one standard error (what is exact in the mean must lie within a few), processor time, and the bound that the frame states.
taken_over: one pass after an edit, going on from the frame before, against the same from nothing.
"""

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

from drgs.deform.pose_scene import pose_scene
from drgs.maths.color import luminance
from drgs.render.film.resolve_frame import resolve_frame
from drgs.render.integrate.plan import samples_per_pass
from drgs.render.intersect.horizon import Horizons
from drgs.render.intersect.trace_rays import build_tracer
from drgs.render.intersect.tracer import AbstractTracer
from drgs.render.progressive.frame_state import FrameState, with_settings
from drgs.render.progressive.refine import refine_frame
from drgs.render.progressive.start_frame import start_frame
from drgs.render.records import Frame, FrameInputs, RenderSettings
from drgs.scene.asset import load_asset
from drgs.scene.camera import Camera
from drgs.scene.load_environment import load_environment
from drgs.scene.posed_scene import PosedScene, PrimarySurface

EMPTY, STRATEGY, MATERIAL, HORIZON, DARK, EDGES, PLACES = (
    "rays through empty tiles",
    "samples",
    "samples of strategies that",
    "tracing of rays",
    "light rays",
    "tests that no light ray",
    "places of pixels",
)
"""How the plan's skips begin."""


def switched_on(what: str, off: FrameState, on: FrameState) -> FrameState | None:
    """The frame without skips, with this one alone; None for a skip that this file does not know.

    Args:
        off, on: frames before their first pass, without and with the plan.
    """
    if what == EMPTY:
        return replace(off, tiles=replace(off.tiles, covered=on.tiles.covered, active=on.tiles.active.clone()))
    if what.startswith(MATERIAL):
        return replace(off, plan=replace(off.plan, by_material=True))
    if what.startswith(HORIZON):
        known = replace(off, traced=replace(off.traced, tracer=horizons_known(off.inputs.scene)))
        return with_settings(known, skip=True, skip_error=on.inputs.settings.skip_error)
    if what.startswith(EDGES):
        return replace(off, plan=replace(off.plan, swift=True))
    if what.startswith(PLACES):
        return replace(off, plan=replace(off.plan, spread_places=True))
    if what == DARK or what.endswith(STRATEGY):
        return replace(off, plan=replace(off.plan, counts=on.plan.counts, bounces=on.plan.bounces))
    return None


def relmse(frame: Frame, truth: Frame) -> float:
    covered = truth.gbuffer.coverage > 0
    x, y = (f.radiance_linear[covered].double() * f.gbuffer.coverage[covered][:, None] for f in (frame, truth))
    return float(((x - y) ** 2 / (y * y + 0.01)).mean())


def _same(state: FrameState) -> FrameState:
    return state


def timed(start: Callable[[], FrameState], passes: int, repeats: int) -> tuple[Frame, float]:
    """The picture, and the least processor seconds of some attempts."""
    best = float("inf")
    for _ in range(repeats):
        clock = time.process_time()
        state = refine_frame(start(), passes)
        best = min(best, time.process_time() - clock)
    return resolve_frame(state), best


def mean_and_error(frame: Frame) -> tuple[float, float]:
    """Mean luminance over the picture and its standard error."""
    covered = frame.gbuffer.coverage > 0
    brightness = luminance(frame.radiance_linear[covered].double())
    return float(brightness.mean()), float(frame.radiance.variance[covered].double().sum().sqrt()) / max(1, int(covered.sum()))


def compare(what: str, bound: str, found: Frame, plain: Frame, seconds: tuple[float, float]) -> dict:
    """One skip's row."""
    (a, noise_a), (b, noise_b) = mean_and_error(found), mean_and_error(plain)
    return {
        "what": what,
        "bound": bound,
        "largest_difference": float((found.radiance_linear - plain.radiance_linear).abs().max()),
        "mean_difference": (a - b) / b if b else a,
        "mean_difference_error": (noise_a**2 + noise_b**2) ** 0.5 / b if b else 0.0,
        "cpu_seconds": round(seconds[0], 4),
        "cpu_seconds_without": round(seconds[1], 4),
    }


def measure_skips(scene: PosedScene, camera: Camera, settings: RenderSettings, passes: int, repeats: int = 2) -> list[dict]:
    """One row for each skip of the plan that the settings lead to."""
    plain_settings = replace(settings, skip=False)
    on, off = start_frame(scene, camera, settings), start_frame(scene, camera, plain_settings)
    plain, seconds_plain = timed(partial(_same, off), passes, repeats)
    rows = []
    for skip in on.plan.skips:
        alone = switched_on(skip.what, off, on)
        if alone is None:
            rows.append({"what": skip.what, "bound": skip.bound, "note": "no switch for it here"})
            continue
        found, seconds = timed(partial(_same, alone), passes, repeats)
        rows.append(compare(skip.what, skip.bound, found, plain, (seconds, seconds_plain)))
    return rows


def measure_saving(scene: PosedScene, camera: Camera, settings: RenderSettings, passes: int, truth_passes: int, repeats: int = 2) -> dict:
    """Time and error with and without the plan, whole frames with a built tracer each."""
    calm = replace(settings, skip=False, seed=settings.seed + 1000)
    truth = resolve_frame(refine_frame(start_frame(scene, camera, calm), truth_passes))
    known = horizons_known(scene)
    starts = {
        "with": lambda: start_frame(scene, camera, replace(settings, skip=True)),
        "later": lambda: start_frame(scene, camera, replace(settings, skip=True), known),
        "without": lambda: start_frame(scene, camera, replace(settings, skip=False)),
    }
    result: dict = {}
    for name, start in starts.items():
        frame, seconds = timed(start, passes, repeats)
        result[name] = {"cpu_seconds": round(seconds, 4), "relmse": relmse(frame, truth)}
    cost = {name: row["cpu_seconds"] * row["relmse"] for name, row in result.items()}
    saved = {name: 1 - cost[name] / cost["without"] if cost["without"] else 0.0 for name in ("with", "later")}
    return {"saved": saved["with"], "saved_later": saved["later"]} | result


def horizons_known(scene: PosedScene) -> AbstractTracer:
    """A tracer of which all horizons have been looked for."""
    tracer = build_tracer(scene.mesh)
    tracer.horizons = Horizons(tracer.mesh, tracer.lift)
    tracer.horizons.find(tracer.horizons.faces)
    return tracer


def measure_taken_over(scene: PosedScene, camera: Camera, settings: RenderSettings, repeats: int = 2) -> list[dict]:
    """One row an edit that leaves something as it is."""
    old = refine_frame(start_frame(scene, camera, settings), 2)
    mesh, surfels = scene.mesh, scene.surfels
    painted = replace(scene, mesh=replace(mesh, albedo=0.5 * mesh.albedo))
    if surfels is not None:
        painted = replace(painted, surfels=replace(surfels, materials=replace(surfels.materials, albedo=0.5 * surfels.materials.albedo)))
    sky = replace(scene.environment, radiance=scene.environment.radiance.flip(1).contiguous())
    changes = {
        "albedo": painted,
        "environment": replace(scene, environment=sky),
        "light turned": replace(scene, environment_rotation_degrees=40.0),
    }
    rows = []
    for name, changed in changes.items():
        fresh, seconds_fresh = timed(partial(start_frame, changed, camera, settings), 1, repeats)
        after, seconds = timed(partial(start_frame, changed, camera, settings, previous=old), 1, repeats)
        rows.append(compare(name, "exact", after, fresh, (seconds, seconds_fresh)))
    return rows


def resized(camera: Camera, size: int) -> Camera:
    """The same view, `size` pixels wide."""
    scale = size / camera.width
    intrinsics = camera.intrinsics.clone()
    intrinsics[:2] *= scale
    return replace(camera, intrinsics=intrinsics, width=size, height=max(1, round(camera.height * scale)))


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks plan", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("asset", type=Path)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--size", type=int, default=200, help="width of the picture")
    parser.add_argument("--camera", type=int, default=0, help="which of the asset's")
    parser.add_argument("--spp", type=int, default=128)
    parser.add_argument("--truth", type=int, default=1024, help="samples behind the truth")
    parser.add_argument("--bounces", type=int, default=1)
    parser.add_argument("--env", type=Path, help="light instead of the asset's own")
    parser.add_argument("--primary", choices=["gaussians", "mesh"])
    parser.add_argument("--skip-error", type=float, default=0.0, help="share of the sky given up without proof")
    given = parser.parse_args(arguments)
    asset = load_asset(given.asset)
    if not asset.cameras:
        raise ValueError(f"{given.asset}: holds no cameras; expected a built asset")
    scene = pose_scene(asset, [])
    if given.env:
        scene = replace(scene, environment=load_environment(given.env))
    primary: PrimarySurface = given.primary or scene.primary
    settings = RenderSettings(bounces=given.bounces, primary=primary, skip_error=given.skip_error)
    camera = resized(asset.cameras[given.camera], given.size)
    per_pass = samples_per_pass(FrameInputs(scene, camera, settings)).total
    passes, truth_passes = (max(1, -(-samples // per_pass)) for samples in (given.spp, given.truth))
    refine_frame(start_frame(scene, camera, settings))  # compile and warm up
    report = {"asset": given.asset.name, "primary": primary, "bounces": given.bounces, "spp": passes * per_pass, "size": given.size}
    report |= measure_saving(scene, camera, settings, passes, truth_passes)
    report["skips"] = measure_skips(scene, camera, settings, passes)
    report["taken_over"] = measure_taken_over(scene, camera, settings)
    print(json.dumps(report, indent=None if given.json else 1))
