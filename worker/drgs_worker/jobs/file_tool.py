"""The file tool: read or write one untrusted file in a process of its own, with bounded memory.

The server calls it (`run_file_tool`), so that a decoder that crashes or swallows memory takes no server down; begin_tool.py begins it, and
`python -m drgs_worker.jobs.file_tool` by hand. Exit code 2 and one sentence on stderr for wrong input; 3 where the disk is full. Commands:
    asset SOURCE OUT            zipped asset or mesh (.zip .glb .ply .obj) -> asset folder
    environment SOURCE OUT      EXR or Radiance HDR -> EXR
    look CAPTURE OUT NAME       folder of a capture, which sentences call NAME -> folder with look.json and, where it has pictures, sheet.jpg (drgs/evaluate/look_at_capture.py)
    pictures CAPTURE OUT        folder of a posed capture -> folder with its pictures as 0.jpg, 1.jpg, ..., in the order of look.json's cameras, without lens distortion
    masks CAPTURE STROKES OUT   the same and strokes (drgs/scene/strokes.py) -> folder with masks.json and sheet.jpg, on which the strokes' masks are outlined
    export ASSET OUT FORMAT FACES [EDITS ENVIRONMENTS N]    asset folder, with the edits put into it -> a format of drgs/exchange/export_formats.py, or zip
                                (the asset itself); FACES: the most that a textured mesh has, 0 where nobody says. A GLB and a page have the variants that the edits keep
    export ASSET OUT FORMAT FACES VARIANTS ENVIRONMENTS     asset folder -> a GLB or a page with the variants of a file (drgs/convert/material_variants.py)
    version ASSET OUT EDITS ENVIRONMENTS N      asset folder with the edits of a JSON file put into it -> asset folder, version N
"""

import asyncio
import errno
import json
import resource
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drgs.maths.constants import MIDDLE_GREY
from drgs_worker.jobs.begin_tool import READ_BYTES, RunningTool, begin_tool
from drgs_worker.jobs.start_view import FOV_Y_DEGREES, start_view
from drgs_worker.store import disk_trouble

if TYPE_CHECKING:
    from drgs.scene.asset import Asset

THUMBNAIL_SIDE = 256
"""Pixels."""
MEMORY_BYTES = 16 << 30
"""Of address space; torch alone reserves a few GiB."""
TIMEOUT_SECONDS = 300
FULL_EXIT_CODE = 3
"""There was no room to write the result."""
TOOL_BYTES = 512 << 20
"""Of a tool that has loaded torch and its kernels, without anything to work on."""
COPIES = 8
"""Of a file's bytes that reading it takes, and painting the textures of what it holds, about: an asset of 18 MB takes 0.65 GiB as a GLB."""
ENVIRONMENT_BYTES = 96 << 20
"""Of the tool while it reads an environment, for which it needs no torch, without any pixels."""
PIXEL_BYTES = 36
"""Of a pixel of an environment: read, looked at, and written."""
CHANNEL_BYTES = 8
"""Of a pixel in each channel more than its three, which are read and thrown away."""
LOOK_BYTES = 320 << 20
"""Beside TOOL_BYTES, of looking at a capture: the picture that is being read, the sheet, masks and points."""
LOOK_PICTURE_BYTES = 512 << 10
"""Of each of its files: a picture shrunken to 400 pixels a side, or a mask."""
LOOK_NAME, SHEET_NAME = "look.json", "sheet.jpg"
MASKS_NAME = "masks.json"
PICTURE_SIDE = 800
"""Of pictures that strokes are drawn over, and"""
MASKS_SIDE = 256
"""of those that masks are then shown for [pixels]."""
MASKS_BYTES = 2 << 20
"""Of each picture while its mask is found."""
MOST_ENVIRONMENT_SIDES = (8192, 4096)
"""Of an environment that a service takes: 1.2 GiB while it is read, and 400 MB in memory while something is lit by it."""
MOST_CHANNEL_BYTES = 512 << 20
"""Of all its channels as float32: four of the largest size, or more of a smaller."""
MOST_ENVIRONMENT_FILE = 640 << 20
"""Bytes of its file: such channels without any packing, and a long header."""


class FileToolError(ValueError):
    """The input is wrong; the text is a sentence."""


def file_tool_bytes(source: Path) -> int:
    """Memory that the tool takes to work on a file or a folder, estimated: what it is written in, and a few copies of what the source holds."""
    size = source.stat().st_size if source.is_file() else sum(path.stat().st_size for path in source.rglob("*") if path.is_file())
    if source.suffix in (".exr", ".hdr"):
        return ENVIRONMENT_BYTES + min(size, MOST_ENVIRONMENT_FILE) + _pixel_bytes(source)
    return TOOL_BYTES + COPIES * size


def _pixel_bytes(picture: Path) -> int:
    """What decoding a picture takes by its header; the most that any may take where that says nothing, for then the decoder has the last word."""
    from drgs.exchange.exr import picture_claim

    with picture.open("rb") as file:
        claim = picture_claim(file)
    width, height = MOST_ENVIRONMENT_SIDES
    most = width * height * PIXEL_BYTES
    return most if claim is None else min(most, claim.width * claim.height * (PIXEL_BYTES + CHANNEL_BYTES * max(claim.channels - 3, 0)))


def look_bytes(capture: Path) -> int:
    """Memory that the tool takes to look at a capture, estimated: pictures are shrunken one by one."""
    return TOOL_BYTES + LOOK_BYTES + LOOK_PICTURE_BYTES * sum(1 for path in capture.rglob("*") if path.is_file())


def masks_bytes(capture: Path) -> int:
    """The same of finding masks by strokes."""
    return look_bytes(capture) + MASKS_BYTES * sum(1 for path in capture.rglob("*") if path.is_file())


async def run_file_tool(*arguments: str) -> None:
    """Run the tool and wait.

    Raises:
        FileToolError: with the tool's own sentence, or one that says that it crashed or took too long.
        OSError: the disk is full.
    """
    try:
        code, errors = await asyncio.wait_for(_run(*arguments), TIMEOUT_SECONDS)
    except TimeoutError as error:
        raise FileToolError(f"The file took more than {TIMEOUT_SECONDS} s to read; it is too large or damaged.") from error
    if code == FULL_EXIT_CODE:
        raise OSError(errno.ENOSPC, disk_trouble.SENTENCE)
    if code == 2:
        raise FileToolError(errors.strip().splitlines()[-1][:1000])
    if code != 0:
        raise FileToolError("The file could not be read; it is damaged, or too large for this machine's memory.")


async def _run(*arguments: str) -> tuple[int, str]:
    """Exit code and what was said; whoever is cancelled meanwhile leaves no tool behind that writes."""
    loop = asyncio.get_running_loop()
    tool = begin_tool(*arguments)
    try:
        await _hear(loop, tool)
    except asyncio.CancelledError:
        tool.stop()
        await _hear(loop, tool)
        raise
    finally:
        tool.close()
    return tool.result()


async def _hear(loop: asyncio.AbstractEventLoop, tool: RunningTool) -> None:
    tool.channel.setblocking(False)
    while said := await loop.sock_recv(tool.channel, READ_BYTES):
        tool.hear(said)


def make_asset(source: Path, out: Path) -> None:
    """A zipped asset is read and written anew, so that nothing else of the archive arrives."""
    from drgs.exchange.photographs import PHOTOGRAPHS, check_photographs
    from drgs.scene.asset import load_asset, load_photographs, save_asset
    from drgs.scene.mesh import refuse_unusable

    if source.suffix != ".zip":
        from drgs.convert.import_mesh import import_mesh

        asset, photographs = import_mesh(source), None
    else:
        asset, photographs = load_asset(source), load_photographs(source)
        refuse_unusable(asset.mesh, f"{source}: mesh.glb")
        if photographs is not None:
            check_photographs(photographs, len(asset.cameras), f"{source}: {PHOTOGRAPHS}")
    save_asset(asset, out, thumbnail(asset), photographs)


def thumbnail(asset: "Asset") -> bytes:
    """A small picture of an asset under its own light, over grey."""
    import numpy as np
    import simplejpeg
    import torch

    from drgs.deform.pose_scene import pose_scene
    from drgs.render.records import RenderSettings
    from drgs.render.render_frame import render_frame
    from drgs.scene.camera import camera_from_opengl

    low, high = asset.mesh.vertices.amin(0).tolist(), asset.mesh.vertices.amax(0).tolist()
    focal = THUMBNAIL_SIDE / 2 / np.tan(np.radians(FOV_Y_DEGREES) / 2)
    intrinsics = torch.tensor([[focal, 0, THUMBNAIL_SIDE / 2], [0, focal, THUMBNAIL_SIDE / 2], [0, 0, 1]])
    camera = camera_from_opengl(torch.from_numpy(start_view(low, high)), intrinsics, THUMBNAIL_SIDE, THUMBNAIL_SIDE)
    settings = RenderSettings(samples_per_pixel=64, background=(MIDDLE_GREY, MIDDLE_GREY, MIDDLE_GREY))
    rgba = render_frame(pose_scene(asset, []), camera, settings).rgba_srgb
    pixels = (rgba[..., :3].clamp(0, 1) * 255 + 0.5).to(torch.uint8).numpy()
    return simplejpeg.encode_jpeg(np.ascontiguousarray(pixels), quality=85, colorspace="RGB")


def make_version(asset_folder: Path, out: Path, edits: Path, environments: Path, version: int) -> None:
    from drgs.scene.asset import load_photographs, save_asset

    made = edited_asset(asset_folder, edits, environments, version)
    save_asset(made, out, thumbnail(made), load_photographs(asset_folder))


def edited_asset(asset_folder: Path, edits: Path, environments: Path, version: int) -> "Asset":
    from drgs.convert.bake_edits import bake_edits
    from drgs.scene.asset import load_asset
    from drgs.scene.edits import load_edits

    return bake_edits(load_asset(asset_folder), load_edits(edits), environments, version)


def make_look(capture: Path, out: Path, name: str) -> None:
    """The folder `out` is there when all of it is."""
    from drgs.evaluate.look_at_capture import look_at_capture

    draft = out.with_name(f"{out.name}.part")
    draft.mkdir()
    look = look_at_capture(capture, draft / SHEET_NAME, name)
    (draft / LOOK_NAME).write_text(json.dumps(look, allow_nan=False))
    draft.rename(out)


def make_pictures(capture: Path, out: Path) -> None:
    """The folder `out` is there when all of it is."""
    import simplejpeg

    from drgs.evaluate.look_at_capture import told_cameras
    from drgs.reconstruct.capture.load_views import load_unmasked_views

    views = load_unmasked_views(capture, PICTURE_SIDE)
    draft = out.with_name(f"{out.name}.part")
    draft.mkdir()
    for number, camera in enumerate(told_cameras(len(views.cameras))):
        image = views.images_srgb[camera].contiguous().numpy()
        (draft / f"{number}.jpg").write_bytes(simplejpeg.encode_jpeg(image, quality=85, colorspace="RGB"))
    draft.rename(out)


def make_masks(capture: Path, strokes: Path, out: Path) -> None:
    """The folder `out` is there when all of it is."""
    from dataclasses import asdict

    from drgs.evaluate.contact_sheet import contact_sheet
    from drgs.reconstruct.capture.load_views import load_unmasked_views
    from drgs.reconstruct.capture.masks_by_strokes import masks_by_strokes
    from drgs.scene.strokes import read_strokes

    masked = masks_by_strokes(load_unmasked_views(capture, MASKS_SIDE), read_strokes(strokes))
    assert masked is not None  # nobody stopped it
    draft = out.with_name(f"{out.name}.part")
    draft.mkdir()
    report = {"summary": f"{len(masked.cameras)} pictures, masked by strokes.", "findings": [], "marks": {}}
    layout = contact_sheet(capture, report, draft / SHEET_NAME, masked)
    (draft / MASKS_NAME).write_text(json.dumps({"sheet": asdict(layout)}, allow_nan=False))
    draft.rename(out)


def make_environment(source: Path, out: Path) -> None:
    from drgs.exchange.exr import PictureLimits, decode_environment, encode_environment

    size = source.stat().st_size
    if size > MOST_ENVIRONMENT_FILE:
        raise ValueError(f"{source}: has {size} bytes; the limit for an environment is {MOST_ENVIRONMENT_FILE}: make it smaller")
    limits = PictureLimits(*MOST_ENVIRONMENT_SIDES, MOST_CHANNEL_BYTES)
    out.write_bytes(encode_environment(decode_environment(source.read_bytes(), source.name, limits=limits)))


def export(asset_folder: Path, out: Path, format: Any, faces: int) -> None:
    from drgs.scene.asset import load_asset

    picture = asset_folder / "thumb.jpg"
    write_export(load_asset(asset_folder), asset_folder, out, format, faces, lambda: picture.read_bytes() if picture.exists() else None)


def export_variants(asset_folder: Path, out: Path, format: Any, faces: int, variants: Path, environments: Path) -> None:
    from drgs.convert.export_asset import export_asset
    from drgs.convert.material_variants import load_variants, worn_meshes
    from drgs.scene.asset import load_asset

    asset = load_asset(asset_folder)
    export_asset(asset, out, format, faces or None, worn_meshes(asset, asset.mesh, load_variants(variants), environments))


def export_edited(asset_folder: Path, out: Path, format: Any, faces: int, edits: Path, environments: Path, version: int) -> None:
    from drgs.convert.bake_edits import bake_edits
    from drgs.convert.export_asset import export_asset
    from drgs.convert.material_variants import worn_meshes
    from drgs.deform.pose_scene import pose_scene
    from drgs.exchange.export_formats import VARIANT_FORMATS
    from drgs.scene.asset import load_asset
    from drgs.scene.edits import AS_CAPTURED, AS_SHOWN, load_edits
    from drgs.scene.variants import kept_variants, material_edits

    asset, listed = load_asset(asset_folder), load_edits(edits)
    made, variants = bake_edits(asset, listed, environments, version), kept_variants(listed)
    if format in VARIANT_FORMATS:
        shown, worn = AS_SHOWN if material_edits(listed) else AS_CAPTURED, None
        if variants:
            source = pose_scene(asset, listed, environments, confine=True).vertex_source
            worn = worn_meshes(asset, made.mesh, variants, environments, source)
        export_asset(made, out, format, faces or None, worn, shown)
    else:
        write_export(made, asset_folder, out, format, faces, lambda: thumbnail(made))


def write_export(asset: "Asset", source: Path, out: Path, format: Any, faces: int, picture: Callable[[], bytes | None]) -> None:
    """`picture` is asked for where the format keeps one; photographs are those of the folder `source`."""
    if format == "zip":
        from drgs.scene.asset import load_photographs, save_asset

        save_asset(asset, out, picture(), load_photographs(source))
    else:
        from drgs.convert.export_asset import export_asset

        export_asset(asset, out, format, faces or None)


def main(arguments: list[str]) -> int:
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    try:
        match arguments:
            case ["asset", source, out]:
                make_asset(Path(source), Path(out))
            case ["environment", source, out]:
                make_environment(Path(source), Path(out))
            case ["look", capture, out, name]:
                make_look(Path(capture), Path(out), name)
            case ["pictures", capture, out]:
                make_pictures(Path(capture), Path(out))
            case ["masks", capture, strokes, out]:
                make_masks(Path(capture), Path(strokes), Path(out))
            case ["export", asset, out, format, faces]:
                export(Path(asset), Path(out), format, int(faces))
            case ["export", asset, out, format, faces, edits, environments, version]:
                export_edited(Path(asset), Path(out), format, int(faces), Path(edits), Path(environments), int(version))
            case ["export", asset, out, format, faces, variants, environments]:
                export_variants(Path(asset), Path(out), format, int(faces), Path(variants), Path(environments))
            case ["version", asset, out, edits, environments, version]:
                make_version(Path(asset), Path(out), Path(edits), Path(environments), int(version))
            case _:
                raise ValueError(
                    f"expected asset, environment, look, pictures, masks, export or version with their arguments; found {arguments}"
                )
    except RecursionError:
        print("the file is nested deeper than is read here", file=sys.stderr)
        return 2
    except MemoryError:
        print(f"the file needs more memory than the {MEMORY_BYTES >> 30} GiB that reading one may take", file=sys.stderr)
        return 2
    except Exception as error:
        print(str(error).replace("\n", " "), file=sys.stderr)
        if disk_trouble.is_disk_full(error):
            return FULL_EXIT_CODE
        if not isinstance(error, ValueError | OSError):
            raise
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
