"""A stage of ours is what OpenUSD says, and says of the object what it is."""

import io
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from drgs.convert import bake_transfer
from drgs.convert.export_asset import display_sh, export_asset
from drgs.convert.gltf_reflectance import usd_base_color
from drgs.exchange.exr import decode_environment
from drgs.exchange.gaussian_ply import FLAT_ENOUGH
from drgs.exchange.usd import BASE_COLOR, ENVIRONMENT, SURFACE
from drgs.maths.color import srgb_from_linear
from drgs.scene.asset import Asset
from drgs.scene.environment import uv_from_direction
from tests.convert.test_export_asset import ball_asset

pxr = pytest.importorskip("pxr", reason="the optional package usd-core is not installed")

AR_PRIM_TYPES = {"Xform", "Mesh", "Material", "Shader"}
"""Of those that `usdchecker --arkit` allowed while it had a list of them."""


def findings(path: Path) -> list[str]:
    """What all of OpenUSD's validators say, those for packages among them; `usdchecker --arkit` asks the same ones."""
    from pxr import Usd, UsdValidation

    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert {"usdUtilsValidators:UsdzPackageValidator", "usdShadeValidators:ShaderSdrCompliance"} <= {
        validator.GetMetadata().name for validator in validators
    }
    stage = Usd.Stage.Open(str(path))
    said = UsdValidation.ValidationContext(validators).Validate(stage)
    for prim in stage.Traverse():
        for name in prim.GetVariantSets().GetNames():
            for variant in prim.GetVariantSet(name).GetVariantNames():
                prim.GetVariantSet(name).SetVariantSelection(variant)
                said += UsdValidation.ValidationContext(validators).Validate(stage)
    return [error.GetErrorAsString() for error in said]


def opened(path: Path):
    from pxr import Usd

    return Usd.Stage.Open(str(path))


def picture(stage, reader: str) -> bytes:
    """The file that a texture node names, found as USD finds it, in the package or beside the layer."""
    from pxr import Ar

    asset = stage.GetPrimAtPath(f"/object/material/{reader}").GetAttribute("inputs:file").Get()
    return bytes(Ar.GetResolver().OpenAsset(Ar.ResolvedPath(asset.resolvedPath)).GetBuffer())


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("usd")
    asset = ball_asset()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bake_transfer, "DIRECTIONS", 16)  # how finely shadows are baked is not asked here
        export_asset(asset, folder / "ar.usdz", "usdz")
        export_asset(asset, folder / "small.usdz", "usd", faces=300)
        for name in ("scene.usdz", "scene.usda", "scene.usdc"):
            export_asset(asset, folder / name, "usd")
    return folder


@pytest.mark.slow
def test_files_beside_a_layer_are_its_pictures_and_nothing_else_is_left(folder):
    assert {path.name for path in folder.iterdir()} == {"ar.usdz", "small.usdz", "scene.usdz", "scene.usda", "scene.usdc", "scene_textures"}
    assert {path.name for path in (folder / "scene_textures").iterdir()} == {BASE_COLOR, SURFACE, ENVIRONMENT}


@pytest.mark.parametrize("name", ["ar.usdz", "small.usdz", "scene.usdz", "scene.usda", "scene.usdc"])
def test_no_validator_finds_a_fault(folder, name):
    assert findings(folder / name) == []


def test_validators_find_what_is_wrong(folder, tmp_path):
    with zipfile.ZipFile(folder / "ar.usdz") as whole, zipfile.ZipFile(tmp_path / "packed.usdz", "w") as packed:
        first, *others = whole.namelist()
        packed.writestr(first, whole.read(first))
        for name in others[:-1]:
            packed.writestr(name, whole.read(name), zipfile.ZIP_DEFLATED)
    said = " ".join(findings(tmp_path / "packed.usdz"))
    assert all(word in said for word in ("compression", "offset", others[-1])), "packed, not aligned, and without a picture"


def test_the_package_for_ar_has_what_such_viewers_take_and_no_more(folder):
    """The rules for ARKit of usdchecker up to 25.11, of which 26 has a validator for none: kinds of prims and files, upright, one binary layer."""
    from pxr import UsdGeom

    stage = opened(folder / "ar.usdz")
    assert UsdGeom.GetStageUpAxis(stage) == "Y" and UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert {prim.GetTypeName() for prim in stage.Traverse()} <= AR_PRIM_TYPES
    with zipfile.ZipFile(folder / "ar.usdz") as package:
        entries = package.infolist()
    assert entries[0].filename == "object.usdc" and {entry.filename for entry in entries[1:]} == {
        f"textures/{BASE_COLOR}",
        f"textures/{SURFACE}",
    }
    assert all(entry.compress_type == zipfile.ZIP_STORED for entry in entries)


def test_the_object_for_ar_stands_on_the_ground_in_metres(folder):
    from pxr import Usd, UsdGeom

    asset, stage = ball_asset(), opened(folder / "ar.usdz")
    surface = UsdGeom.Mesh.Get(stage, "/object/mesh")
    points = np.array(surface.GetPointsAttr().Get())
    assert np.allclose(points, 0.5 * asset.mesh.vertices.numpy()[:, [0, 2, 1]] * [1, 1, -1], atol=1e-6)
    assert np.array_equal(np.array(surface.GetFaceVertexIndicesAttr().Get()), asset.mesh.faces.numpy().reshape(-1))
    normals = np.array(surface.GetNormalsAttr().Get())
    outwards = points - points.mean(0)
    assert ((normals * outwards).sum(1) > 0.99 * np.linalg.norm(outwards, axis=1)).all()
    shown = UsdGeom.BBoxCache(Usd.TimeCode.Default(), ["default"]).ComputeWorldBound(stage.GetDefaultPrim()).ComputeAlignedRange()
    assert np.allclose([shown.GetMin(), shown.GetMax()], [[-0.5, 0, -0.5], [0.5, 1, 0.5]], atol=1e-3)


def base_colors(asset: Asset) -> torch.Tensor:
    """As UsdPreviewSurface wants them."""
    return usd_base_color(asset.mesh.albedo, asset.mesh.metallic)


def test_the_textures_are_bound_with_their_colour_spaces_and_hold_the_materials(folder):
    from pxr import UsdGeom, UsdShade

    asset = ball_asset()
    for name in ("ar.usdz", "scene.usdz", "scene.usda"):
        stage = opened(folder / name)
        surface = UsdGeom.Mesh.Get(stage, "/object/mesh")
        material = UsdShade.MaterialBindingAPI(surface).ComputeBoundMaterial()[0]
        shader = material.ComputeSurfaceSource()[0]
        sources = {}
        for target in ("diffuseColor", "occlusion", "roughness", "metallic"):
            source = shader.GetInput(target).GetConnectedSources()[0][0]
            texture = UsdShade.Shader(source.source.GetPrim())
            sources[target] = (texture.GetPath().name, source.sourceName, texture.GetInput("sourceColorSpace").Get())
        assert sources == {
            "diffuseColor": ("base_color", "rgb", "sRGB"),
            "occlusion": ("occlusion_roughness_metallic", "r", "raw"),
            "roughness": ("occlusion_roughness_metallic", "g", "raw"),
            "metallic": ("occlusion_roughness_metallic", "b", "raw"),
        }
        assert not shader.GetInput("normal"), "no face was left out"
        st = UsdGeom.PrimvarsAPI(surface).GetPrimvar("st")
        assert st.GetInterpolation() == UsdGeom.Tokens.faceVarying
        corners = np.array(st.ComputeFlattened())
        pictures = {
            reader: np.asarray(Image.open(io.BytesIO(picture(stage, reader)))) for reader in ("base_color", "occlusion_roughness_metallic")
        }
        faces = asset.mesh.faces.long()
        colors = srgb_from_linear(base_colors(asset))[faces].reshape(-1, 3).numpy()
        others = torch.stack([asset.mesh.roughness, asset.mesh.metallic], -1)[faces].reshape(-1, 2).numpy()
        assert np.abs(lookup(pictures["base_color"], corners) - colors).max() < 0.05
        found = lookup(pictures["occlusion_roughness_metallic"], corners)
        assert np.abs(found[:, 1:] - others).max() < 0.05 and found[:, 0].min() > 0.98, "and a ball is open"


def test_a_smaller_mesh_has_a_picture_of_normals_that_readers_bring_to_signed_numbers(folder):
    from pxr import UsdGeom, UsdShade

    stage = opened(folder / "small.usdz")
    assert 100 < len(UsdGeom.Mesh.Get(stage, "/object/mesh").GetFaceVertexCountsAttr().Get()) <= 300
    material = UsdShade.Material.Get(stage, "/object/material")
    source = material.ComputeSurfaceSource()[0].GetInput("normal").GetConnectedSources()[0][0]
    texture = UsdShade.Shader(source.source.GetPrim())
    scale, bias = (np.array(texture.GetInput(name).Get())[:3] for name in ("scale", "bias"))
    assert (source.sourceName, texture.GetInput("sourceColorSpace").Get()) == ("rgb", "raw")
    normals = np.asarray(Image.open(io.BytesIO(picture(stage, "normal")))) / 255 * scale + bias
    assert np.abs(np.linalg.norm(normals, axis=-1) - 1).max() < 0.02 and normals[..., 2].mean() > 0.98


def lookup(pixels: np.ndarray, st: np.ndarray) -> np.ndarray:
    """The nearest texel, 0..1, at places whose second number runs upwards."""
    height, width, _ = pixels.shape
    columns = np.clip(st[:, 0] * width, 0, width - 1).astype(int)
    return pixels[np.clip((1 - st[:, 1]) * height, 0, height - 1).astype(int), columns] / 255


def test_the_scene_keeps_world_units_the_mesh_and_its_materials_at_vertices(folder):
    from pxr import UsdGeom

    asset, stage = ball_asset(), opened(folder / "scene.usda")
    assert UsdGeom.GetStageUpAxis(stage) == "Z" and UsdGeom.GetStageMetersPerUnit(stage) == 0.5
    surface = UsdGeom.Mesh.Get(stage, "/object/mesh")
    assert np.array_equal(np.array(surface.GetPointsAttr().Get()), asset.mesh.vertices.numpy())
    primvars = UsdGeom.PrimvarsAPI(surface)
    for name, given in {
        "displayColor": base_colors(asset),
        "drgs:roughness": asset.mesh.roughness,
        "drgs:metallic": asset.mesh.metallic,
    }.items():
        assert np.array_equal(np.array(primvars.GetPrimvar(name).Get()), given.numpy()), name


@pytest.mark.parametrize("name", ["scene.usdz", "scene.usda", "scene.usdc"])
def test_the_gaussians_are_splats_of_the_schema(folder, name):
    from pxr import Gf, Usd, UsdGeom, UsdVol

    given = ball_asset().gaussians
    assert given is not None
    stage = opened(folder / name)
    splats = UsdVol.ParticleField3DGaussianSplat.Get(stage, "/object/splats")
    assert np.array_equal(np.array(splats.GetPositionsAttr().Get()), given.centers.numpy())
    scales = np.array(splats.GetScalesAttr().Get())
    assert np.allclose(scales[:, :2], torch.exp(given.log_scales), rtol=1e-6)
    assert (scales[:, 2] > 0).all() and (scales[:, 2] < FLAT_ENOUGH * scales[:, :2].min(1)).all(), "flat along the third axis, the normal"
    found = np.array([(q.GetReal(), *q.GetImaginary()) for q in splats.GetOrientationsAttr().Get()])
    assert np.allclose(found, torch.nn.functional.normalize(given.quats_wxyz, dim=-1), atol=1e-6)
    assert np.allclose(np.array(splats.GetOpacitiesAttr().Get()), torch.sigmoid(given.opacity_logits), atol=1e-6)
    sh = np.array(splats.GetRadianceSphericalHarmonicsCoefficientsAttr().Get()).reshape(-1, 16, 3)
    assert splats.GetRadianceSphericalHarmonicsDegreeAttr().Get() == 3 and np.allclose(sh, display_sh(given.sh), atol=1e-6)
    assert Usd.ColorSpaceAPI(splats.GetPrim()).GetColorSpaceNameAttr().Get() == Gf.ColorSpaceNames.SRGBRec709
    albedo = UsdGeom.PrimvarsAPI(splats).GetPrimvar("drgs:albedo")
    assert np.array_equal(np.array(albedo.Get()), given.albedo.numpy())
    low, high = np.array(splats.GetExtentAttr().Get())
    assert (low < given.centers.numpy().min(0)).all() and (high > given.centers.numpy().max(0)).all()


def test_one_of_mesh_and_splats_is_shown_and_the_mesh_first(folder):
    from pxr import UsdGeom

    stage = opened(folder / "scene.usda")
    choice = stage.GetDefaultPrim().GetVariantSet("shows")
    assert choice.GetVariantSelection() == "mesh"

    def shown() -> set[str]:
        prims = (stage.GetPrimAtPath(f"/object/{name}") for name in ("mesh", "splats"))
        return {prim.GetName() for prim in prims if UsdGeom.Imageable(prim).ComputeVisibility() == UsdGeom.Tokens.inherited}

    assert shown() == {"mesh"}
    choice.SetVariantSelection("splats")
    assert shown() == {"splats"}


@pytest.mark.parametrize("name", ["scene.usdz", "scene.usda"])
def test_the_dome_shines_from_where_the_environment_does(folder, name):
    """By OpenEXR's words for such pictures, which USD refers to: the left edge has longitude pi and the upper one latitude pi/2; latitude 0 and
    longitude 0 point along z, longitude pi/2 along x, latitude pi/2 along y, in the light's own frame."""
    from pxr import Ar, Gf, Usd, UsdGeom, UsdLux

    stage = opened(folder / name)
    dome = UsdLux.DomeLight.Get(stage, "/light")
    assert dome.GetTextureFormatAttr().Get() == "latlong" and dome.GetIntensityAttr().Get() == 1.0
    data = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(dome.GetTextureFileAttr().Get().resolvedPath)).GetBuffer()
    given = ball_asset().environment
    assert np.array_equal(decode_environment(bytes(data)), given.radiance.numpy())
    place = UsdGeom.Xformable(dome).ComputeLocalToWorldTransform(Usd.TimeCode.Default())
    directions = torch.nn.functional.normalize(torch.randn(20, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)), dim=-1)
    directions = torch.cat([torch.eye(3, dtype=torch.float64), -torch.eye(3, dtype=torch.float64)[2:], directions])
    for direction in directions:
        x, y, z = place.GetInverse().TransformDir(Gf.Vec3d(*direction.tolist()))
        longitude, latitude = np.arctan2(x, z), np.arcsin(np.clip(y, -1, 1))
        found = np.array([(np.pi - longitude) / (2 * np.pi), (np.pi / 2 - latitude) / np.pi])
        ours = uv_from_direction(direction).numpy()
        assert np.abs(found[1] - ours[1]) < 1e-6
        if abs(y) < 1 - 1e-9:
            assert abs((found[0] - ours[0] + 0.5) % 1 - 0.5) < 1e-6


@pytest.mark.slow
def test_an_asset_without_gaussians_has_mesh_and_light(tmp_path):

    export_asset(replace(ball_asset(), gaussians=None), tmp_path / "a.usdc", "usd")
    stage = opened(tmp_path / "a.usdc")
    assert {prim.GetTypeName() for prim in stage.Traverse()} == {"Xform", "Mesh", "Material", "Shader", "DomeLight"}
    assert findings(tmp_path / "a.usdc") == []
