"""OpenUSD: the mesh with its materials, and the surfels as a particle field of Gaussian surflets.

In: plain numpy arrays. Out: a .usd, .usda, .usdc file. Needs the optional package usd-core (26 or newer).
Source: OpenUSD 26 UsdVol, ParticleFieldKernelGaussianSurfletAPI: an exact 2D Gaussian disk, linear scales, activated opacity.
"""

import re
from pathlib import Path
from typing import Any

import numpy as np

from drgs.installation import missing_package


def write_usd(path: Path, mesh: dict[str, np.ndarray], surfels: dict[str, np.ndarray] | None, meters_per_unit: float) -> None:
    """Write one stage, z up.

    Args:
        mesh: vertices (v, 3), faces (f, 3), normals (v, 3), albedo (v, 3), roughness (v), metallic (v).
        surfels: centers (n, 3), scales (n, 2), quats_wxyz (n, 4), opacities (n), sh (n, 16, 3), albedo (n, 3), roughness (n), metallic (n).

    Raises:
        ValueError: usd-core is not installed, or the name does not end in .usd, .usda or .usdc.
        OSError: the file cannot be written, such as on a full disk.
    """
    if path.suffix not in (".usd", ".usda", ".usdc"):
        raise ValueError(f"{path}: expected a name ending in .usd, .usda or .usdc")
    try:
        from pxr import Tf, Usd, UsdGeom, UsdShade, UsdVol
    except ImportError as error:
        raise ValueError(missing_package("writing USD", "usd-core", "usd")) from error
    if not hasattr(UsdVol, "ParticleFieldKernelGaussianSurfletAPI"):
        version = ".".join(map(str, Usd.GetVersion()))
        raise ValueError(missing_package(f"usd-core {version} has no particle fields: writing USD", "usd-core 26.5 or newer", "usd"))

    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, meters_per_unit)
    root = UsdGeom.Xform.Define(stage, "/object")
    stage.SetDefaultPrim(root.GetPrim())
    surface = _define_mesh(stage, mesh)
    material = _define_material(stage)
    UsdShade.MaterialBindingAPI.Apply(surface.GetPrim()).Bind(material)
    if surfels is not None:
        _define_surfels(stage, surfels)
    try:
        written = stage.Export(str(path))
    except Tf.ErrorException as error:  # hundreds of lines where a disk is full, each with the reason in quotes
        reason = re.search(r"'([^']*)'\s*$", str(error), re.MULTILINE)
        raise OSError(f"the USD file could not be written: {reason[1] if reason else error}") from error
    if not written:
        raise OSError("the USD file could not be written: usd-core gives no reason")


def _floats(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values, np.float32)


def _define_mesh(stage: Any, mesh: dict[str, np.ndarray]) -> Any:
    """/object/mesh, its materials as primvars."""
    from pxr import UsdGeom, Vt

    surface = UsdGeom.Mesh.Define(stage, "/object/mesh")
    surface.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(_floats(mesh["vertices"])))
    surface.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(mesh["faces"].reshape(-1), np.int32)))
    surface.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(mesh["faces"]), 3, np.int32)))
    surface.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(_floats(mesh["normals"])))
    surface.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    surface.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    surface.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(_floats(np.stack([mesh["vertices"].min(0), mesh["vertices"].max(0)]))))
    _set_materials(surface, mesh, "displayColor")
    return surface


def _set_materials(prim: Any, values: dict[str, np.ndarray], albedo: str) -> None:
    """albedo, roughness and metallic as primvars of a mesh's vertices or of surfels; `albedo` names the first."""
    from pxr import Sdf, UsdGeom, Vt

    primvars = UsdGeom.PrimvarsAPI(prim)
    color = primvars.CreatePrimvar(albedo, Sdf.ValueTypeNames.Color3fArray, UsdGeom.Tokens.vertex)
    color.Set(Vt.Vec3fArray.FromNumpy(_floats(values["albedo"])))
    for name in ("roughness", "metallic"):
        primvar = primvars.CreatePrimvar(f"drgs:{name}", Sdf.ValueTypeNames.FloatArray, UsdGeom.Tokens.vertex)
        primvar.Set(Vt.FloatArray.FromNumpy(_floats(values[name])))


def _define_material(stage: Any) -> Any:
    """/object/material: a preview surface that reads the mesh's primvars."""
    from pxr import Sdf, UsdShade

    material = UsdShade.Material.Define(stage, "/object/material")
    shader = UsdShade.Shader.Define(stage, "/object/material/surface")
    shader.CreateIdAttr("UsdPreviewSurface")
    readers = {
        "diffuseColor": ("displayColor", "float3", "Float3"),
        "roughness": ("drgs:roughness", "float", "Float"),
        "metallic": ("drgs:metallic", "float", "Float"),
    }
    for target, (primvar, kind, value_type) in readers.items():
        reader = UsdShade.Shader.Define(stage, f"/object/material/{target}")
        reader.CreateIdAttr(f"UsdPrimvarReader_{kind}")
        reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set(primvar)
        output = reader.CreateOutput("result", getattr(Sdf.ValueTypeNames, value_type))
        wanted = Sdf.ValueTypeNames.Color3f if target == "diffuseColor" else Sdf.ValueTypeNames.Float
        shader.CreateInput(target, wanted).ConnectToSource(output)
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    return material


def _define_surfels(stage: Any, surfels: dict[str, np.ndarray]) -> None:
    """/object/surfels: a particle field."""
    from pxr import Gf, UsdVol, Vt

    field = UsdVol.ParticleField.Define(stage, "/object/surfels")
    prim = field.GetPrim()
    UsdVol.ParticleFieldKernelGaussianSurfletAPI.Apply(prim)
    UsdVol.ParticleFieldPositionAttributeAPI.Apply(prim).CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(_floats(surfels["centers"])))
    orientations = Vt.QuatfArray([Gf.Quatf(float(w), float(x), float(y), float(z)) for w, x, y, z in surfels["quats_wxyz"]])
    UsdVol.ParticleFieldOrientationAttributeAPI.Apply(prim).CreateOrientationsAttr(orientations)
    scales = np.concatenate([surfels["scales"], np.ones((len(surfels["scales"]), 1))], -1)  # the disk has no third axis
    UsdVol.ParticleFieldScaleAttributeAPI.Apply(prim).CreateScalesAttr(Vt.Vec3fArray.FromNumpy(_floats(scales)))
    UsdVol.ParticleFieldOpacityAttributeAPI.Apply(prim).CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(_floats(surfels["opacities"])))
    radiance = UsdVol.ParticleFieldSphericalHarmonicsAttributeAPI.Apply(prim)
    radiance.CreateRadianceSphericalHarmonicsDegreeAttr(3)
    radiance.CreateRadianceSphericalHarmonicsCoefficientsAttr(Vt.Vec3fArray.FromNumpy(_floats(surfels["sh"].reshape(-1, 3))))
    reach = 3 * surfels["scales"].max() if len(surfels["scales"]) else 0.0
    extent = np.stack([surfels["centers"].min(0) - reach, surfels["centers"].max(0) + reach])
    field.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(_floats(extent)))
    _set_materials(prim, surfels, "drgs:albedo")
