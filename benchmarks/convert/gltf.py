"""How far what three.js draws of our GLB is from our own picture, under the same light from the same place, and what makes the difference.

    python -m benchmarks gltf ASSET [--faces N] [--lights FILE ...] [--views 3] [--size 256] [--spp 256] [--out FOLDER] [--json]

Figures are means over views, pixels that the object covers wholly, and channels [of 255, sRGB]; three.js' pixels are means of 16, for it looks through the
middle of each and ours are means of many rays. Of each light:
difference: between the two, as they are. without_occlusion: likewise, where three.js leaves the texture of occlusion out. The second apart:
unsaid: between our picture and ours of the same surfaces when nothing of the object is in the way (no shadows of itself, no light or reflection
from itself; _shade_open.py): what a file of surfaces cannot hold, and occlusion stands for. held: between that picture and three.js without occlusion:
how well the file says what it can. It is the two that follow: brdf: between that picture and the same with glTF's BRDF.
drawn: between that and three.js without occlusion: filtered light, textures, faces left out. Each has its mean with sign in *_brighter (of what is
compared with ours, or with what is nearer to ours). noise: what other rays of ours would change, about; it is in all of them.
"""

import argparse
import json
import tempfile
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from PIL import Image
from playwright.sync_api import Browser, sync_playwright

from benchmarks.convert._shade_open import shade_open
from benchmarks.convert._three_picture import SeenByThree, ThreePage, three_version
from drgs.convert.export_asset import export_asset
from drgs.deform.pose_scene import pose_scene
from drgs.maths.constants import STILL_BOUNCES
from drgs.render.film.tonemap import tonemap
from drgs.render.records import RenderSettings
from drgs.render.render_frame import render_frame
from drgs.scene.asset import Asset, load_asset
from drgs.scene.camera import camera_from_opengl
from drgs.scene.edits import parse_edits
from drgs_worker.jobs.start_view import FOV_Y_DEGREES, turntable_view
from tests.web.browser import CHROMIUM_ARGUMENTS, ROOT, chromium_path

LIGHTS = tuple(ROOT / "examples" / "environments" / f"{name}.exr" for name in ("overcast", "studio"))
ELEVATION_DEGREES = 25.0
OPEN_RAYS = 8
"""How many times as many rays pictures of surfaces in the open get: such rays meet nothing, and are cheap."""

Picture = Float[ndarray, "height width 4"]
"""0..255, sRGB, straight alpha."""


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks gltf", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("asset", type=Path, help="asset folder, or the same zipped")
    parser.add_argument("--faces", type=int, help="the most that the exported mesh has; as `drgs export` without it")
    parser.add_argument("--lights", type=Path, nargs="+", default=LIGHTS, help="EXR files; overcast and studio of the examples without it")
    parser.add_argument("--views", type=int, default=3, help="places on a circle around the object")
    parser.add_argument("--size", type=int, default=256, help="of the picture, both ways [pixels]")
    parser.add_argument("--spp", type=int, default=256, help="rays a pixel of our pictures")
    parser.add_argument("--out", type=Path, help="keep the GLB and all pictures in this folder")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(prefix="drgs-gltf-") as folder, sync_playwright() as playwright:
        out = given.out or Path(folder)
        out.mkdir(parents=True, exist_ok=True)
        browser = playwright.chromium.launch(executable_path=chromium_path(), args=list(CHROMIUM_ARGUMENTS))
        found = measure(browser, load_asset(given.asset), out, given.faces, list(given.lights), given.views, given.size, given.spp)
        browser.close()
    print(json.dumps(found, indent=None if given.json else 1))


def measure(
    browser: Browser, asset: Asset, out: Path, faces: int | None, lights: list[Path], views: int, side: int, samples: int
) -> dict[str, object]:
    """All figures; the GLB and the pictures lie in `out` afterwards.

    Raises:
        ValueError: an environment cannot be read, or three.js is not installed.
    """
    export_asset(asset, out / "object.glb", "mesh", faces)
    found: dict[str, object] = {"three": three_version(), "bytes": (out / "object.glb").stat().st_size, "views": views}
    for light in lights:
        with closing(ThreePage(browser, light.read_bytes())) as three:
            rows = [
                _compared(_pictures(three, asset, out, light, 360 * view / views, side, samples), out / f"{light.stem}-{view}")
                for view in range(views)
            ]
        found[light.stem] = {name: round(float(np.mean([row[name] for row in rows])), 2) for name in rows[0]}
    return found


def _pictures(
    three: ThreePage, asset: Asset, out: Path, light: Path, azimuth_degrees: float, side: int, samples: int
) -> dict[str, Picture]:
    low, high = asset.mesh.vertices.amin(0).tolist(), asset.mesh.vertices.amax(0).tolist()
    view = turntable_view(low, high, azimuth_degrees, ELEVATION_DEGREES)
    focal = side / 2 / np.tan(np.radians(FOV_Y_DEGREES / 2))
    camera = camera_from_opengl(torch.from_numpy(view), torch.tensor([[focal, 0, side / 2], [0, focal, side / 2], [0, 0, 1.0]]), side, side)
    scene = pose_scene(asset, parse_edits([{"op": "environment", "file": light.name}]), light.parent)
    settings = RenderSettings(samples_per_pixel=max(1, samples // 2), bounces=STILL_BOUNCES, primary="mesh")
    frame, again = (render_frame(scene, camera, replace(settings, seed=seed)) for seed in range(2))
    coverage = (frame.gbuffer.coverage + again.gbuffer.coverage) / 2
    ours = tonemap((frame.radiance_linear + again.radiance_linear) / 2, coverage)
    alone = shade_open(scene, camera, OPEN_RAYS * samples)
    in_metres = view.copy()
    in_metres[:3, 3] *= asset.meters_per_unit
    seen = SeenByThree(in_metres.tolist(), FOV_Y_DEGREES, side, side)
    glb = (out / "object.glb").read_bytes()
    return {
        "ours": 255 * ours.double().numpy(),
        "open": 255 * tonemap(alone.ours, coverage).double().numpy(),
        "gltf": 255 * tonemap(alone.gltf, coverage).double().numpy(),
        "plain": three.fine_picture(glb, ".glb", replace(seen, without=("aoMap",))),
        "three": three.fine_picture(glb, ".glb", seen),
        "other_rays": 255 * frame.rgba_srgb.double().numpy(),
    }


def _compared(pictures: dict[str, Picture], where: Path) -> dict[str, float]:
    inside = np.all([picture[..., 3] > 254.5 for picture in pictures.values()], 0)
    if not inside.any():
        raise ValueError(f"{where.name}: the object covers no pixel wholly; ask for a larger --size")
    row = np.concatenate([picture.clip(0, 255).round().astype(np.uint8) for picture in pictures.values()], 1)
    Image.fromarray(row).save(where.with_suffix(".png"))
    pairs = {
        "difference": ("three", "ours"),
        "without_occlusion": ("plain", "ours"),
        "unsaid": ("open", "ours"),
        "held": ("plain", "open"),
        "brdf": ("gltf", "open"),
        "drawn": ("plain", "gltf"),
    }
    found = {}
    for name, (one, other) in pairs.items():
        apart = (pictures[one] - pictures[other])[inside][:, :3]
        found[name], found[f"{name}_brighter"] = float(np.abs(apart).mean()), float(apart.mean())
    # Half of the rays lie as far from their mean with the other half as that mean from the truth.
    found["noise"] = float(np.abs(pictures["other_rays"] - pictures["ours"])[inside][:, :3].mean())
    return found


if __name__ == "__main__":
    import sys

    main(sys.argv[1:])
