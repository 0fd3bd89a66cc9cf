"""Light transport against an independent path tracer: error, bias and time, in one run.

    python -m benchmarks integrator --reference DIR [--spp 8 32 128] [--variants paper sobol plan svgf oidn] [--mitsuba] [--seeds N] [--json] [--plots OUT]

DIR holds mesh.ply, cameras.json, env_*.exr, `<env>_<direct|bounce1>_<camera>.exr` (linear, premultiplied, many
samples) and `*_se.npy` (standard error of each pixel's mean). relmse = mean over covered pixels and channels of
(x - ref)^2 / (ref^2 + 0.01); bias = (sum x - sum ref) / sum ref; its error bar has both sides' noise.
seconds is wall time from a built tracer and a table of the environment on (Mitsuba makes its own of both when it loads a scene, before its clock starts),
cpu_seconds the sum over threads (steadier on a busy machine). within_4se = share of covered pixels whose RGB mean is within four standard errors (both sides' noise).
Variants, each with what the one before it has: `paper`, the published split of 16 cosine, 8 GGX and 8 environment samples with independent
numbers; `sobol`, low-discrepancy numbers; `plan`, what the scene does not need left out; `svgf`, its sums denoised. `oidn` denoises those of
`plan` by Open Image Denoise. Independent numbers are passes of 2, 1 and 1 samples with a seed each; their time is that of `sobol`, since the rays are
as many. --plots draws error against processor time, with the curve of Mitsuba that lies with the reference (another machine's clock).
With --mitsuba the same images are rendered by Mitsuba's path tracer in the same run (_mitsuba.py), and `time_to_error` gives for both the time
to relmse 0.01 and 0.003, read off the measured points (log-log between them, error ~ 1 / time beyond).
--seeds N also compares the mean of N pictures with the most samples (`over_seeds`): where ten pixels of a lamp's mirror image hold three quarters of
the noise of the sum, one picture's bias says little.
"""

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
import OpenEXR
import torch

from benchmarks._plot import Curve, log_log_svg
from drgs.render.film.denoise.oidn import oidn_filter
from drgs.render.film.resolve_frame import resolve_frame
from drgs.render.integrate.plan import samples_per_pass
from drgs.render.intersect.trace_rays import build_tracer
from drgs.render.intersect.tracer import AbstractTracer
from drgs.render.progressive.frame_state import FrameState, with_settings
from drgs.render.progressive.refine import refine_frame
from drgs.render.progressive.start_frame import start_frame
from drgs.render.records import RenderSettings, SampleCounts
from drgs.scene.camera import Camera, camera_from_opengl
from drgs.scene.environment import Environment
from drgs.scene.mesh import TriangleMesh
from drgs.scene.posed_scene import PosedScene
from drgs.warp_torch import device_from_name


def read_exr(path: Path) -> np.ndarray:
    """(height, width, channels) float32."""
    channels = OpenEXR.File(str(path)).channels()
    pixels = next(iter(channels.values())).pixels if len(channels) == 1 else np.stack([channels[c].pixels for c in "RGB"], -1)
    return np.asarray(pixels, np.float32)


def read_mesh(path: Path, device: torch.device | str = "cpu") -> TriangleMesh:
    """A binary PLY of float vertices x y z nx ny nz albedo_r/g/b roughness metallic and triangles."""
    raw = path.read_bytes()
    end = raw.index(b"end_header\n") + len(b"end_header\n")
    lines = raw[:end].decode().split("\n")
    counts = {line.split()[1]: int(line.split()[2]) for line in lines if line.startswith("element")}
    names = [line.split()[2] for line in lines if line.startswith("property float")]
    vertex = np.frombuffer(raw, "<f4", counts["vertex"] * len(names), end).reshape(-1, len(names))
    faces = np.frombuffer(raw, np.dtype([("n", "u1"), ("v", "<i4", 3)]), counts["face"], end + vertex.nbytes)["v"]

    def columns(*wanted: str) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(vertex[:, [names.index(name) for name in wanted]])).to(device)

    return TriangleMesh(
        columns("x", "y", "z"),
        torch.from_numpy(np.ascontiguousarray(faces)).to(device),
        torch.nn.functional.normalize(columns("nx", "ny", "nz"), dim=-1),
        columns("albedo_r", "albedo_g", "albedo_b"),
        columns("roughness")[:, 0],
        columns("metallic")[:, 0],
    )


def read_cameras(path: Path, size: int) -> list[Camera]:
    document = json.loads(path.read_text())
    focal = 0.5 * size / np.tan(0.5 * document["camera_angle_x"])
    intrinsics = torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    return [camera_from_opengl(torch.tensor(f["transform_matrix"]), intrinsics, size, size) for f in document["frames"]]


def compare(mean: np.ndarray, variance: np.ndarray, reference: np.ndarray, standard_error: np.ndarray) -> dict:
    """Error figures of one premultiplied image (height, width, 3) against the reference."""
    covered = reference[..., 3] > 0
    x, truth, se = mean[covered].astype(np.float64), reference[covered][:, :3].astype(np.float64), standard_error[covered]
    noise = np.sqrt(variance[covered] + se**2)
    difference = x.mean(1) - truth.mean(1)
    return {
        "relmse": float(np.mean((x - truth) ** 2 / (truth**2 + 0.01))),
        "bias": float(difference.sum() / truth.mean(1).sum()),
        "bias_error": float(np.sqrt((noise**2).sum()) / truth.mean(1).sum()),
        "within_4se": float((np.abs(difference) <= 4 * noise + 1e-6).mean()),
    }


def mitsuba_rows(radiance: np.ndarray) -> np.ndarray:
    """The table that makes our lookup give what Mitsuba's gives: its first and last rows of texels lie on the poles, ours half a
    texel inside. Without it city is 0.2 % and dawn -0.2 % off for this reason alone. Four times as many rows keep the blur small."""
    height = len(radiance)
    y = (np.arange(4 * height) + 0.5) / (4 * height) * (height - 1)
    row = np.minimum(y.astype(int), height - 2)
    part = (y - row).astype(np.float32)[:, None, None]
    return radiance[row] * (1 - part) + radiance[row + 1] * part


def time_to_error(rows: list[dict], target: float, clock: str) -> float:
    """Seconds until relmse falls to `target`, from rows of one image by one renderer."""
    rows = sorted(rows, key=lambda row: row["spp"])
    seconds, errors = (np.log([row[name] for row in rows]) for name in (clock, "relmse"))
    wanted = np.log(target)
    if wanted >= errors[0]:
        return float(np.exp(seconds[0] + errors[0] - wanted))
    if wanted <= errors[-1]:
        return float(np.exp(seconds[-1] + errors[-1] - wanted))
    return float(np.exp(np.interp(-wanted, -errors, seconds)))


VARIANTS = ("paper", "sobol", "plan", "svgf", "oidn")
LABELS = {
    "drgs_paper": "ours, paper's sampling",
    "drgs_sobol": "+ low discrepancy",
    "drgs": "+ plan",
    "drgs_svgf": "+ plan, SVGF",
    "drgs_oidn": "+ plan, OIDN",
    "mitsuba": "Mitsuba, same run",
}
"""In plots."""


@dataclass(frozen=True, eq=False)
class Shot:
    """A picture of one renderer."""

    variant: str
    spp: int
    mean: np.ndarray
    """(height, width, 3) premultiplied linear radiance."""
    variance: np.ndarray
    """(height, width) of the mean luminance; 0 where it is not told."""
    seconds: float
    """On the clock."""
    cpu_seconds: float
    """Summed over threads."""


def shot(variant: str, state: FrameState, seconds: float, cpu_seconds: float, denoise: str = "none") -> Shot:
    """The sums so far, shown; what showing takes is added to the time where it denoises."""
    device = state.sums.weight.device
    clock, cpu_clock = wall_clock(device), time.process_time()
    frame = resolve_frame(with_settings(state, denoise=denoise))
    if denoise != "none":
        seconds, cpu_seconds = seconds + wall_clock(device) - clock, cpu_seconds + time.process_time() - cpu_clock
    coverage = frame.gbuffer.coverage
    variance = (frame.radiance.variance * coverage**2).cpu().numpy() * (denoise == "none")
    return Shot(
        variant, frame.radiance.samples, (frame.radiance_linear * coverage[..., None]).cpu().numpy(), variance, seconds, cpu_seconds
    )


def wall_clock(device: torch.device) -> float:
    """[s], when all is done that was asked of the device."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def ours(
    scene: PosedScene, camera: Camera, settings: RenderSettings, tracer: AbstractTracer, samples: list[int], variants: list[str]
) -> Iterator[Shot]:
    """Pictures of the variants as samples grow."""
    for skip in (False, True):
        shown = [name for name in variants if (name in ("paper", "sobol")) != skip]
        if not shown:
            continue
        settings = replace(settings, skip=skip)
        warm = refine_frame(start_frame(scene, camera, settings, tracer))  # compile and warm up
        for name in shown:
            shot(name, warm, 0.0, 0.0, name if name in ("svgf", "oidn") else "none")
        tracer.horizons = None
        state, seconds, cpu_seconds, device = None, 0.0, 0.0, scene.mesh.vertices.device
        for spp in sorted(samples):
            clock, cpu_clock = wall_clock(device), time.process_time()
            if state is None:
                state = start_frame(scene, camera, settings, tracer)
                table_seconds = state.seconds["environment_table"]
                clock, cpu_clock = clock + table_seconds, cpu_clock + table_seconds
            state = refine_frame(state, max(0, -(-spp // samples_per_pass(state.inputs).total) - state.passes), consume=True)
            seconds, cpu_seconds = seconds + wall_clock(device) - clock, cpu_seconds + time.process_time() - cpu_clock
            for name in shown:
                if name == "paper":
                    yield shot(
                        name, independent(scene, camera, settings, tracer, state.passes * state.plan.counts.total), seconds, cpu_seconds
                    )
                else:
                    yield shot(name, state, seconds, cpu_seconds, name if name in ("svgf", "oidn") else "none")


def independent(scene: PosedScene, camera: Camera, settings: RenderSettings, tracer: AbstractTracer, spp: int) -> FrameState:
    """A frame of passes that know nothing of each other."""
    settings = replace(settings, counts=SampleCounts(2, 1, 1), skip=False)
    state = start_frame(scene, camera, settings, tracer)
    for number in range(-(-spp // 4)):
        state = refine_frame(with_settings(state, seed=settings.seed + 7919 * (number + 1)))
    return state


def of_mean(pictures: list[np.ndarray], reference: np.ndarray, standard_error: np.ndarray) -> dict:
    """Figures of the mean of pictures of several seeds, and how far one's sum lies from another's (`spread`, a share of it).

    Of one picture a few pixels may hold most of the noise of the sum: what is bias, only several tell.
    """
    variance = np.var([picture.mean(-1) for picture in pictures], axis=0, ddof=1) / len(pictures)
    sums = np.array([picture.sum(dtype=np.float64) for picture in pictures])
    spread = {"seeds": len(pictures), "spread": float(sums.std(ddof=1) / sums.mean())}
    return compare(np.mean(pictures, axis=0), variance, reference, standard_error) | spread


def mitsubas(scene: PosedScene, camera: Camera, bounces: int, seed: int, samples: list[int]) -> Iterator[Shot]:
    """As `ours`; each picture is made from nothing, its own variance is not told."""
    from benchmarks.render._mitsuba import MitsubaScene

    renderer = MitsubaScene(scene.mesh, scene.environment.radiance.numpy(), camera.to("cpu"), bounces)
    renderer.render(4, seed + 1)  # compile
    for spp in sorted(samples):
        mean, seconds, cpu_seconds = renderer.render(spp, seed)
        yield Shot("path", spp, mean, np.zeros(mean.shape[:2], np.float32), seconds, cpu_seconds)


def stored_curve(folder: Path, env: str, light: str) -> list[Curve]:
    """Mitsuba's curve that lies with the reference (camera 0), if it does."""
    path = folder / "mitsuba_error_vs_time.json"
    rows = json.loads(path.read_text()) if path.is_file() else []
    points = [(row["seconds"], row["relmse"]) for row in rows if (row["env"], row["light"]) == (env, light)]
    return [Curve("Mitsuba, stored curve", points)] if points else []


def plot(of_image: dict[str, list[dict]], stored: list[Curve], title: str) -> str:
    """Error against processor time of one picture (SVG)."""
    curves = [Curve(LABELS.get(name, name), [(row["cpu_seconds"], row["relmse"]) for row in rows]) for name, rows in of_image.items()]
    return log_log_svg(curves + stored, title, "processor seconds", "relmse")


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks integrator", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--reference", type=Path, required=True)
    parser.add_argument("--spp", type=int, nargs="+", default=[8, 32, 128])
    parser.add_argument("--env", nargs="+", default=["interior", "dawn", "city"])
    parser.add_argument("--light", nargs="+", default=["direct", "bounce1"])
    parser.add_argument("--cameras", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--counts", type=int, nargs=3, help="cosine, GGX and environment samples a pass")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seeds", type=int, default=1, help="also the bias of the mean of so many seeds, with the most samples")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--pictures", type=Path, help="folder for linear images and differences (npy)")
    parser.add_argument("--no-skip", action="store_true", help="without the plan: the same as --variants sobol")
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=["plan"])
    parser.add_argument("--plots", type=Path, help="folder for error against time, log-log (svg)")
    parser.add_argument("--mitsuba-rows", action="store_true", help="look the environment up as Mitsuba does (mitsuba_rows)")
    parser.add_argument("--mitsuba", action="store_true", help="also render with Mitsuba, in the same run")
    parser.add_argument("--mitsuba-spp", type=int, nargs="+", default=[16, 64, 256], help="its samples a pixel")
    parser.add_argument("--device", default="cpu", choices=["auto", "cpu", "cuda"], help="of ours")
    arguments = parser.parse_args(argv)

    folder: Path = arguments.reference
    variants = ["sobol"] if arguments.no_skip else arguments.variants
    if "oidn" in variants:
        oidn_filter()  # complain before measuring
    device = device_from_name(arguments.device)
    mesh = read_mesh(folder / "mesh.ply", device)
    tracer = build_tracer(mesh)
    rows, times, means = [], [], []
    for env in arguments.env:
        table = read_exr(folder / f"env_{env}.exr")[..., :3]
        environment = Environment(torch.from_numpy(mitsuba_rows(table) if arguments.mitsuba_rows else table.copy()).to(device))
        scene = PosedScene(None, mesh, environment)
        as_given = PosedScene(None, read_mesh(folder / "mesh.ply"), Environment(torch.from_numpy(table.copy())))
        for light, number in product(arguments.light, arguments.cameras):
            reference = read_exr(folder / f"{env}_{light}_{number}.exr")
            standard_error = np.load(folder / f"{env}_{light}_{number}_se.npy")
            camera = read_cameras(folder / "cameras.json", len(reference))[number].to(device)
            counts = SampleCounts(*arguments.counts) if arguments.counts else None
            bounces = int(light == "bounce1")
            settings = RenderSettings(bounces=bounces, primary="mesh", seed=arguments.seed, counts=counts)
            shots = {"drgs": ours(scene, camera, settings, tracer, arguments.spp, variants)}
            if arguments.mitsuba:
                shots["mitsuba"] = mitsubas(as_given, camera, bounces, arguments.seed, arguments.mitsuba_spp)
            of_image: dict[str, list[dict]] = {}
            for renderer, of_renderer in shots.items():
                for taken in of_renderer:
                    row = {"renderer": renderer, "variant": taken.variant, "env": env, "light": light, "camera": number, "spp": taken.spp}
                    row |= {"seconds": round(taken.seconds, 4), "cpu_seconds": round(taken.cpu_seconds, 4)}
                    row |= compare(taken.mean, taken.variance, reference, standard_error)
                    of_image.setdefault(renderer if taken.variant in ("plan", "path") else f"{renderer}_{taken.variant}", []).append(row)
                    _print(row, arguments.json)
                if renderer == "drgs" and arguments.pictures:
                    arguments.pictures.mkdir(parents=True, exist_ok=True)
                    maps = np.stack([taken.mean, reference[..., :3], np.repeat(taken.variance[..., None], 3, -1)])
                    np.save(arguments.pictures / f"{env}_{light}_{number}.npy", maps)
            rows += [row for of_renderer in of_image.values() for row in of_renderer]
            if arguments.seeds > 1:
                looks = [replace(settings, seed=arguments.seed + k) for k in range(arguments.seeds)]
                pictures = [next(ours(scene, camera, look, tracer, [max(arguments.spp)], ["plan"])).mean for look in looks]
                row = {"env": env, "light": light, "camera": number, "spp": max(arguments.spp)}
                row |= of_mean(pictures, reference, standard_error)
                means.append(row)
                _print(row, arguments.json)
            if arguments.plots:
                arguments.plots.mkdir(parents=True, exist_ok=True)
                stored = stored_curve(folder, env, light) if number == 0 else []
                picture = plot(of_image, stored, f"{env}, {light}, camera {number}")
                (arguments.plots / f"{env}_{light}_{number}.svg").write_text(picture)
            for target in (0.01, 0.003) if arguments.mitsuba else ():
                row = {"env": env, "light": light, "camera": number, "relmse": target}
                for renderer, clock in product(of_image, ("seconds", "cpu_seconds")):
                    row[f"{renderer}_{clock}"] = round(time_to_error(of_image[renderer], target, clock), 4)
                times.append(row)
                _print(row, arguments.json)
    if arguments.json:
        print(json.dumps({"rows": rows, "time_to_error": times, "over_seeds": means}))


def _print(row: dict, as_json: bool) -> None:
    if not as_json:
        print("  ".join(f"{k} {v:.5g}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items()), flush=True)


if __name__ == "__main__":
    main()
