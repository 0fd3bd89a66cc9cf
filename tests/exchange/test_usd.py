import numpy as np
import pytest

from drgs.exchange.usd import write_usd

pxr = pytest.importorskip("pxr", reason="the optional package usd-core is not installed")


def test_mesh_and_surfels_are_found_again_in_the_stage(tmp_path):
    from pxr import Usd, UsdGeom, UsdShade, UsdVol

    random = np.random.default_rng(0)
    corner = random.random(4).astype(np.float32)
    mesh = {
        "vertices": random.normal(size=(4, 3)).astype(np.float32), "faces": np.array([[0, 1, 2], [0, 2, 3]], np.int32),
        "normals": random.normal(size=(4, 3)).astype(np.float32), "albedo": random.random((4, 3)).astype(np.float32), "roughness": corner, "metallic": corner,
    }  # fmt: skip
    surfels = {
        "centers": random.normal(size=(5, 3)).astype(np.float32), "scales": random.random((5, 2)).astype(np.float32),
        "quats_wxyz": np.tile(np.float32([0.5, 0.5, -0.5, 0.5]), (5, 1)), "opacities": random.random(5).astype(np.float32),
        "sh": random.normal(size=(5, 16, 3)).astype(np.float32), "albedo": random.random((5, 3)).astype(np.float32),
        "roughness": random.random(5).astype(np.float32), "metallic": random.random(5).astype(np.float32),
    }  # fmt: skip
    write_usd(tmp_path / "a.usda", mesh, surfels, 0.25)
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    assert UsdGeom.GetStageUpAxis(stage) == "Z" and UsdGeom.GetStageMetersPerUnit(stage) == 0.25
    surface = UsdGeom.Mesh.Get(stage, "/object/mesh")
    assert np.array_equal(np.array(surface.GetPointsAttr().Get()), mesh["vertices"])
    assert np.array_equal(np.array(surface.GetFaceVertexIndicesAttr().Get()), mesh["faces"].reshape(-1))
    assert UsdShade.MaterialBindingAPI(surface).ComputeBoundMaterial()[0].GetPath() == "/object/material"
    prim = stage.GetPrimAtPath("/object/surfels")
    assert prim.HasAPI(UsdVol.ParticleFieldKernelGaussianSurfletAPI)
    found = {name: np.array(prim.GetAttribute(name).Get()) for name in ("positions", "scales", "opacities", "primvars:drgs:roughness")}
    assert np.array_equal(found["positions"], surfels["centers"]) and np.array_equal(found["scales"][:, :2], surfels["scales"])
    assert np.array_equal(found["opacities"], surfels["opacities"]) and np.array_equal(
        found["primvars:drgs:roughness"], surfels["roughness"]
    )
    orientation = prim.GetAttribute("orientations").Get()[0]
    assert (orientation.GetReal(), *orientation.GetImaginary()) == (0.5, 0.5, -0.5, 0.5)
    assert len(prim.GetAttribute("radiance:sphericalHarmonicsCoefficients").Get()) == 5 * 16
