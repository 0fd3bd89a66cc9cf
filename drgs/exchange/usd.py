"""OpenUSD: the mesh with textures, the Gaussians as splats, and the light as a dome.

In: plain numpy arrays and encoded pictures. Out: `write_usd` writes all of it, z up, in world units: a package (.usdz), or a layer (.usd,
.usda, .usdc) with its pictures in a folder beside it. `write_ar_usdz` writes a package of the textured mesh alone, y up, in metres.
Both need the optional package usd-core (26 or newer).
Source: OpenUSD 26: UsdPreviewSurface, UsdLux DomeLight, UsdVol ParticleField3DGaussianSplat (linear scales, activated opacities); for the
second package what `usdchecker --arkit` asks for.
"""

import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drgs.installation import missing_package

LAYERS = (".usd", ".usda", ".usdc")
BASE_COLOR, SURFACE, NORMAL, ENVIRONMENT = "base_color.png", "occlusion_roughness_metallic.png", "normal.png", "environment.exr"
_ROOT = "/object"
_TEXTURED = (
    (BASE_COLOR, "sRGB", {"diffuseColor": "rgb"}),
    (SURFACE, "raw", {"occlusion": "r", "roughness": "g", "metallic": "b"}),
    (NORMAL, "raw", {"normal": "rgb"}),
)
"""A picture, its colour space, and which inputs of the preview surface read which of its channels."""
_REACH = 3.0
"""Standard deviations of a splat that count for its extent."""
WORLD_FROM_DOME = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""A dome has its pole along its own y, and its picture's middle along z, with x to the left of it; our environments (z up) have it along x."""


@dataclass(frozen=True, eq=False)
class UsdScene:
    """What a file holds."""

    mesh: dict[str, np.ndarray]
    """vertices (v, 3), faces (f, 3), normals (v, 3), albedo (v, 3), roughness (v), metallic (v)."""
    uv: np.ndarray
    """(corner, 2) places in the pictures, v down."""
    uv_faces: np.ndarray
    """(f, 3) into uv."""
    textures: dict[str, bytes]
    """BASE_COLOR: sRGB; SURFACE: occlusion in red, roughness in green, metallic in blue; NORMAL, where there is one: 255 (n + 1) / 2 along
    s, along t and outwards."""
    splats: dict[str, np.ndarray] | None
    """centers (n, 3), scales (n, 3), quats_wxyz (n, 4), opacities (n), sh (n, 16, 3) of sRGB colours, albedo (n, 3), roughness (n), metallic (n)."""
    environment: bytes
    """EXR, lat-long, as scene.environment has it."""
    meters_per_unit: float


def write_usd(path: Path, scene: UsdScene, beside: Path | None = None) -> None:
    """Write mesh, splats and light.

    Args:
        beside: the layer's final name, where `path` is a draft of it; its pictures go into the folder of that name and `_textures`.

    Raises:
        ValueError: usd-core is not installed or too old, or the name does not end in .usd, .usda, .usdc or .usdz.
        OSError: a file cannot be written, such as on a full disk.
    """
    refuse_unwritable(path, for_ar=False)
    pictures = scene.textures | {ENVIRONMENT: scene.environment}
    if path.suffix == ".usdz":
        _write_package(path, lambda folder: _scene_stage(scene, folder), pictures)
        return
    folder = (beside or path).with_name(f"{(beside or path).stem}_textures")
    with tempfile.TemporaryDirectory(prefix=f".{folder.name}.", dir=folder.parent) as draft, _as_os_errors():
        for name, data in pictures.items():
            (Path(draft) / name).write_bytes(data)
        _save(_scene_stage(scene, folder.name), path)
        folder.mkdir(exist_ok=True)
        for name in pictures:
            (Path(draft) / name).replace(folder / name)


def write_ar_usdz(path: Path, scene: UsdScene) -> None:
    """Write the textured mesh alone, as viewers of augmented reality want it: standing on the ground, y up, in metres.

    Raises:
        ValueError: usd-core is not installed, or the name does not end in .usdz.
        OSError: the file cannot be written, such as on a full disk.
    """
    refuse_unwritable(path, for_ar=True)
    _write_package(path, lambda folder: _ar_stage(scene, folder), scene.textures)


def refuse_unwritable(path: Path, for_ar: bool) -> None:
    """What writing would refuse of a name and of this machine, before anything is made ready for it.

    Raises:
        ValueError: as write_ar_usdz and write_usd.
    """
    endings = (".usdz",) if for_ar else (*LAYERS, ".usdz")
    if path.suffix not in endings:
        raise ValueError(f"{path}: expected a name ending in {', '.join(endings)}")
    if for_ar:
        _refuse_without_usd()
    else:
        _refuse_without_particle_fields()


def _refuse_without_usd() -> None:
    try:
        import pxr.Usd  # noqa: F401
    except ImportError as error:
        raise ValueError(missing_package("writing USD", "usd-core", "usd")) from error


def _refuse_without_particle_fields() -> None:
    _refuse_without_usd()
    from pxr import Usd, UsdVol

    if not hasattr(UsdVol, "ParticleField3DGaussianSplat"):
        version = ".".join(map(str, Usd.GetVersion()))
        raise ValueError(missing_package(f"usd-core {version} has no splats: writing USD", "usd-core 26.5 or newer", "usd"))


def _scene_stage(scene: UsdScene, folder: str) -> Any:
    """Everything; `folder` is where the pictures are, seen from the layer."""
    from pxr import UsdGeom

    stage, root = _new_stage(UsdGeom.Tokens.z, scene.meters_per_unit)
    mesh = _define_mesh(stage, scene, scene.mesh["vertices"], scene.mesh["normals"], folder)
    _set_materials(mesh, scene.mesh, "displayColor")
    _define_dome(stage, f"./{folder}/{ENVIRONMENT}")
    if scene.splats is not None:
        splats = _define_splats(stage, scene.splats)
        _choose_between(root, {"mesh": mesh, "splats": splats})
    return stage


def _ar_stage(scene: UsdScene, folder: str) -> Any:
    from pxr import Gf, UsdGeom

    stage, root = _new_stage(UsdGeom.Tokens.y, 1.0)
    vertices, normals = (
        np.stack([array[:, 0], array[:, 2], -array[:, 1]], -1) for array in (scene.mesh["vertices"], scene.mesh["normals"])
    )
    vertices = vertices * np.float32(scene.meters_per_unit)
    low, high = vertices.min(0).astype(float), vertices.max(0).astype(float)
    # Such viewers put the origin where the user points at the floor.
    stands = Gf.Vec3d(-(low[0] + high[0]) / 2, -low[1], -(low[2] + high[2]) / 2)
    root.AddTranslateOp().Set(stands)
    _define_mesh(stage, scene, vertices, normals, folder)
    return stage


def _new_stage(up: Any, meters_per_unit: float) -> tuple[Any, Any]:
    from pxr import Kind, Usd, UsdGeom

    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, up)
    UsdGeom.SetStageMetersPerUnit(stage, meters_per_unit)
    root = UsdGeom.Xform.Define(stage, _ROOT)
    Usd.ModelAPI(root).SetKind(Kind.Tokens.component)
    stage.SetDefaultPrim(root.GetPrim())
    return stage, root


@contextmanager
def _as_os_errors() -> Iterator[None]:
    from pxr import Tf

    try:
        yield
    except Tf.ErrorException as error:  # hundreds of lines where a disk is full, each with the reason in quotes
        reason = re.search(r"'([^']*)'\s*$", str(error), re.MULTILINE)
        raise OSError(f"the USD file could not be written: {reason[1] if reason else error}") from error


def _save(stage: Any, path: Path) -> None:
    # The layer and not the stage: that would look for the pictures, and write where it found them.
    if not stage.GetRootLayer().Export(str(path)):
        raise OSError("the USD file could not be written: usd-core gives no reason")


def _write_package(path: Path, stage_of: Any, pictures: dict[str, bytes]) -> None:
    """A zip of the layer and its pictures, none of them compressed, each aligned as the format demands."""
    from pxr import Sdf, UsdUtils

    with tempfile.TemporaryDirectory(prefix=f".{path.stem}.", dir=path.parent) as name, _as_os_errors():
        folder = Path(name)
        (folder / "textures").mkdir()
        for picture, data in pictures.items():
            (folder / "textures" / picture).write_bytes(data)
        layer = folder / "object.usdc"
        _save(stage_of("textures"), layer)
        # usd-core wants to make the file itself.
        package = folder / "package.usdz"
        if not UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(layer)), str(package)):
            raise OSError("the USD package could not be written: usd-core gives no reason")
        package.replace(path)


def _floats(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values, np.float32)


def _define_mesh(stage: Any, scene: UsdScene, vertices: np.ndarray, normals: np.ndarray, folder: str) -> Any:
    """The mesh with texture coordinates at its corners, its material bound."""
    from pxr import Sdf, UsdGeom, UsdShade, Vt

    faces = scene.mesh["faces"]
    surface = UsdGeom.Mesh.Define(stage, f"{_ROOT}/mesh")
    surface.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(_floats(vertices)))
    surface.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(faces.reshape(-1), np.int32)))
    surface.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
    surface.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(_floats(normals)))
    surface.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    surface.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    surface.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(_floats(np.stack([vertices.min(0), vertices.max(0)]))))
    st = UsdGeom.PrimvarsAPI(surface).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying)
    upwards = np.stack([scene.uv[:, 0], 1 - scene.uv[:, 1]], -1)
    st.Set(Vt.Vec2fArray.FromNumpy(_floats(upwards)))
    st.SetIndices(Vt.IntArray.FromNumpy(np.ascontiguousarray(scene.uv_faces.reshape(-1), np.int32)))
    UsdShade.MaterialBindingAPI.Apply(surface.GetPrim()).Bind(_define_material(stage, folder, set(scene.textures)))
    return surface


def _set_materials(prim: Any, values: dict[str, np.ndarray], albedo: str) -> None:
    """albedo, roughness and metallic as primvars of a mesh's vertices or of splats; `albedo` names the first."""
    from pxr import Sdf, UsdGeom, Vt

    primvars = UsdGeom.PrimvarsAPI(prim)
    color = primvars.CreatePrimvar(albedo, Sdf.ValueTypeNames.Color3fArray, UsdGeom.Tokens.vertex)
    color.Set(Vt.Vec3fArray.FromNumpy(_floats(values["albedo"])))
    for name in ("roughness", "metallic"):
        primvar = primvars.CreatePrimvar(f"drgs:{name}", Sdf.ValueTypeNames.FloatArray, UsdGeom.Tokens.vertex)
        primvar.Set(Vt.FloatArray.FromNumpy(_floats(values[name])))


def _define_material(stage: Any, folder: str, pictures: set[str]) -> Any:
    """A preview surface that reads the textures."""
    from pxr import Gf, Sdf, UsdShade

    types = Sdf.ValueTypeNames
    material = UsdShade.Material.Define(stage, f"{_ROOT}/material")
    surface = UsdShade.Shader.Define(stage, f"{_ROOT}/material/surface")
    surface.CreateIdAttr("UsdPreviewSurface")
    corners = UsdShade.Shader.Define(stage, f"{_ROOT}/material/st")
    corners.CreateIdAttr("UsdPrimvarReader_float2")
    corners.CreateInput("varname", types.String).Set("st")
    place = corners.CreateOutput("result", types.Float2)
    kinds = {"diffuseColor": types.Color3f, "normal": types.Normal3f}
    for picture, space, targets in _TEXTURED:
        if picture not in pictures:
            continue
        texture = UsdShade.Shader.Define(stage, f"{_ROOT}/material/{Path(picture).stem}")
        texture.CreateIdAttr("UsdUVTexture")
        texture.CreateInput("file", types.Asset).Set(f"./{folder}/{picture}")
        texture.CreateInput("sourceColorSpace", types.Token).Set(space)
        texture.CreateInput("st", types.Float2).ConnectToSource(place)
        for axis in "ST":
            texture.CreateInput(f"wrap{axis}", types.Token).Set("clamp")
        if picture == NORMAL:
            texture.CreateInput("scale", types.Float4).Set(Gf.Vec4f(2, 2, 2, 1))
            texture.CreateInput("bias", types.Float4).Set(Gf.Vec4f(-1, -1, -1, 0))
        for target, channels in targets.items():
            output = texture.CreateOutput(channels, types.Float3 if channels == "rgb" else types.Float)
            surface.CreateInput(target, kinds.get(target, types.Float)).ConnectToSource(output)
    material.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
    return material


def _define_dome(stage: Any, picture: str) -> None:
    """/light, no part of the object: who refers to the file in a scene of his own brings his own light."""
    from pxr import Gf, UsdLux

    dome = UsdLux.DomeLight.Define(stage, "/light")
    dome.CreateTextureFileAttr(picture)
    dome.CreateTextureFormatAttr(UsdLux.Tokens.latlong)
    matrix = np.eye(4)
    matrix[:3, :3] = WORLD_FROM_DOME.T  # USD multiplies rows from the left
    dome.AddTransformOp().Set(Gf.Matrix4d(*matrix.reshape(-1).tolist()))


def _define_splats(stage: Any, splats: dict[str, np.ndarray]) -> Any:
    from pxr import Gf, Usd, UsdVol, Vt

    field = UsdVol.ParticleField3DGaussianSplat.Define(stage, f"{_ROOT}/splats")
    field.CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(_floats(splats["centers"])))
    field.CreateOrientationsAttr(Vt.QuatfArray.FromNumpy(_floats(splats["quats_wxyz"][:, [1, 2, 3, 0]])))  # x y z w in its memory
    field.CreateScalesAttr(Vt.Vec3fArray.FromNumpy(_floats(splats["scales"])))
    field.CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(_floats(splats["opacities"])))
    field.CreateRadianceSphericalHarmonicsDegreeAttr(3)
    field.CreateRadianceSphericalHarmonicsCoefficientsAttr(Vt.Vec3fArray.FromNumpy(_floats(splats["sh"].reshape(-1, 3))))
    Usd.ColorSpaceAPI.Apply(field.GetPrim()).CreateColorSpaceNameAttr(Gf.ColorSpaceNames.SRGBRec709)
    reach = _REACH * splats["scales"].max(initial=0)
    extent = np.stack([splats["centers"].min(0) - reach, splats["centers"].max(0) + reach])
    field.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(_floats(extent)))
    _set_materials(field.GetPrim(), splats, "drgs:albedo")
    return field


def _choose_between(root: Any, shown: dict[str, Any]) -> None:
    """A variant set `shows` of which each variant hides all but one; the first is chosen."""
    from pxr import UsdGeom

    variants = root.GetPrim().GetVariantSets().AddVariantSet("shows")
    for name in shown:
        variants.AddVariant(name)
        variants.SetVariantSelection(name)
        with variants.GetVariantEditContext():
            for other, prim in shown.items():
                if other != name:
                    UsdGeom.Imageable(prim).CreateVisibilityAttr(UsdGeom.Tokens.invisible)
    variants.SetVariantSelection(next(iter(shown)))
