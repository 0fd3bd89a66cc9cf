"""An asset as a file that other programs read: the formats of drgs/exchange/export_formats.py.

ply   2D Gaussians, two scales, `SplatRenderMode: 2dgs` (SuperSplat, splat-transform)
ply3  the same with a flat third scale, for viewers of 3D Gaussians
spz   the Gaussians in a seventh of the bytes, without materials, y up and in metres, thin as far as the format goes
glb   mesh with textures (bake_textures: base colour, occlusion-roughness-metallic, normals; Blender, three.js, Unreal, Unity), and in a
      second scene the Gaussians as splats by KHR_gaussian_splatting, flat like those of ply3
mesh  the same without the Gaussians
html  a page: mesh, lights and the program that draws them in a browser, in one file (page/)
usdz  the textured mesh for viewers of augmented reality, upright and in metres
usd   mesh with the same textures, the Gaussians as splats, flat like those of ply3, and the light (OpenUSD 26)
env   the recovered light, lat-long EXR, linear
Viewers of Gaussians show colours as they stand in the file, so there the linear radiance is turned to sRGB.
"""

import os
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from drgs.convert.bake_textures import TexturedMesh, bake_textures
from drgs.convert.gltf_reflectance import BASE_COLOR_MARK, gltf_base_color, usd_base_color
from drgs.convert.material_variants import Variants, refuse_variants, variant_meshes
from drgs.exchange.export_formats import DEFAULT_FACES, EXPORT_FORMATS, TEXTURED_FORMATS, VARIANT_FORMATS, ExportFormat, refuse_faces
from drgs.exchange.exr import encode_environment
from drgs.exchange.gaussian_ply import encode_gaussian_ply, log_thickness
from drgs.exchange.glb import GlbMesh, GlbPoints, GlbVariant, encode_glb
from drgs.exchange.gltf_splats import GltfSplats, points_from_splats
from drgs.exchange.pictures import encode_png
from drgs.exchange.spz import SMALLEST_SCALE, encode_spz
from drgs.exchange.usd import BASE_COLOR, NORMAL, SURFACE, UsdScene, refuse_unwritable, write_ar_usdz, write_usd
from drgs.maths.color import srgb_from_linear
from drgs.maths.frames import quat_wxyz_from_rotation, rotation_from_quat_wxyz
from drgs.maths.spherical_harmonics import map_radiance, rotate_sh
from drgs.scene.asset import Asset
from drgs.scene.edits import AS_CAPTURED
from drgs.scene.gaussians import Gaussians
from drgs.scene.mesh import TriangleMesh, on_cpu

_UPRIGHT_FROM_WORLD = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]], dtype=torch.float64)
"""z up to y up."""


def export_asset(
    asset: Asset,
    out: Path | str,
    format: ExportFormat,
    faces: int | None = None,
    variants: Variants | None = None,
    shown: str = AS_CAPTURED,
) -> str:
    """Write one file; an existing one is replaced at once.

    Args:
        faces: the most that a textured mesh has; the detail of those left out goes into its textures. None: DEFAULT_FACES.
        variants: other materials of the mesh: of a GLB by KHR_materials_variants, with textures baked for each, or to be chosen on a page.
        shown: what a file with variants calls the asset as it is.

    Returns:
        What the file leaves out or shows otherwise, in words; empty where it has all that its format can hold.

    Raises:
        ValueError: unknown format, Gaussians asked of an asset that has none, usd-core is missing, no page can be made of it,
            a number of faces that is too small or that the format has no use for, or variants that the format cannot hold.
        OSError: the file cannot be written.
    """
    out = Path(out)
    if format not in EXPORT_FORMATS:
        raise ValueError(f"format {format!r} is unknown; expected {', '.join(EXPORT_FORMATS)}")
    if out.is_dir():
        raise ValueError(f"{out}: is a folder; expected the name of a file")
    if format in ("ply", "ply3", "spz") and asset.gaussians is None:
        raise ValueError(f"format {format!r} needs Gaussians, and this asset has only a mesh; export it as glb")
    refuse_faces(faces, (format,))
    if variants is not None:
        if format not in VARIANT_FORMATS:
            raise ValueError(f"format {format!r} holds no material variants; expected {', '.join(VARIANT_FORMATS)}")
        refuse_variants(variants)
    if format in ("usd", "usdz"):
        refuse_unwritable(out, for_ar=format == "usdz")
    out.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f".{out.stem}.", suffix=out.suffix, dir=out.parent)
    os.close(handle)
    temporary = Path(name)
    left_out = ""
    try:
        if format in TEXTURED_FORMATS:
            mesh = on_cpu(asset.mesh)
            colored = _with_gltf_colors if format in ("glb", "mesh") else _with_usd_colors
            others = [colored(on_cpu(one)) for one in variant_meshes(asset, variants or {})]
            textured = bake_textures(colored(mesh), faces or DEFAULT_FACES, others)
            kept, all_faces = len(textured.mesh.faces), len(asset.mesh.faces)
            left_out = "" if kept == all_faces else f"{kept} of the mesh's {all_faces} faces, the detail of the others in its textures"
            if format == "usd":
                write_usd(temporary, _usd_scene(asset, textured), beside=out)
            elif format == "usdz":
                write_ar_usdz(temporary, _usd_scene(asset, textured))
            else:
                temporary.write_bytes(_textured_glb(asset, textured, [shown, *(variants or ())], with_splats=format == "glb"))
        elif format == "spz":
            splats = _upright_splats(asset)
            wide = int((splats["scales"][:, :2].min(1) < SMALLEST_SCALE).sum())
            left_out = f"{wide} of {len(splats['scales'])} splats wider than they are" if wide else ""
            temporary.write_bytes(encode_spz(splats))
        elif format == "html":
            from drgs.convert.page.encode_page import encode_page  # here: only pages need it

            page = encode_page(asset, dict(zip(variants or (), variant_meshes(asset, variants or {}), strict=True)), shown)
            left_out = "" if page.faces == len(asset.mesh.faces) else f"{page.faces} of the mesh's {len(asset.mesh.faces)} faces"
            temporary.write_bytes(page.html)
        else:
            temporary.write_bytes(_file_bytes(asset, format))
        temporary.chmod(0o644)
        temporary.replace(out)
    finally:
        temporary.unlink(missing_ok=True)
    return left_out


def _file_bytes(asset: Asset, format: str) -> bytes:
    if format == "env":
        return encode_environment(_array(asset.environment.radiance))
    gaussians = asset.gaussians
    assert gaussians is not None
    arrays = {key: _array(values) for key, values in vars(gaussians).items()}
    arrays["sh"] = _array(display_sh(gaussians.sh))
    normals = _array(rotation_from_quat_wxyz(gaussians.quats_wxyz)[..., 2])
    note = "spherical harmonics: sRGB colours under the light of the capture"
    return encode_gaussian_ply(arrays, normals, third_scale=format == "ply3", comments=(note,))


def _textured_glb(asset: Asset, textured: TexturedMesh, names: Sequence[str], with_splats: bool) -> bytes:
    """
    Args:
        names: of the asset as it is, then of the variants.
        with_splats: the Gaussians too, where there are some: 260 bytes each.
    """
    mesh, atlas = textured.mesh, textured.atlas
    normals = torch.nn.functional.normalize(mesh.normals, dim=-1)
    attributes = {"POSITION": _array(mesh.vertices)[atlas.vertex_of], "NORMAL": _array(normals)[atlas.vertex_of], "TEXCOORD_0": atlas.uv}
    images = [encode_png(textured.base_color), encode_png(textured.surface)]
    textures: dict[str, dict] = {}
    if textured.normal is not None and textured.tangents is not None:
        attributes["TANGENT"] = textured.tangents
        textures["normalTexture"] = {"index": len(images)}
        images.append(encode_png(textured.normal))

    def material(base_color: int, surface: int) -> tuple[dict, dict]:
        """By the numbers of its images; occlusion depends on the light that a material throws onto itself, normals do not."""
        factors = {"baseColorTexture": {"index": base_color}, "metallicRoughnessTexture": {"index": surface}, "extras": BASE_COLOR_MARK}
        return factors, {"occlusionTexture": {"index": surface}, **textures}

    others = []
    for name, (base_color, surface) in zip(names[1:], textured.variants, strict=True):
        others.append(GlbVariant(name, *material(len(images), len(images) + 1)))
        images += [encode_png(base_color), encode_png(surface)]
    points = _splat_points(asset.gaussians) if with_splats and asset.gaussians is not None and len(asset.gaussians.centers) else None
    glb = GlbMesh(attributes, atlas.faces, *material(0, 1), tuple(images), names[0] if others else "object", tuple(others))
    return encode_glb(glb, asset.meters_per_unit, points)


def _with_gltf_colors(mesh: TriangleMesh) -> TriangleMesh:
    return replace(mesh, albedo=gltf_base_color(mesh.albedo, mesh.roughness, mesh.metallic))


def _with_usd_colors(mesh: TriangleMesh) -> TriangleMesh:
    return replace(mesh, albedo=usd_base_color(mesh.albedo, mesh.metallic))


def _usd_scene(asset: Asset, textured: TexturedMesh) -> UsdScene:
    mesh = {key: _array(values) for key, values in textured.mesh.columns.items()}
    mesh["normals"] = _array(torch.nn.functional.normalize(textured.mesh.normals, dim=-1))
    textures = {BASE_COLOR: encode_png(textured.base_color), SURFACE: encode_png(textured.surface)}
    if textured.normal is not None:
        textures[NORMAL] = encode_png(textured.normal)
    return UsdScene(
        mesh,
        textured.atlas.uv,
        textured.atlas.faces,
        textures,
        _splat_arrays(asset.gaussians) if asset.gaussians is not None and len(asset.gaussians.centers) else None,
        encode_environment(_array(asset.environment.radiance)),
        asset.meters_per_unit,
    )


def _splat_points(gaussians: Gaussians) -> GlbPoints:
    """In world units."""
    arrays = _splat_arrays(gaussians)
    materials = {"_ALBEDO": arrays["albedo"], "_ROUGHNESS": arrays["roughness"], "_METALLIC": arrays["metallic"]}
    return points_from_splats(
        GltfSplats(
            arrays["centers"],
            arrays["quats_wxyz"][:, [1, 2, 3, 0]],
            arrays["scales"],
            arrays["opacities"],
            arrays["sh"],
            "srgb_rec709_display",
            materials,
        )
    )


def display_sh(sh: Float[Tensor, "surfel 16 3"]) -> Float[Tensor, "surfel 16 3"]:
    """(surfel, 16, 3) coefficients of the sRGB colours of linear radiance sh (surfel, 16, 3), by least squares over directions.

    Both sides without the offset of 0.5; colours above 1 are clipped, as a screen would.
    """
    return map_radiance(sh, lambda radiance: srgb_from_linear(radiance.clamp(0, 1)))


def _splat_arrays(gaussians: Gaussians) -> dict[str, np.ndarray]:
    """Activated: unit quaternions, opacities, and three linear scales, the third as in ply3; harmonics of sRGB colours."""
    thickness = np.exp(log_thickness(_array(gaussians.centers), _array(gaussians.log_scales)))
    scales = np.concatenate([_array(torch.exp(gaussians.log_scales)), thickness[:, None]], -1, dtype=np.float32)
    tensors = {
        "centers": gaussians.centers,
        "quats_wxyz": torch.nn.functional.normalize(gaussians.quats_wxyz, dim=-1),
        "opacities": torch.sigmoid(gaussians.opacity_logits),
        "sh": display_sh(gaussians.sh),
        "albedo": gaussians.albedo,
        "roughness": gaussians.roughness,
        "metallic": gaussians.metallic,
    }
    return {"scales": scales} | {key: _array(values) for key, values in tensors.items()}


def _upright_splats(asset: Asset) -> dict[str, np.ndarray]:
    """`_splat_arrays` with y up and in metres."""
    gaussians = asset.gaussians
    assert gaussians is not None
    upright, arrays = _UPRIGHT_FROM_WORLD, _splat_arrays(gaussians)
    turned = {
        "centers": asset.meters_per_unit * gaussians.centers.double() @ upright.T,
        "quats_wxyz": quat_wxyz_from_rotation(upright @ rotation_from_quat_wxyz(gaussians.quats_wxyz.double())),
        "sh": rotate_sh(torch.from_numpy(arrays["sh"]), upright),
    }
    return arrays | {key: _array(values) for key, values in turned.items()} | {"scales": asset.meters_per_unit * arrays["scales"]}


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().cpu().contiguous().numpy()
