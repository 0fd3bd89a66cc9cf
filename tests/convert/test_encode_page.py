"""A page holds the object and its lights as they are, within what its numbers can hold, and never more than it may weigh."""

import base64
import json
import re
import struct
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from drgs.convert import bake_transfer
from drgs.convert.export_asset import export_asset
from drgs.convert.page import encode_page
from drgs.convert.page.pack_arrays import in_order_of_use, pack_arrays, rgbe, steps_from_newest
from drgs.convert.page.page_lights import page_lights
from drgs.convert.shrink_mesh import shrink_mesh
from drgs.deform.pose_scene import pose_scene
from drgs.maths.color import luminance
from drgs.maths.spherical_harmonics import sh_basis
from drgs.scene.asset import Asset
from drgs.scene.edits import AS_CAPTURED, AS_SHOWN, parse_edits
from drgs.scene.environment import Environment
from drgs.scene.mesh import TriangleMesh
from tests.convert.test_export_asset import ball_asset

PROGRAM = "<title>{{title}}</title><script type='text/plain'>{{object}}</script>"


@pytest.fixture(autouse=True)
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A page without a program: what is put into it is the matter here."""
    path = tmp_path / "program.html"
    path.write_text(PROGRAM)
    monkeypatch.setattr(encode_page, "PROGRAM", path)
    return path


def grey_mesh(shape: trimesh.Trimesh, albedo: float = 0.5) -> TriangleMesh:
    vertices = torch.tensor(np.asarray(shape.vertices), dtype=torch.float32)
    normals = torch.tensor(np.array(shape.vertex_normals), dtype=torch.float32)
    one = torch.ones(len(vertices))
    return TriangleMesh(
        vertices, torch.tensor(np.asarray(shape.faces), dtype=torch.int32), normals, albedo * one[:, None].expand(-1, 3), 0.4 * one, 0 * one
    )


def held(page: bytes) -> tuple[dict, dict[str, np.ndarray]]:
    """Header and arrays of a page, as its program reads them."""
    (text,) = re.findall(rb"<script type='text/plain'>(.*)</script>", page)
    data = zlib.decompress(base64.b64decode(text))
    (length,) = struct.unpack_from("<I", data)
    header, start, arrays = json.loads(data[4 : 4 + length]), 4 + length, {}
    for listed in header["arrays"]:
        width, rows, columns = listed["bytes"], listed["rows"], listed["columns"]
        planes = np.frombuffer(data, np.uint8, width * rows * columns, start).reshape(width, columns, rows).astype(np.int64)
        values = sum(planes[k] << (8 * k) for k in range(width)).T
        if width < 4:
            values = np.cumsum(np.where(values % 2, -(values + 1) // 2, values // 2), axis=0) % (1 << (8 * width))
        arrays[listed["name"]] = values
        start += width * rows * columns
    assert start == len(data)
    return header, arrays


@pytest.mark.slow
def test_a_page_holds_shape_and_materials_of_the_mesh():
    asset = ball_asset()
    page = encode_page.encode_page(asset)
    header, arrays = held(page.html)
    mesh, (detail,) = asset.mesh, header["meshes"]
    steps, corners, newest = arrays["mesh0.steps"][:, 0], [], 0
    for step in steps:
        corners.append(newest - step)
        newest += step == 0
    places = arrays["mesh0.places"] * detail["place_step"] + np.array(detail["low"])
    distance, original = torch.cdist(torch.tensor(places), mesh.vertices.double()).min(1)
    assert len(places) == len(mesh.vertices) and distance.max() < detail["place_step"]
    faces = original.numpy()[np.array(corners).reshape(-1, 3)]
    assert sorted(map(tuple, faces.tolist())) == sorted(map(tuple, mesh.faces.tolist())), "the same faces, wound the same way"
    assert np.abs((arrays["mesh0.albedo_roots0"] / 255) ** 2 - mesh.albedo.numpy()[original]).max() < 0.005
    surface = torch.stack([mesh.roughness, mesh.metallic], -1).numpy()[original]
    assert np.abs(arrays["mesh0.surface0"] / 255 - surface).max() < 0.003
    flat = arrays["mesh0.normals"] * 2 / (detail["normal_steps"] - 1) - 1
    normals = np.concatenate([flat, 1 - np.abs(flat).sum(1, keepdims=True)], -1)
    normals[:, :2] -= np.maximum(-normals[:, 2:], 0) * np.sign(normals[:, :2])
    cosine = (normals / np.linalg.norm(normals, axis=1, keepdims=True) * mesh.normals.numpy()[original]).sum(1)
    assert cosine.min() > np.cos(np.radians(0.15))
    assert header["faces"] == {"kept": len(mesh.faces), "all": len(mesh.faces)} and page.faces == len(mesh.faces)
    assert [light["name"] for light in header["lights"]] == ["As captured", "Studio", "Day", "Evening"] and detail["closed"]
    assert header["materials"] == [AS_CAPTURED]


@pytest.mark.slow
def test_a_page_holds_its_variants_at_the_same_vertices_in_both_of_its_meshes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(bake_transfer, "DIRECTIONS", 16)  # how finely shadows are baked is not asked here
    monkeypatch.setattr(encode_page, "COARSE_FACES", 300)
    asset = ball_asset()
    cap = {"sphere": {"center": [0, 0, 3], "radius": 1, "falloff": 0.1}}
    edits = {"Cap": parse_edits([{"op": "material", "select": cap, "set": {"albedo": [0.9, 0.1, 0.1], "metallic": 1.0}}])}
    export_asset(asset, tmp_path / "page.html", "html", variants=edits, shown=AS_SHOWN)
    header, arrays = held((tmp_path / "page.html").read_bytes())
    assert header["materials"] == [AS_SHOWN, "Cap"] and len(header["meshes"]) == 2
    worn = pose_scene(asset, edits["Cap"]).mesh
    for number, mesh in enumerate((asset.mesh, worn)):
        places = arrays["mesh0.places"] * header["meshes"][0]["place_step"] + np.array(header["meshes"][0]["low"])
        original = torch.cdist(torch.tensor(places), mesh.vertices.double()).argmin(1).numpy()
        assert np.abs((arrays[f"mesh0.albedo_roots{number}"] / 255) ** 2 - mesh.albedo.numpy()[original]).max() < 0.005
        assert np.abs(arrays[f"mesh0.surface{number}"][:, 1] / 255 - mesh.metallic.numpy()[original]).max() < 0.003
    low, high = np.array(header["meshes"][1]["low"])[2], header["meshes"][1]["high"][2]
    heights = (arrays["mesh1.places"] * header["meshes"][1]["place_step"])[:, 2] + low
    captured, cap_metal = (arrays[f"mesh1.surface{number}"][:, 1] / 255 for number in (0, 1))
    assert (cap_metal[heights > high - 0.2] > 0.9).all() and (np.abs(cap_metal - captured)[heights < 1.8] == 0).all()


def test_titles_of_strangers_are_text():
    asset = replace(ball_asset(), provenance={"dataset": "<script>alert(1)</script>_cup"})
    page = encode_page.encode_page(asset).html
    assert b"<title>script&gt; cup</title>" in page and held(page)[0]["title"] == "script> cup"


def test_even_light_stays_even_on_a_ball_and_is_dimmed_in_a_bowl():
    ball = bake_transfer.bake_transfer(grey_mesh(trimesh.creation.icosphere(2)))
    constant = torch.zeros(9)
    constant[0] = (4 * torch.pi) ** 0.5  # radiance 1 from everywhere
    assert torch.allclose(ball @ constant, torch.ones(()), atol=1e-3)
    shape = trimesh.creation.icosphere(3)
    inside = trimesh.Trimesh(shape.vertices, shape.faces[(shape.triangles_center[:, 2] < 0)][:, ::-1], process=True)
    dark, bright = (bake_transfer.bake_transfer(grey_mesh(inside, albedo)) for albedo in (0.0, 0.8))
    bottom = int(inside.vertices[:, 2].argmin())
    # The sky fills the bowl's opening alone: at the bottom of a half sphere that is half of what a cosine weighs.
    assert abs(float(dark[bottom] @ constant) - 0.5) < 0.05
    # A half sphere sends itself half of what it reflects: 0.5 / (1 - 0.5 albedo), here after three bounces.
    assert abs(float(bright[bottom] @ constant) - 0.5 * (1 + 0.4 + 0.16 + 0.064)) < 0.06


def test_harmonics_of_a_light_give_its_mean_and_its_direction():
    up = torch.zeros(64, 128, 3)
    up[:32] = 1.0
    own = page_lights(Environment(up))[0]
    sky, ground = (sh_basis(torch.tensor([0.0, 0.0, z]), 2) @ torch.tensor(own.harmonics).float() for z in (1.0, -1.0))
    assert abs(own.harmonics[0, 0] - 0.5 * (4 * np.pi) ** 0.5) < 0.01 and (sky > 0.9).all() and (ground < 0.1).all()
    roughest, sharpest = own.tables[-1], own.tables[0]
    assert sharpest[60].min() > 0.99 and sharpest[-60].max() < 0.01 and 0.6 < roughest[6].mean() < 0.95 and 0.05 < roughest[-6].mean() < 0.4


def test_lights_are_held_within_a_256th_of_their_brightest_colour():
    radiance = np.abs(np.random.default_rng(0).normal(size=(16, 32, 3))) * 10.0 ** np.random.default_rng(1).uniform(-4, 4, (16, 32, 1))
    texels = rgbe(radiance).astype(float)
    found = (texels[:, :3] + 0.5) * 2.0 ** (texels[:, 3:] - 136)
    assert (np.abs(found - radiance.reshape(-1, 3)) <= radiance.max(-1).reshape(-1, 1) / 128 * 0.51).all()


def test_packed_numbers_come_back_whatever_they_are():
    random = np.random.default_rng(0)
    arrays = {
        "narrow": random.integers(0, 256, (50, 3), np.uint8),
        "wide": random.integers(0, 65536, (7, 2), np.uint16),
        "plain": random.integers(0, 1 << 32, 9, np.uint32),
    }
    packed = base64.b64encode(pack_arrays(arrays, {"title": "ö"}))
    header, found = held(b"<script type='text/plain'>" + packed + b"</script>")
    assert header["title"] == "ö"
    assert all(np.array_equal(found[name], values.reshape(len(values), -1)) for name, values in arrays.items())


def test_faces_are_ordered_so_that_corners_are_new_or_near():
    shape = trimesh.creation.icosphere(4)
    faces, order = in_order_of_use(np.asarray(shape.faces), np.asarray(shape.vertices))
    assert sorted(order) == list(range(len(shape.vertices)))
    assert sorted(map(sorted, order[faces].tolist())) == sorted(map(sorted, np.asarray(shape.faces).tolist()))
    steps = steps_from_newest(faces)
    assert (steps == 0).sum() == len(shape.vertices) and np.median(steps) < 64


def colourful_mesh(divisions: int) -> TriangleMesh:
    """A ball with a colour of its own at each corner: 327 680 faces at seven divisions, a quarter of it at one less."""
    mesh = grey_mesh(trimesh.creation.icosphere(divisions))
    return replace(mesh, albedo=torch.rand(len(mesh.vertices), 3), roughness=torch.rand(len(mesh.vertices)))


def with_faces_apart(mesh: TriangleMesh) -> TriangleMesh:
    """No two faces share a corner any more."""
    corners = mesh.faces.reshape(-1).long()
    values = {name: tensor[corners] for name, tensor in mesh.columns.items() if name != "faces"}
    return TriangleMesh(faces=torch.arange(len(corners), dtype=torch.int32).reshape(-1, 3), **values)


@pytest.mark.slow
def test_a_page_of_a_large_mesh_weighs_at_most_five_megabytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(bake_transfer, "DIRECTIONS", 16)  # how finely shadows are baked changes no size to speak of
    asset = Asset(None, colourful_mesh(7), None, Environment(torch.rand(128, 256, 3)))
    left_out = export_asset(asset, tmp_path / "page.html", "html")
    page = (tmp_path / "page.html").read_bytes()
    header, _ = held(page)
    assert len(page) < 5_000_000 - 80_000, "the program, which is not in it here, has room"
    assert 0.25 * encode_page.MOST_FACES < header["faces"]["kept"] <= encode_page.MOST_FACES and len(header["meshes"]) == 2
    assert left_out == f"{header['faces']['kept']} of the mesh's {len(asset.mesh.faces)} faces" and all(
        detail["closed"] for detail in header["meshes"]
    )


@pytest.mark.slow
def test_a_shrunk_mesh_keeps_shape_and_mean_colour():
    mesh = with_faces_apart(colourful_mesh(5))
    small = shrink_mesh(mesh, 5000)
    assert len(small.faces) <= 5000
    assert (small.vertices.norm(dim=1) - 1).abs().max() < 2e-3 and (small.normals * small.vertices).sum(1).min() > 0.999
    assert abs(float(luminance(small.albedo).mean() - luminance(mesh.albedo).mean())) < 0.01
    assert shrink_mesh(small, 5000) is small


@pytest.mark.slow
def test_what_makes_no_page_is_refused_with_a_sentence(program: Path, monkeypatch: pytest.MonkeyPatch):
    asset = ball_asset()
    nothing = replace(asset, mesh=replace(asset.mesh, faces=asset.mesh.faces[:0]))
    with pytest.raises(ValueError, match="has no faces"):
        encode_page.encode_page(nothing)
    monkeypatch.setattr(encode_page, "MOST_BYTES", 1000)
    monkeypatch.setattr(encode_page, "ATTEMPTS", 2)
    with pytest.raises(ValueError, match=r"the page would have \d.\d MB with \d+ of the mesh's 1280 faces; expected at most 0.001"):
        encode_page.encode_page(asset)
    program.unlink()
    with pytest.raises(ValueError, match=r"program\.html: is not there; build it with"):
        encode_page.encode_page(asset)
