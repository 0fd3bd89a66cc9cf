"""Fine patterns of albedo from pictures drawn by the very formula that is inverted."""

import dataclasses

import pytest
import torch

from drgs.reconstruct.fit.evidence.albedo_detail import albedo_detail
from drgs.reconstruct.fit.light.split_sum import filter_environment
from drgs.reconstruct.geometry.average_around import averaging_matrix
from drgs.reconstruct.geometry.mesh_edges import mesh_edges
from drgs.render.intersect.trace_rays import build_tracer
from drgs.scene.mesh import TriangleMesh
from tests.reconstruct.fit.evidence.test_metal_evidence import light, open_light, pictures
from tests.render.closed_form_scenes import sphere_mesh

RINGS = 8


def striped(metallic: float) -> tuple[TriangleMesh, TriangleMesh]:
    """A ball with stripes four edges wide, and the same with its albedo blurred and a quarter too dark."""
    mesh = sphere_mesh(subdivisions=4, albedo=0.5, roughness=0.4)
    azimuth = torch.atan2(mesh.vertices[:, 1], mesh.vertices[:, 0])
    albedo = (0.5 + 0.25 * torch.sign(torch.sin(10 * azimuth)))[:, None].repeat(1, 3)
    around, blurred = averaging_matrix(mesh_edges(mesh.faces), len(albedo)), albedo.double().numpy()
    for _ in range(3 * RINGS):
        blurred = around @ blurred
    mesh = dataclasses.replace(mesh, albedo=albedo, metallic=torch.full_like(mesh.metallic, metallic))
    return mesh, dataclasses.replace(mesh, albedo=0.75 * torch.from_numpy(blurred).float())


@pytest.mark.parametrize("metallic", [0.0, 1.0])
def test_stripes_come_back_and_what_is_wrong_everywhere_stays(metallic: float) -> None:
    mesh, blurred = striped(metallic)
    tables = filter_environment(light())
    found = albedo_detail(build_tracer(blurred), pictures(mesh, tables), open_light(mesh, tables), mesh_edges(mesh.faces), RINGS)
    seen = mesh.vertices[:, 2].abs() < 0.5
    wanted = 0.75 * mesh.albedo[seen, 0]
    before, after = ((albedo[seen, 0] - wanted).square().mean().sqrt() for albedo in (blurred.albedo, found))
    assert float(after) < 0.45 * float(before)
    assert abs(float(found[seen].mean() / blurred.albedo[seen].mean()) - 1) < 0.05


def test_what_photographs_from_both_sides_contradict_is_not_painted() -> None:
    """The surface lies 15 % of its radius too deep: each photograph shows other stripes there. Their plain mean keeps half of the contrast."""
    mesh, blurred = striped(0.0)
    tables = filter_environment(light())
    deep = dataclasses.replace(blurred, vertices=0.85 * blurred.vertices)
    shown = pictures(mesh, tables)
    right, wrong = (
        albedo_detail(build_tracer(fitted), shown, open_light(mesh, tables), mesh_edges(mesh.faces), RINGS) / fitted.albedo - 1
        for fitted in (blurred, deep)
    )
    seen = mesh.vertices[:, 2].abs() < 0.5
    assert float(wrong[seen].std()) < 0.15 * float(right[seen].std())


def test_what_no_photograph_shows_keeps_its_albedo() -> None:
    mesh, blurred = striped(0.0)
    tables = filter_environment(light())
    found = albedo_detail(build_tracer(blurred), [], open_light(mesh, tables), mesh_edges(mesh.faces), RINGS)
    assert torch.equal(found, blurred.albedo)
