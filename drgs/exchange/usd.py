"""OpenUSD: the mesh with its materials, and the surfels as a particle field of Gaussian surflets.

In: plain numpy arrays. Out: a .usd, .usda, .usdc file. Needs the optional package usd-core (26 or newer).
Source: OpenUSD 26 UsdVol, ParticleFieldKernelGaussianSurfletAPI: an exact 2D Gaussian disk, linear scales, activated opacity.
"""

from pathlib import Path

import numpy as np


def write_usd(path: Path, mesh: dict[str, np.ndarray], surfels: dict[str, np.ndarray] | None, meters_per_unit: float) -> None:
    """Write one stage, z up.

    Args:
        mesh: vertices (v, 3), faces (f, 3), normals (v, 3), albedo (v, 3), roughness (v), metallic (v).
        surfels: centers (n, 3), scales (n, 2), quats_wxyz (n, 4), opacities (n), sh (n, 16, 3), albedo (n, 3), roughness (n), metallic (n).

    Raises:
        ValueError: usd-core is not installed, or the name does not end in .usd, .usda or .usdc.
    """
    if path.suffix not in (".usd", ".usda", ".usdc"):
        raise ValueError(f"{path}: expected a name ending in .usd, .usda or .usdc")
    try:
        from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, UsdVol, Vt
    except ImportError as error:
        raise ValueError("writing USD needs the package usd-core; install it with: pip install 'usd-core>=26'") from error
    if not hasattr(UsdVol, "ParticleFieldKernelGaussianSurfletAPI"):
        raise ValueError(f"usd-core {'.'.join(map(str, Usd.GetVersion()))} has no particle fields; install 'usd-core>=26'")

    def floats(values: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(values, np.float32)

    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, meters_per_unit)
    root = UsdGeom.Xform.Define(stage, "/object")
    stage.SetDefaultPrim(root.GetPrim())

    surface = UsdGeom.Mesh.Define(stage, "/object/mesh")
    surface.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(floats(mesh["vertices"])))
    surface.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(mesh["faces"].reshape(-1), np.int32)))
    surface.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(mesh["faces"]), 3, np.int32)))
    surface.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(floats(mesh["normals"])))
    surface.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    surface.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    surface.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(floats(np.stack([mesh["vertices"].min(0), mesh["vertices"].max(0)]))))
    primvars = UsdGeom.PrimvarsAPI(surface)
    color = primvars.CreatePrimvar("displayColor", Sdf.ValueTypeNames.Color3fArray, UsdGeom.Tokens.vertex)
    color.Set(Vt.Vec3fArray.FromNumpy(floats(mesh["albedo"])))
    for name in ("roughness", "metallic"):
        primvars.CreatePrimvar(f"drgs:{name}", Sdf.ValueTypeNames.FloatArray, UsdGeom.Tokens.vertex).Set(
            Vt.FloatArray.FromNumpy(floats(mesh[name]))
        )

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
    UsdShade.MaterialBindingAPI.Apply(surface.GetPrim()).Bind(material)

    if surfels is not None:
        field = UsdVol.ParticleField.Define(stage, "/object/surfels")
        prim = field.GetPrim()
        UsdVol.ParticleFieldKernelGaussianSurfletAPI.Apply(prim)
        UsdVol.ParticleFieldPositionAttributeAPI.Apply(prim).CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(floats(surfels["centers"])))
        orientations = Vt.QuatfArray([Gf.Quatf(float(w), float(x), float(y), float(z)) for w, x, y, z in surfels["quats_wxyz"]])
        UsdVol.ParticleFieldOrientationAttributeAPI.Apply(prim).CreateOrientationsAttr(orientations)
        scales = np.concatenate([surfels["scales"], np.ones((len(surfels["scales"]), 1))], -1)  # the disk has no third axis
        UsdVol.ParticleFieldScaleAttributeAPI.Apply(prim).CreateScalesAttr(Vt.Vec3fArray.FromNumpy(floats(scales)))
        UsdVol.ParticleFieldOpacityAttributeAPI.Apply(prim).CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(floats(surfels["opacities"])))
        radiance = UsdVol.ParticleFieldSphericalHarmonicsAttributeAPI.Apply(prim)
        radiance.CreateRadianceSphericalHarmonicsDegreeAttr(3)
        radiance.CreateRadianceSphericalHarmonicsCoefficientsAttr(Vt.Vec3fArray.FromNumpy(floats(surfels["sh"].reshape(-1, 3))))
        reach = 3 * surfels["scales"].max() if len(surfels["scales"]) else 0.0
        extent = np.stack([surfels["centers"].min(0) - reach, surfels["centers"].max(0) + reach])
        field.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(floats(extent)))
        of_field = UsdGeom.PrimvarsAPI(prim)
        albedo = of_field.CreatePrimvar("drgs:albedo", Sdf.ValueTypeNames.Color3fArray, UsdGeom.Tokens.vertex)
        albedo.Set(Vt.Vec3fArray.FromNumpy(floats(surfels["albedo"])))
        for name in ("roughness", "metallic"):
            values = Vt.FloatArray.FromNumpy(floats(surfels[name]))
            of_field.CreatePrimvar(f"drgs:{name}", Sdf.ValueTypeNames.FloatArray, UsdGeom.Tokens.vertex).Set(values)
    if not stage.Export(str(path)):
        raise ValueError(f"{path}: usd-core could not write it")
