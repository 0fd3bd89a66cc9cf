"""What pictures of a ball decide, drawn by the very formula that is asked."""

import dataclasses

import pytest
import torch
from torch import Tensor

from drgs.reconstruct.fit.evidence.metal_evidence import metal_evidence, view_sums
from drgs.reconstruct.fit.evidence.vertex_certainty import vertex_certainty
from drgs.reconstruct.fit.light.split_sum import filter_environment
from drgs.reconstruct.fit.view_targets import ViewTarget
from drgs.reconstruct.geometry.mesh_edges import mesh_edges
from drgs.render.intersect.trace_rays import build_tracer
from drgs.scene.certainty import Certainty
from drgs.scene.mesh import TriangleMesh
from tests.reconstruct.fit.evidence.test_metal_evidence import light, open_light, pictures
from tests.render.closed_form_scenes import sphere_mesh


def ball(metallic: float, roughness: float = 0.25) -> TriangleMesh:
    mesh = sphere_mesh(subdivisions=3, albedo=0.6, roughness=roughness)
    return dataclasses.replace(mesh, metallic=torch.full_like(mesh.metallic, metallic))


def certainty_of(mesh: TriangleMesh, targets: list[ViewTarget], tables: Tensor) -> Certainty:
    tracer, light_of = build_tracer(mesh), open_light(mesh, tables)
    evidence = metal_evidence(view_sums(tracer, targets, light_of), mesh_edges(mesh.faces), False)
    return vertex_certainty(tracer, targets, light_of, evidence)


@pytest.mark.parametrize(("metallic", "known"), [(1.0, ("shape", "roughness", "metallic")), (0.0, ("albedo", "metallic"))])
def test_the_side_that_views_look_at_is_known_and_the_other_is_a_guess(metallic: float, known: tuple[str, ...]):
    mesh, tables = ball(metallic), filter_environment(light())
    targets = [target for target in pictures(mesh, tables) if target.camera.center_world[0] > 1]
    certainty = certainty_of(mesh, targets, tables)
    near, far = mesh.vertices[:, 0] > 0.8, mesh.vertices[:, 0] < -0.9
    assert len(targets) >= 4 and int(near.sum()) > 20 and int(far.sum()) > 10
    for name, values in vars(certainty).items():
        assert float(values.min()) >= 0 and float(values.max()) <= 1 and float(values[far].max()) == 0, name
        assert name not in known or float(values[near].float().median()) > 0.5, name


def test_in_the_dark_nothing_is_known_of_the_paint():
    mesh = ball(metallic=0.0)
    bright, dark = (filter_environment(brightness * light()) for brightness in (1, 1e-4))
    lit, unlit = (certainty_of(mesh, pictures(mesh, tables), tables) for tables in (bright, dark))
    assert float(lit.albedo.float().median()) > 0.5
    for name, values in vars(unlit).items():
        assert float(values.max()) < 0.01, name


def test_under_even_light_nobody_knows_whether_it_is_metal_nor_which_way_it_faces():
    mesh = ball(metallic=1.0)
    even, windows = (filter_environment(table) for table in (torch.ones(128, 256, 3), light()))
    unsure, sure = (certainty_of(mesh, pictures(mesh, tables), tables) for tables in (even, windows))
    assert float(unsure.metallic.float().median()) < 0.3 and float(sure.metallic.float().median()) > 0.7
    assert float(unsure.shape.float().median()) < 0.01 and float(sure.shape.float().median()) > 0.15


def test_what_the_fit_leaves_unexplained_costs_certainty():
    mesh, tables = ball(metallic=0.0), filter_environment(light())
    targets = pictures(mesh, tables)
    factor = 0.5 + torch.rand(len(mesh.vertices), 1, generator=torch.Generator().manual_seed(0))
    exact, wrong = (certainty_of(dataclasses.replace(mesh, albedo=mesh.albedo * f), targets, tables) for f in (1, factor))
    for name in ("shape", "albedo", "roughness"):
        assert float(getattr(wrong, name).float().mean()) < 0.5 * float(getattr(exact, name).float().mean()), name
