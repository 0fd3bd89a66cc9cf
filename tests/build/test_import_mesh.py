import json
import struct

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from drgs.build.import_mesh import import_mesh
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
