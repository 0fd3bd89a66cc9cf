"""The gallery's pictures and its page, from built assets; nothing on it is drawn otherwise.

    python docs/make_gallery.py NAME=ASSET ... [--side 320] [--spp 128] [--three FOLDER]

Writes docs/gallery.md and docs/images/gallery/NAME.jpg: of each asset a strip of the same view, as it is and under edits (LOOKS). --three: a folder
that `python -m benchmarks gltf ASSET --out FOLDER` wrote, of which a picture of ours and three.js' of our GLB are shown side by side.
"""

import argparse
import io
import json
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from drgs.deform.pose_scene import pose_scene
from drgs.maths.constants import STILL_BOUNCES
from drgs.render.records import RenderSettings
from drgs.render.render_frame import render_frame
from drgs.scene.asset import Asset, load_asset
from drgs.scene.camera import Camera, camera_from_opengl
from drgs.scene.edits import parse_edits
from drgs_worker.jobs.start_view import FOV_Y_DEGREES, start_view

DOCS = Path(__file__).resolve().parent
ENVIRONMENTS = DOCS.parent / "examples" / "environments"
JPEG_QUALITY = 88
MOST_BYTES = 2_000_000
"""Of all pictures of the gallery."""
SUNSET = {"op": "environment", "file": "sunset.exr", "rotation": 30}
GOLD = {"op": "material", "select": {"all": True}, "set": {"albedo": [0.9, 0.6, 0.2], "metallic": 1.0, "roughness": 0.2}}
LOOKS: tuple[tuple[str, tuple[dict, ...]], ...] = (
    ("under the light it was photographed in", ()),
    ("at sunset", (SUNSET,)),
    ("in gold, in a studio", (GOLD, {"op": "environment", "file": "studio.exr"})),
    (
        "twisted, under an overcast sky",
        ({"op": "deform", "map": {"type": "twist", "rate": 0.6}}, {"op": "environment", "file": "overcast.exr"}),
    ),
)
"""What is shown of each asset, and the edits that make it."""


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("assets", nargs="+", metavar="NAME=ASSET")
    parser.add_argument("--side", type=int, default=320, help="of one picture [pixels]")
    parser.add_argument("--spp", type=int, default=128)
    parser.add_argument("--three", type=Path, help="of `python -m benchmarks gltf --out`")
    parser.add_argument("--docs", type=Path, default=DOCS, help="folder to write into")
    given = parser.parse_args(arguments)
    folder = given.docs / "images" / "gallery"
    folder.mkdir(parents=True, exist_ok=True)
    parts = [introduction()]
    for name, _, path in (text.partition("=") for text in given.assets):
        asset = load_asset(Path(path))
        save(strip(asset, given.side, given.spp), folder / f"{name}.jpg")
        parts.append(section(name, asset))
    if given.three is not None:
        save(beside_three(given.three), folder / "in_three.jpg")
        parts.append(THREE_SECTION)
    refuse_too_much(folder)
    (given.docs / "gallery.md").write_text("\n".join(parts))


def introduction() -> str:
    looks = "; ".join(what for what, _ in LOOKS)
    edits = json.dumps([edit for _, edits in LOOKS for edit in edits][1:2])
    return f"""# Gallery

Every picture here is an output of the program, made by `docs/make_gallery.py` from built assets: none was retouched or chosen from several.
Of each object the same view, from left to right: {looks}.

An edit is one line of JSON; the gold:
```json
{edits}
```
and a picture with it one command ([tutorial](tutorial.md), [all edits](protocol.md)).
"""


def section(name: str, asset: Asset) -> str:
    built = asset.provenance
    preset, pictures = built.get("preset"), len(asset.cameras)
    how = f"Built with `--preset {preset}` of {pictures} photographs" if preset and pictures else "Imported"
    title = name.replace("_", " ").capitalize()
    faces = f"{len(asset.mesh.faces):,}".replace(",", " ")
    return f"""## {title}
{how}; {faces} faces.

![{title}: {"; ".join(what for what, _ in LOOKS)}](images/gallery/{name}.jpg)
"""


THREE_SECTION = """## In another program
Two pairs, under an overcast sky and in a studio: of each, left our renderer, right three.js with the GLB that `drgs export` wrote. Shapes and paint agree; the gold
ball mirrors its ring in our pictures alone, for a program that draws in real time traces no rays ([what else differs, and by how much](formats.md#textures-of-meshes)).

![The same object by our renderer and by three.js, under two lights](images/gallery/in_three.jpg)
"""


def strip(asset: Asset, side: int, samples: int) -> Image.Image:
    """The looks of an asset, side by side, over white."""
    camera = first_view(asset, side)
    pictures = []
    for _, edits in LOOKS:
        scene = pose_scene(asset, parse_edits(list(edits)), ENVIRONMENTS)
        settings = RenderSettings(
            samples_per_pixel=samples, bounces=STILL_BOUNCES, primary="mesh", denoise="svgf", background=(1.0, 1.0, 1.0)
        )
        rgb = render_frame(scene, camera, settings).rgba_srgb[..., :3].clamp(0, 1)
        pictures.append((rgb * 255).round().to(torch.uint8).numpy())
    return Image.fromarray(np.concatenate(pictures, 1))


def first_view(asset: Asset, side: int) -> Camera:
    """That of new viewers."""
    low, high = asset.mesh.vertices.amin(0).tolist(), asset.mesh.vertices.amax(0).tolist()
    focal = side / 2 / np.tan(np.radians(FOV_Y_DEGREES / 2))
    intrinsics = torch.tensor([[focal, 0, side / 2], [0, focal, side / 2], [0, 0, 1.0]])
    return camera_from_opengl(torch.from_numpy(start_view(low, high)), intrinsics, side, side)


def beside_three(folder: Path) -> Image.Image:
    """Our picture and three.js' of one light, over white, of rows that benchmarks/convert/gltf.py wrote."""
    rows = []
    for light in ("overcast", "studio"):
        row = Image.open(folder / f"{light}-0.png").convert("RGBA")
        pictures = [row.crop((index * row.height, 0, (index + 1) * row.height, row.height)) for index in (0, 4)]
        rows += [Image.alpha_composite(Image.new("RGBA", picture.size, "white"), picture) for picture in pictures]
    sheet = Image.new("RGB", (sum(picture.width for picture in rows), rows[0].height))
    for index, picture in enumerate(rows):
        sheet.paste(picture.convert("RGB"), (index * picture.width, 0))
    return sheet


def save(picture: Image.Image, path: Path) -> None:
    encoded = io.BytesIO()
    picture.save(encoded, "JPEG", quality=JPEG_QUALITY, optimize=True)
    path.write_bytes(encoded.getvalue())


def refuse_too_much(folder: Path) -> None:
    """
    Raises:
        ValueError: the pictures take more than a gallery may.
    """
    size = sum(path.stat().st_size for path in folder.glob("*.jpg"))
    if size > MOST_BYTES:
        raise ValueError(f"{folder}: pictures of {size} bytes, expected at most {MOST_BYTES}: choose a smaller --side")


if __name__ == "__main__":
    main()
