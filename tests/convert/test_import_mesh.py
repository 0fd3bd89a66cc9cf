import io
import json
import struct
import zlib

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from drgs.convert import sample_textures
from drgs.convert.import_mesh import import_mesh
from drgs.exchange.glb import decode_glb
from drgs.exchange.ply import encode_ply
from drgs.scene.asset import load_asset, save_asset

VERTICES = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]], np.float32)
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)


def vertex_columns(**more):
    return {"vertex": {"x": VERTICES[:, 0], "y": VERTICES[:, 1], "z": VERTICES[:, 2], **more}}


def y_up(vertices):
    return vertices[:, [0, 2, 1]] * np.array([1, 1, -1])


def test_ply_materials_and_normals_are_taken_bit_for_bit(tmp_path):
    random = np.random.default_rng(0)
    names = ["albedo_r", "albedo_g", "albedo_b", "roughness", "metallic"]
    values = {name: random.random(4, np.float32) for name in names}
    normals = VERTICES - VERTICES.mean(0)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    columns = vertex_columns(**{f"n{axis}": normals[:, k] for k, axis in enumerate("xyz")}, **values)
    (tmp_path / "a.ply").write_bytes(encode_ply(columns, FACES))
    asset = import_mesh(tmp_path / "a.ply")
    assert np.array_equal(asset.mesh.vertices, VERTICES) and np.array_equal(asset.mesh.faces, FACES)
    assert np.array_equal(asset.mesh.normals, normals)
    assert np.array_equal(asset.mesh.albedo[:, 1], values["albedo_g"]) and np.array_equal(asset.mesh.metallic, values["metallic"])
    assert asset.gaussians is None and asset.binding is None and (asset.environment.radiance == 1).all()


def test_a_bare_ply_gets_the_default_materials_and_outward_unit_normals(tmp_path):
    (tmp_path / "a.ply").write_bytes(encode_ply(vertex_columns(), FACES))
    mesh = import_mesh(tmp_path / "a.ply").mesh
    assert (mesh.albedo == 0.5).all() and (mesh.roughness == 0.5).all() and (mesh.metallic == 0).all()
    assert torch.allclose(mesh.normals.norm(dim=-1), torch.ones(4))
    assert ((mesh.normals * (mesh.vertices - mesh.vertices.mean(0))).sum(-1) > 0).all()


def test_faces_wound_against_the_files_normals_are_turned(tmp_path):
    normals = (VERTICES - VERTICES.mean(0)).astype(np.float32)
    columns = vertex_columns(**{f"n{axis}": normals[:, k] for k, axis in enumerate("xyz")})
    (tmp_path / "a.ply").write_bytes(encode_ply(columns, FACES[:, ::-1]))
    mesh = import_mesh(tmp_path / "a.ply").mesh
    corners = mesh.vertices[mesh.faces.long()]
    outward = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((outward * (corners.mean(1) - mesh.vertices.mean(0))).sum(-1) > 0).all()


def test_glb_factors_and_node_transforms_are_exact_and_z_points_up(tmp_path):
    material = PBRMaterial(baseColorFactor=[10, 51, 255, 255], roughnessFactor=0.25, metallicFactor=0.75)
    mesh = trimesh.Trimesh(y_up(VERTICES), FACES, visual=TextureVisuals(material=material), process=False)
    scene = trimesh.Scene()
    scene.add_geometry(mesh, transform=trimesh.transformations.translation_matrix([0, 5, 0]))
    scene.add_geometry(mesh, transform=np.diag([2.0, 2, -2, 1]))  # mirrored
    (tmp_path / "a.glb").write_bytes(scene.export(file_type="glb"))
    found = import_mesh(tmp_path / "a.glb").mesh
    halves = sorted([found.vertices[:4].tolist(), found.vertices[4:].tolist()], key=lambda half: np.max(half))
    assert np.allclose(halves[0], VERTICES * np.array([2, -2, 2]), atol=1e-6)
    assert np.allclose(halves[1], VERTICES + np.array([0, 0, 5]), atol=1e-6)
    assert np.allclose(found.albedo, np.array([10, 51, 255]) / 255, atol=1e-6)
    assert (found.roughness == 0.25).all() and (found.metallic == 0.75).all()
    corners = found.vertices[found.faces.long()].double()
    volumes = torch.linalg.det(corners[:, :, :]).reshape(2, 4).sum(1)
    assert (volumes > 0).all()  # the mirrored one is wound outward too


def test_dark_glb_factors_are_not_rounded_to_eight_bits(tmp_path):
    mesh = trimesh.Trimesh(
        y_up(VERTICES), FACES, visual=TextureVisuals(material=PBRMaterial(baseColorFactor=[1, 1, 1, 255])), process=False
    )
    data = mesh.export(file_type="glb")
    length = struct.unpack_from("<I", data, 12)[0]
    document = json.loads(data[20 : 20 + length])
    document["materials"][0]["pbrMetallicRoughness"] = {"baseColorFactor": [0.0101, 0.0102, 0.0103, 1]}
    text = json.dumps(document).encode().ljust(length + 400)
    (tmp_path / "a.glb").write_bytes(
        struct.pack("<5I", 0x46546C67, 2, len(data) + 400, length + 400, 0x4E4F534A) + text + data[20 + length :]
    )
    found = import_mesh(tmp_path / "a.glb").mesh
    assert np.allclose(found.albedo, [0.0101, 0.0102, 0.0103], atol=1e-7)
    assert (found.roughness == 1).all() and (found.metallic == 1).all()  # glTF's own defaults


def test_glb_textures_are_sampled_at_the_vertices_and_seams_are_joined(tmp_path):
    color = np.zeros((4, 4, 3), np.uint8)
    color[:2, :2], color[:2, 2:], color[2:, :2], color[2:, 2:] = [255, 0, 0], [0, 255, 0], [0, 0, 255], [188, 188, 188]
    surface = np.zeros((4, 4, 3), np.uint8)
    surface[..., 1], surface[..., 2] = 102, 204
    material = PBRMaterial(
        baseColorTexture=Image.fromarray(color), metallicRoughnessTexture=Image.fromarray(surface), roughnessFactor=0.5, metallicFactor=1.0
    )
    uv = np.array([[0.25, 0.75], [0.75, 0.75], [0.25, 0.25], [0.75, 0.25], [0.25, 0.75]])  # origin at the lower left
    vertices = np.concatenate([VERTICES, VERTICES[:1]])  # vertex 0 doubled by a seam
    faces = FACES.copy()
    faces[0, 0] = 4
    mesh = trimesh.Trimesh(y_up(vertices), faces, visual=TextureVisuals(uv=uv, material=material), process=False)
    (tmp_path / "a.glb").write_bytes(mesh.export(file_type="glb", include_normals=False))
    found = import_mesh(tmp_path / "a.glb").mesh
    assert np.allclose(found.vertices, VERTICES) and np.array_equal(found.faces, FACES)
    assert np.allclose(found.albedo, [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.503, 0.503, 0.503]], atol=1e-3)
    assert np.allclose(found.roughness, 0.2, atol=1e-6) and np.allclose(found.metallic, 0.8, atol=1e-6)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e4])
def test_seams_are_joined_and_nothing_else_in_any_unit(tmp_path, scale):
    ball = trimesh.creation.icosphere(subdivisions=4, radius=scale)
    count = len(ball.vertices)
    vertices = np.concatenate([ball.vertices, ball.vertices[:1]])  # vertex 0 doubled by a seam
    faces = ball.faces.copy()
    faces[np.argwhere((faces == 0).any(1))[0], faces[(faces == 0).any(1)][0].argmin()] = count
    uv = np.full((count + 1, 2), 0.5)
    material = PBRMaterial(baseColorTexture=Image.new("RGB", (2, 2), (90, 120, 200)))
    mesh = trimesh.Trimesh(vertices, faces, visual=TextureVisuals(uv=uv, material=material), process=False)
    (tmp_path / "a.glb").write_bytes(mesh.export(file_type="glb", include_normals=False))
    assert len(import_mesh(tmp_path / "a.glb").mesh.vertices) == count


def test_an_assets_own_mesh_file_comes_back_with_its_materials(tmp_path):
    (tmp_path / "a.ply").write_bytes(encode_ply(vertex_columns(roughness=np.linspace(0, 1, 4, dtype=np.float32)), FACES))
    asset = import_mesh(tmp_path / "a.ply")
    save_asset(asset, tmp_path / "asset")
    again = import_mesh(tmp_path / "asset" / "mesh.glb").mesh
    for name in ("vertices", "normals", "albedo", "roughness", "metallic", "faces"):
        assert torch.equal(getattr(again, name), getattr(asset.mesh, name)), name
    assert torch.equal(load_asset(tmp_path / "asset").mesh.roughness, again.roughness)
    assert decode_glb((tmp_path / "asset" / "mesh.glb").read_bytes()).attributes["POSITION"].tobytes() == VERTICES.tobytes()


def test_obj_takes_its_diffuse_colour_from_the_file_beside_it_only(tmp_path):
    lines = [
        "mtllib a.mtl",
        "usemtl red",
        *(f"v {x} {y} {z}" for x, y, z in VERTICES),
        *(f"f {a + 1} {b + 1} {c + 1}" for a, b, c in FACES),
    ]
    (tmp_path / "inside").mkdir()
    (tmp_path / "inside" / "a.obj").write_text("\n".join(lines))
    (tmp_path / "a.mtl").write_text("newmtl red\nKd 0.8 0.2 0.0\n")
    mesh = import_mesh(tmp_path / "inside" / "a.obj").mesh
    assert np.allclose(mesh.vertices, VERTICES) and np.array_equal(mesh.faces, FACES) and (mesh.albedo == 0.5).all()
    (tmp_path / "inside" / "b.obj").write_text("\n".join(lines).replace("a.mtl", "../a.mtl"))
    assert (import_mesh(tmp_path / "inside" / "b.obj").mesh.albedo == 0.5).all()
    (tmp_path / "inside" / "a.mtl").write_text("newmtl red\nKd 0.8 0.2 0.0\n")
    assert np.allclose(import_mesh(tmp_path / "inside" / "a.obj").mesh.albedo, [0.8, 0.2, 0.0], atol=1e-6)


def test_wrong_meshes_are_refused_with_a_sentence(tmp_path):
    broken, loud = VERTICES[:, 0].copy(), np.full(4, 1.5, np.float32)
    broken[1] = np.nan
    (tmp_path / "nan.ply").write_bytes(encode_ply(vertex_columns() | {"vertex": {**vertex_columns()["vertex"], "x": broken}}, FACES))
    (tmp_path / "loud.ply").write_bytes(encode_ply(vertex_columns(roughness=loud), FACES))
    (tmp_path / "points.ply").write_bytes(encode_ply(vertex_columns()))
    (tmp_path / "beyond.ply").write_bytes(encode_ply(vertex_columns(), FACES + 1))
    (tmp_path / "short.glb").write_bytes(b"glTF")
    (tmp_path / "empty.obj").write_text("# nothing\n")
    mesh = trimesh.Trimesh(VERTICES, FACES, process=False).export(file_type="glb")
    (tmp_path / "outside.glb").write_bytes(mesh.replace(b'"buffers":[{', b'"buffers":[{"uri":"file:///etc/passwd",', 1))
    (tmp_path / "a.stl").write_text("solid")
    cases = {
        "nan.ply": "1 vertex coordinates that are not finite", "loud.ply": "roughness spans 1.5 to 1.5; expected 0 to 1",
        "points.ply": "has no faces", "beyond.ply": "names vertex 4", "short.glb": "not a readable GLB", "empty.obj": "empty.obj",
        "outside.glb": "not a readable GLB|outside itself", "a.stl": r"expected \.glb, \.obj or \.ply", "none.ply": "does not exist",
    }  # fmt: skip
    for name, sentence in cases.items():
        with pytest.raises(ValueError, match=sentence) as caught:
            import_mesh(tmp_path / name)
        assert str(caught.value).startswith(str(tmp_path / name))


@pytest.mark.parametrize("own_corners", [False, True])
def test_sheets_of_two_sides_at_one_place_bring_a_warning(tmp_path, own_corners):
    turned = FACES[:2, [1, 0, 2]]
    vertices, faces = VERTICES, np.concatenate([FACES, turned])
    if own_corners:  # as exporters write them that give each side its normals
        vertices, faces = np.concatenate([VERTICES, VERTICES]), np.concatenate([FACES, turned + 4])
    columns = {"vertex": dict(zip("xyz", np.ascontiguousarray(vertices.T), strict=True))}
    (tmp_path / "a.ply").write_bytes(encode_ply(columns, faces))
    with pytest.warns(UserWarning, match=r"2 triangles lie on others"):
        import_mesh(tmp_path / "a.ply")


def test_triangles_that_only_share_an_edge_or_are_repeated_bring_none(tmp_path, recwarn):
    (tmp_path / "a.ply").write_bytes(encode_ply(vertex_columns(), np.concatenate([FACES, FACES[:2], FACES[2:, [1, 2, 0]]])))
    import_mesh(tmp_path / "a.ply")
    assert len(recwarn) == 0


def glb_of(accessors: list, views: list[bytes], attributes: dict, **document) -> bytes:
    """One primitive; each view is a buffer view of its own."""
    ends = np.cumsum([0, *(len(view) for view in views)]).tolist()
    primitive = {"attributes": attributes, "indices": 1} | ({"material": 0} if "materials" in document else {})
    tree = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": [{"buffer": 0, "byteOffset": start, "byteLength": len(view)} for start, view in zip(ends, views, strict=False)],
        "buffers": [{"byteLength": ends[-1]}],
        **document,
    }
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    binary = b"".join(views) + b"\0" * (-ends[-1] % 4)
    chunks = struct.pack("<2I", len(text), 0x4E4F534A) + text + struct.pack("<2I", len(binary), 0x004E4942) + binary
    return struct.pack("<3I", 0x46546C67, 2, 12 + len(chunks)) + chunks


INDICES = {"bufferView": 1, "componentType": 5125, "count": FACES.size, "type": "SCALAR"}


@pytest.mark.parametrize("base", [True, False])
def test_sparse_positions_of_a_glb_are_filled_in(base, tmp_path):
    there = np.where(np.arange(4)[:, None] % 2 == 0, VERTICES, np.float32(9 if base else 0))
    changed = {"count": 2, "indices": {"bufferView": 2, "componentType": 5123}, "values": {"bufferView": 3}}
    positions = {"componentType": 5126, "count": 4, "type": "VEC3", "sparse": changed} | ({"bufferView": 0} if base else {})
    given = [0, 1, 2, 3] if not base else [1, 3]
    changed["count"] = len(given)
    views = [there.tobytes(), FACES.astype("<u4").tobytes(), np.array(given, "<u2").tobytes(), VERTICES[given].tobytes()]
    (tmp_path / "a.glb").write_bytes(glb_of([positions, INDICES], views, {"POSITION": 0}))
    vertices = import_mesh(tmp_path / "a.glb").mesh.vertices.numpy()
    np.testing.assert_array_equal(vertices, VERTICES[:, [0, 2, 1]] * np.array([1, -1, 1], np.float32))


def textured_glb(uv: np.ndarray, component: int, use: dict) -> bytes:
    """The tetrahedron under a picture whose left half is black and whose right half is white."""
    stream = io.BytesIO()
    Image.fromarray(np.repeat(np.array([[0, 255]], np.uint8), 8, axis=1).repeat(4, axis=0)).save(stream, "PNG")
    texture = stream.getvalue() + b"\0" * (-len(stream.getvalue()) % 4)
    accessors = [
        {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
        INDICES,
        {"bufferView": 2, "componentType": component, "count": 4, "type": "VEC2"} | ({} if component == 5126 else {"normalized": True}),
    ]
    views = [VERTICES.tobytes(), FACES.astype("<u4").tobytes(), uv.tobytes(), texture]
    return glb_of(
        accessors,
        views,
        {"POSITION": 0, "TEXCOORD_0": 2},
        materials=[{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0} | use}}],
        textures=[{"source": 0}],
        images=[{"bufferView": 3, "mimeType": "image/png"}],
    )


SIDES = np.array([[0.25, 0.5], [0.75, 0.5], [0.25, 0.25], [0.75, 0.75]], np.float32)


@pytest.mark.parametrize(("dtype", "component"), [(np.float32, 5126), (np.uint8, 5121), (np.uint16, 5123)])
def test_normalised_texture_coordinates_mean_fractions(dtype, component, tmp_path):
    uv = SIDES if dtype is np.float32 else np.round(SIDES * np.iinfo(dtype).max).astype(dtype)
    (tmp_path / "a.glb").write_bytes(textured_glb(uv, component, {}))
    assert import_mesh(tmp_path / "a.glb").mesh.albedo[:, 0].tolist() == [0, 1, 0, 1]


def test_a_texture_transform_is_applied_or_refused(tmp_path):
    def moved(**transform):
        use = {"extensions": {"KHR_texture_transform": transform}}
        (tmp_path / "a.glb").write_bytes(textured_glb(SIDES, 5126, use))
        return import_mesh(tmp_path / "a.glb").mesh.albedo[:, 0].tolist()

    assert moved(offset=[0.5, 0]) == [1, 0, 1, 0]
    assert moved(scale=[0.25, 1]) == [0, 0, 0, 0]
    with pytest.raises(ValueError, match="is turned by KHR_texture_transform"):
        moved(rotation=0.5)
    with pytest.raises(ValueError, match="second set of texture coordinates"):
        moved(texCoord=1)


def test_a_triangle_fan_is_refused_and_not_left_out(tmp_path):
    accessors = [{"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"}, INDICES]
    views = [VERTICES.tobytes(), FACES.astype("<u4").tobytes()]
    meshes = [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "mode": 6}]}]
    (tmp_path / "a.glb").write_bytes(glb_of(accessors, views, {}, meshes=meshes))
    with pytest.raises(ValueError, match="1 triangle fans"):
        import_mesh(tmp_path / "a.glb")


def test_an_obj_in_latin_1_and_its_library_are_read(tmp_path):
    lines = [f"v {x} {y} {z}" for x, y, z in VERTICES] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in FACES]
    text = "# Gerät\nmtllib gerät.mtl\no Gehäuse\nusemtl gehäuse\n" + "\n".join(lines) + "\n"
    (tmp_path / "a.obj").write_bytes(text.encode("latin-1"))
    (tmp_path / "gerät.mtl").write_bytes("newmtl gehäuse\nKd 1 0 0\n".encode("latin-1"))
    mesh = import_mesh(tmp_path / "a.obj").mesh
    assert np.array_equal(mesh.vertices, VERTICES) and mesh.albedo[0].tolist() == [1, 0, 0]


def test_triangles_in_a_heap_are_refused_at_once(tmp_path):
    faces = np.repeat(FACES, 75_000, axis=0)
    (tmp_path / "a.ply").write_bytes(encode_ply(vertex_columns(), faces))
    with pytest.raises(ValueError, match=r"its 300000 triangles lie on one another"):
        import_mesh(tmp_path / "a.ply")


def test_a_vertex_far_away_is_refused(tmp_path):
    columns = {"vertex": {"x": VERTICES[:, 0] * np.float32(1e30), "y": VERTICES[:, 1], "z": VERTICES[:, 2]}}
    (tmp_path / "a.ply").write_bytes(encode_ply(columns, FACES))
    with pytest.raises(ValueError, match=r"a vertex at 1e\+30; expected coordinates up to 1e\+09"):
        import_mesh(tmp_path / "a.ply")


def with_picture(picture: bytes) -> bytes:
    """The tetrahedron under a texture of these bytes, whatever they are."""
    accessors = [
        {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
        INDICES,
        {"bufferView": 2, "componentType": 5126, "count": 4, "type": "VEC2"},
    ]
    return glb_of(
        accessors,
        [VERTICES.tobytes(), FACES.astype("<u4").tobytes(), SIDES.tobytes(), picture + b"\0" * (-len(picture) % 4)],
        {"POSITION": 0, "TEXCOORD_0": 2},
        materials=[{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        textures=[{"source": 0}],
        images=[{"bufferView": 3, "mimeType": "image/png"}],
    )


def png(width: int = 8, height: int = 4, mode: str = "L") -> bytes:
    stream = io.BytesIO()
    Image.new(mode, (width, height), 255).save(stream, "PNG")
    return stream.getvalue()


def claiming_png(width: int, height: int) -> bytes:
    """A few bytes that claim many pixels."""
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunks = [(b"IHDR", head), (b"IDAT", zlib.compress(bytes(1000))), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d)) for k, d in chunks)


@pytest.mark.parametrize(
    ("picture", "words"),
    [
        (b"<svg/>", "names a texture that cannot be read"),
        (png()[:20], "names a texture that cannot be read"),
        (png()[:-30], "damaged texture"),
        (claiming_png(20_000, 20_000), "names a texture that cannot be read"),
        (claiming_png(12_000, 12_000), "the limit is 134217728"),
    ],
)
@pytest.mark.filterwarnings("ignore::PIL.Image.DecompressionBombWarning")
def test_a_texture_is_read_or_refused_and_never_left_out(picture, words, tmp_path):
    (tmp_path / "a.glb").write_bytes(with_picture(picture))
    with pytest.raises(ValueError, match=words):
        import_mesh(tmp_path / "a.glb")


def test_all_textures_of_a_file_count_together(monkeypatch):
    monkeypatch.setattr(sample_textures, "MAX_TEXTURE_PIXELS", 70)
    first, second = (Image.new("RGB", (8, 4)) for _ in range(2))
    textures = sample_textures.Textures("a.glb")
    for image in (first, second, first):
        textures.sample(image, SIDES)
    with pytest.raises(ValueError, match=r"a\.glb: has a texture of 8x4 pixels, with which its textures have 96"):
        textures.sample(Image.new("RGB", (8, 4)), SIDES)


def test_a_tall_texture_is_sampled_as_a_whole_one_would_be():
    """Bands are of no matter to what lies on both sides of their borders."""
    texels = np.random.default_rng(0).integers(0, 256, (600, 5, 3), np.uint8)
    uv = np.random.default_rng(1).uniform(-1, 2, (5000, 2))
    x, y = uv[:, 0] * 5 - 0.5, (1 - uv[:, 1]) * 600 - 0.5
    x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
    weights = [(1 - x + x0) * (1 - y + y0), (x - x0) * (1 - y + y0), (1 - x + x0) * (y - y0), (x - x0) * (y - y0)]
    places = [(y0, x0), (y0, x0 + 1), (y0 + 1, x0), (y0 + 1, x0 + 1)]
    expected = sum(w[:, None] * texels[row % 600, column % 5] / 255 for w, (row, column) in zip(weights, places, strict=True))
    np.testing.assert_allclose(sample_textures.Textures("a").sample(Image.fromarray(texels), uv), expected, atol=1e-5)


def test_a_damaged_picture_beside_an_obj_is_named_and_a_missing_one_is_not_missed(tmp_path):
    lines = [f"v {x} {y} {z}" for x, y, z in VERTICES] + ["vt 0.5 0.5"] + [f"f {a + 1}/1 {b + 1}/1 {c + 1}/1" for a, b, c in FACES]
    (tmp_path / "a.obj").write_text("mtllib a.mtl\nusemtl m\n" + "\n".join(lines) + "\n")
    (tmp_path / "a.mtl").write_text("newmtl m\nKd 1 0 0\nmap_Kd wood.png\n")
    assert import_mesh(tmp_path / "a.obj").mesh.albedo[0].tolist() == [1, 0, 0]
    (tmp_path / "wood.png").write_bytes(b"no picture")
    with pytest.raises(ValueError, match=r"its texture 'wood\.png' is damaged"):
        import_mesh(tmp_path / "a.obj")


@pytest.mark.parametrize("face", ["f 0 1 2", "f 1 2 0", "f 1/1 0/2 2/3", "f 1 00 3 2", "f 1 2 3 0//1"])
def test_vertex_0_of_an_obj_is_no_vertex(face, tmp_path):
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 10 0\nf 1 2 3\n" + face + "\n")
    with pytest.raises(ValueError, match="vertices of an OBJ count from 1"):
        import_mesh(tmp_path / "a.obj")


@pytest.mark.parametrize(
    "changes",
    [
        {"nodes": [{"children": [1]}, {"children": [0], "mesh": 0}]},
        {"scenes": [], "scene": 5},
        {"accessors": [{"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC2"}, {"bufferView": 1} | INDICES]},
    ],
)
def test_what_is_wrong_with_a_glb_names_the_file(changes, tmp_path):
    accessors = [{"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"}, INDICES]
    views = [VERTICES.tobytes(), FACES.astype("<u4").tobytes()]
    given = changes.pop("accessors", accessors)
    (tmp_path / "a.glb").write_bytes(glb_of(given, views, {"POSITION": 0}, **changes))
    with pytest.raises(ValueError, match=r"a\.glb: is not a readable GLB"):
        import_mesh(tmp_path / "a.glb")
