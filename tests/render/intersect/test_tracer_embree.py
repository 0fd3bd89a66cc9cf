"""Embree by its own interface against the same Embree by its Python package, and what is said where there is none."""

import numpy as np
import pytest
import torch
from embreex.mesh_construction import TriangleMesh as PackageTriangles
from embreex.rtcore_scene import EmbreeScene as PackageScene

from drgs.render.intersect import embree_library
from drgs.render.intersect.tracer_embree import EmbreeTracer
from tests.render.closed_form_scenes import two_spheres


def test_kernels_get_the_answers_that_the_package_gets_to_the_bit() -> None:
    mesh, numbers = two_spheres(), torch.Generator().manual_seed(1)
    package = PackageScene(robust=True)
    triangles = PackageTriangles(package, np.ascontiguousarray(mesh.vertices[mesh.faces.long()].numpy()))
    # From vertices along edges and from anywhere: ties between triangles included.
    origins = torch.cat([3 * torch.randn(4000, 3, generator=numbers), mesh.vertices + 2 * mesh.normals])
    directions = torch.nn.functional.normalize(
        torch.cat([-origins[:4000] + torch.randn(4000, 3, generator=numbers), -mesh.normals]), dim=-1
    )
    tracer = EmbreeTracer(mesh)
    found = package.run(origins.numpy(), directions.numpy(), query="INTERSECT", output=True)
    hits = tracer.closest_hits(origins, directions)
    met = found["primID"] >= 0
    assert 1000 < met.sum() < len(met)
    assert np.array_equal(hits.hit.numpy(), met) and np.array_equal(hits.face.numpy(), found["primID"])
    assert np.array_equal(hits.distance.numpy()[met], found["tfar"][met])
    assert np.array_equal(hits.barycentric.numpy()[met], np.stack([found["u"], found["v"]], -1)[met])
    assert np.array_equal(tracer.occluded(origins, directions).numpy(), met)
    del triangles


def test_a_swift_tracer_answers_as_a_watertight_one_does_away_from_edges() -> None:
    mesh, numbers = two_spheres(), torch.Generator().manual_seed(2)
    tracer = EmbreeTracer(mesh)
    origins = 3 * torch.randn(20000, 3, generator=numbers)
    directions = torch.nn.functional.normalize(-origins + torch.randn(20000, 3, generator=numbers), dim=-1)
    wanted, found = tracer.closest_hits(origins, directions), tracer.swift.closest_hits(origins, directions)
    weights = torch.cat([1 - wanted.barycentric.sum(-1, keepdim=True), wanted.barycentric], -1)
    inside = wanted.hit & (weights.amin(-1) > 1e-4)
    assert int(inside.sum()) > 5000 and torch.equal(found.face[inside], wanted.face[inside])
    torch.testing.assert_close(found.distance[inside], wanted.distance[inside], rtol=1e-5, atol=1e-5)
    assert float((found.hit == wanted.hit).float().mean()) > 0.999
    assert torch.equal(tracer.swift.occluded(origins, directions), found.hit)


def test_a_swift_tracer_is_made_once_and_goes_along_with_new_materials() -> None:
    tracer = EmbreeTracer(two_spheres())
    assert tracer.swift is tracer.swift and tracer.swift.mesh is tracer.mesh
    assert tracer.swift.handle.scene != tracer.handle.scene
    painted = two_spheres(albedo=0.1)
    other = tracer.with_materials(painted)
    assert other.swift.mesh is painted and other.swift.handle.scene == tracer.swift.handle.scene
    assert tracer.swift.mesh is not painted and other.handle.scene == tracer.handle.scene
    freed = [each._scene.freed for each in (tracer, tracer.swift)]
    del tracer, other
    assert not any(each.alive for each in freed)


@pytest.mark.parametrize("held", [[], None])
def test_a_package_without_embree_is_named(held: list | None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(embree_library, "files", lambda _: held)
    with pytest.raises(RuntimeError, match="embreex"):
        embree_library._embree.__wrapped__()


def test_a_tree_is_freed_once_no_tracer_holds_it() -> None:
    tracer = EmbreeTracer(two_spheres())
    sharing, freed = tracer.with_materials(tracer.mesh), tracer._scene.freed
    del tracer
    assert freed.alive
    del sharing
    assert not freed.alive
