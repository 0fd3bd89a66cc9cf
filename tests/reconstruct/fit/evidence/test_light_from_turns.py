"""Light that turns with the camera is found by what paint looks like under its turns."""

import dataclasses
import math

import numpy as np
import pytest
import torch
import trimesh

from drgs.maths.color import srgb_from_linear
from drgs.reconstruct.fit.evidence.light_from_turns import TurnedLightSettings, _turned_texels, light_from_turns
from drgs.reconstruct.fit.light.environment_pyramid import upsampled
from drgs.reconstruct.fit.light.mesh_light import LightOf, MeshLight, at_corners, corner_weights
from drgs.reconstruct.fit.light.split_sum import filter_environment, shade_split_sum
from drgs.reconstruct.fit.view_targets import ViewTarget
from drgs.render.intersect.trace_rays import build_tracer, trace_rays
from drgs.render.intersect.tracer import AbstractTracer
from drgs.scene.camera import Camera, pixel_rays_world
from drgs.scene.environment import direction_from_uv
from drgs.scene.mesh import TriangleMesh
from tests.reconstruct.tiny_capture import look_at
from tests.render.closed_form_scenes import mesh_of, sphere_mesh

SIDE = 64
PAINTS = torch.tensor([[0.5, 0.2, 0.1], [0.1, 0.2, 0.4], [0.3, 0.35, 0.3]])


def directions() -> torch.Tensor:
    """(128, 256, 3) of a light's texels."""
    v, u = torch.meshgrid((torch.arange(128) + 0.5) / 128, (torch.arange(256) + 0.5) / 256, indexing="ij")
    return direction_from_uv(torch.stack([u, v], -1))


def lamp(towards: tuple[float, float, float], strength: float = 6.0) -> torch.Tensor:
    """(128, 256, 3): an even room with one lamp."""
    cosine = (directions() * torch.nn.functional.normalize(torch.tensor(towards), dim=0)).sum(-1, keepdim=True)
    return 0.3 + strength * (cosine > 0.93).float().expand(128, 256, 3)


def ring(elevations: tuple[float, ...], count: int = 8) -> list[Camera]:
    """Cameras around the origin that look at it."""
    intrinsics = torch.tensor([[1.5 * SIDE, 0, SIDE / 2], [0, 1.5 * SIDE, SIDE / 2], [0, 0, 1.0]])
    places = [
        (3.5 * math.cos(e) * math.cos(a), 3.5 * math.cos(e) * math.sin(a), 3.5 * math.sin(e))
        for e in elevations
        for a in torch.linspace(0, 2 * math.pi, count + 1)[:-1].tolist()
    ]
    return [Camera(torch.tensor(look_at(np.array(place))).float(), intrinsics, SIDE, SIDE) for place in places]


def turn_of(camera: Camera, first: Camera) -> torch.Tensor:
    return first.camera_from_world[:3, :3].float().T @ camera.camera_from_world[:3, :3].float()


def photographed(tracer: AbstractTracer, cameras: list[Camera], light: torch.Tensor) -> list[ViewTarget]:
    """Of a convex mesh of paint without gloss."""
    targets = []
    for camera in cameras:
        turn = turn_of(camera, cameras[0])
        origin, direction = pixel_rays_world(camera)
        hits = trace_rays(origin.expand_as(direction).reshape(-1, 3), direction.reshape(-1, 3), tracer)
        hit = hits.hit.nonzero().squeeze(1)
        corners, weights = tracer.mesh.faces[hits.face[hit].long()].long(), corner_weights(hits.barycentric[hit])
        sent = tracer.mesh.albedo * irradiance(
            tracer.mesh, MeshLight(filter_environment(light), torch.ones_like(tracer.mesh.vertices), turn)
        )
        photo = torch.zeros(SIDE * SIDE, 3)
        photo[hit] = srgb_from_linear(at_corners(sent, corners, weights))
        photo, mask = photo.view(SIDE, SIDE, 3), hits.hit.float().view(SIDE, SIDE)
        targets.append(ViewTarget(camera, photo, photo, mask, slice(0, SIDE), slice(0, SIDE), light_from_world=turn))
    return targets


def irradiance(mesh: TriangleMesh, light: MeshLight) -> torch.Tensor:
    """(vertex, 3), over pi, where nothing is in the way."""
    black, one = torch.zeros_like(mesh.normals), torch.ones_like(mesh.normals)
    turned = {"light_from_world": light.light_from_world}
    shaded = [
        shade_split_sum(a, black, black, one[:, 0].contiguous(), mesh.normals, mesh.normals, light.tables, **turned) for a in (one, black)
    ]
    return shaded[0] - shaded[1]


def lit_by(radiance: torch.Tensor, mesh: TriangleMesh) -> LightOf:
    tables = filter_environment(radiance)
    return lambda target: MeshLight(tables, torch.ones_like(mesh.vertices), target.light_from_world)


def found_under(mesh: TriangleMesh, light: torch.Tensor, targets: list[ViewTarget], settings: TurnedLightSettings) -> torch.Tensor | None:
    """The environment after light_from_turns."""
    paint, generator = mesh.metallic < 0.5, torch.Generator().manual_seed(0)
    factor = light_from_turns(build_tracer(mesh), light, lit_by(light, mesh), targets, paint, settings, generator)
    return None if factor is None else light * upsampled(factor.log().permute(2, 0, 1)[None], 128)[0].permute(1, 2, 0).exp()


def best_paint(mesh: TriangleMesh, light: torch.Tensor, targets: list[ViewTarget], truth: torch.Tensor) -> torch.Tensor:
    """(vertex, 3): mean over views from whose side a vertex faces of what it sends under the truth over what arrives under `light`."""
    total, weight = torch.zeros_like(mesh.vertices), torch.zeros_like(mesh.vertices[:, :1])
    for target in targets:
        facing = (mesh.normals * torch.nn.functional.normalize(target.camera.center_world - mesh.vertices, dim=-1)).sum(-1, keepdim=True)
        seen = (facing > 0.25).float()
        sent = mesh.albedo * irradiance(mesh, lit_by(truth, mesh)(target))
        total += seen * (sent / irradiance(mesh, lit_by(light, mesh)(target))).log()
        weight += seen
    return (total / weight.clamp(min=1)).exp()


def drum() -> TriangleMesh:
    """A white one, of which no side turns as its top does before cameras of one height."""
    shape = trimesh.creation.cylinder(radius=0.8, height=0.8, sections=64).subdivide().subdivide()
    return mesh_of(trimesh.graph.smooth_shade(shape, angle=0.5), 0.6, 0.9, 0.0)


def painted_sphere() -> TriangleMesh:
    mesh = sphere_mesh(subdivisions=4, albedo=0.5, roughness=0.9)
    place = (3 * mesh.vertices).floor().long()
    paint = PAINTS[(place * torch.tensor([1, 2, 5])).sum(1) % 3]
    return dataclasses.replace(mesh, albedo=paint, metallic=torch.zeros(len(paint)))


def test_texels_are_turned_as_directions_are():
    still = _turned_texels(torch.eye(3), 8)
    torch.testing.assert_close(still, torch.eye(128))
    quarter = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    turned = _turned_texels(quarter, 8)
    torch.testing.assert_close(turned.sum(1), torch.ones(128))
    v, u = torch.meshgrid((torch.arange(8) + 0.5) / 8, (torch.arange(16) + 0.5) / 16, indexing="ij")
    middles = direction_from_uv(torch.stack([u, v], -1)).view(-1, 3)
    torch.testing.assert_close(turned @ middles, middles @ quarter.T, atol=1e-5, rtol=0)
    tilted = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(0))).Q
    tilted = tilted * torch.sign(torch.linalg.det(tilted))
    off = torch.nn.functional.normalize(_turned_texels(tilted, 8) @ middles, dim=-1) - middles @ tilted.T
    assert float(off.norm(dim=-1).mean()) < 0.12  # of texels 0.39 wide


def test_a_lamp_is_found_by_the_looks_of_places_whatever_their_paint():
    truth, even = lamp((0.5, 0.2, 1.0)), torch.full((128, 256, 3), 0.6)
    mesh = painted_sphere()
    cameras = ring((0.1, 0.7))
    targets = photographed(build_tracer(mesh), cameras, truth)
    wrong = dataclasses.replace(mesh, albedo=torch.full_like(mesh.albedo, 0.5))
    found = found_under(wrong, even, targets, TurnedLightSettings(weight_alike=0.0))
    assert found is not None

    def off(light: torch.Tensor) -> float:
        """Standard deviation of the logarithm of what arrives, over the truth's, at what any camera sees."""
        ratios = []
        for target in targets:
            facing = (mesh.normals * torch.nn.functional.normalize(target.camera.center_world - mesh.vertices, dim=-1)).sum(-1) > 0.25
            ratios.append((irradiance(mesh, lit_by(light, mesh)(target)) / irradiance(mesh, lit_by(truth, mesh)(target)))[facing].log())
        return float(torch.cat(ratios).std())

    assert off(even) > 0.3
    assert off(found) < 0.25 * off(even)


def test_what_never_turns_the_same_way_is_told_by_being_alike():
    truth = lamp((0.2, 0.3, 1.0))
    mesh = drum()
    targets = photographed(build_tracer(mesh), ring((0.6,), 12), truth)
    tilted = truth * (1.2 * directions()[..., 2:]).exp()
    up = mesh.normals[:, 2]
    seen_from_above = dataclasses.replace(mesh, albedo=best_paint(mesh, tilted, targets, truth))

    def top_over_side(light: torch.Tensor) -> float:
        albedo = best_paint(mesh, light, targets, truth)
        return float(albedo[up > 0.9].mean() / albedo[up.abs() < 0.1].mean())

    found = found_under(seen_from_above, tilted, targets, TurnedLightSettings())
    assert found is not None
    before, after = abs(math.log(top_over_side(tilted))), abs(math.log(top_over_side(found)))
    assert before > 0.2 and after < 0.4 * before


def test_light_that_is_right_stays_about_as_it_is():
    truth = lamp((0.5, 0.2, 1.0))
    mesh = painted_sphere()
    targets = photographed(build_tracer(mesh), ring((0.1, 0.7)), truth)
    found = found_under(mesh, truth, targets, TurnedLightSettings())
    assert found is not None
    changes, sent = [], []
    for target in targets:
        facing = (mesh.normals * torch.nn.functional.normalize(target.camera.center_world - mesh.vertices, dim=-1)).sum(-1) > 0.25
        before, after = (irradiance(mesh, lit_by(light, mesh)(target))[facing] for light in (truth, found))
        changes.append((after / before).log())
        sent.append((mesh.albedo[facing] * before).mean(1, keepdim=True))
    change, weight = torch.cat(changes), torch.cat(sent)
    assert float(change.std()) < 0.05
    assert float(((weight * change).sum(0) / weight.sum()).abs().max()) < 0.02  # what is bright stays so, in all channels


def test_nothing_follows_from_metal_nor_from_places_that_no_photograph_shows():
    truth = lamp((0.5, 0.2, 1.0))
    mesh = painted_sphere()
    targets = photographed(build_tracer(mesh), ring((0.1,), 3), truth)
    metal = dataclasses.replace(mesh, metallic=(mesh.vertices[:, 2] < 0.98).float())
    assert found_under(metal, truth, targets, TurnedLightSettings()) is None
    blind = [dataclasses.replace(target, mask=torch.zeros_like(target.mask)) for target in targets]
    assert found_under(mesh, truth, blind, TurnedLightSettings()) is None


@pytest.mark.parametrize("dark", ["photographs", "light"])
def test_factors_are_finite_in_the_dark(dark: str):
    truth = lamp((0.5, 0.2, 1.0))
    mesh = painted_sphere()
    targets = photographed(build_tracer(mesh), ring((0.1, 0.7)), truth)
    if dark == "photographs":
        targets = [dataclasses.replace(target, saturation=torch.zeros_like(target.saturation)) for target in targets]
    light = torch.full_like(truth, 3e-4) if dark == "light" else truth
    settings = TurnedLightSettings()
    found = found_under(mesh, light, targets, settings)
    assert found is not None and bool(found.isfinite().all())
    assert float((found / light).max()) <= 1.001 * settings.alike.most and float((found / light).min()) >= 0.999 / settings.alike.most
