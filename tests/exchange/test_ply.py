import numpy as np
import pytest

from drgs.exchange.gaussian_ply import decode_gaussian_ply, encode_gaussian_ply
from drgs.exchange.ply import encode_ply, parse_ply, triangles_from_faces

ASCII_QUAD = b"""ply
format ascii 1.0
comment made by hand
element vertex 4
property float x
property double y
property uchar red
element face 2
property list uchar int vertex_indices
property float quality
end_header
0 0.25 255
1 0 0
1 1 7
0 1 9
4 0 1 2 3 0.5
3 0 1 2 1.5
"""


def gaussian_arrays(count: int = 7) -> dict[str, np.ndarray]:
    random = np.random.default_rng(1)
    shapes = {
        "centers": (3,),
        "log_scales": (2,),
        "quats_wxyz": (4,),
        "opacity_logits": (),
        "sh": (16, 3),
        "albedo": (3,),
        "roughness": (),
        "metallic": (),
    }
    return {key: random.normal(size=(count, *shape)).astype(np.float32) for key, shape in shapes.items()}


def test_columns_and_faces_survive_writing_and_reading_bit_for_bit():
    random = np.random.default_rng(0)
    columns = {
        "x": random.normal(size=5).astype("f4"),
        "time": random.normal(size=5),
        "tag": np.arange(5, dtype="u1"),
        "id": np.arange(5, dtype="i4"),
    }
    faces = np.array([[0, 1, 2], [2, 3, 4]], np.int32)
    ply = parse_ply(encode_ply({"vertex": columns}, faces, ["two words"]))
    for name, values in columns.items():
        read = ply.elements["vertex"].scalars[name]
        assert read.dtype == values.dtype and np.array_equal(read, values)
    assert np.array_equal(triangles_from_faces(ply, 5), faces)
    assert ply.comments == ("two words",)


def test_ascii_with_polygons_and_mixed_columns_is_read():
    ply = parse_ply(ASCII_QUAD)
    assert ply.elements["vertex"].scalars["y"].tolist() == [0.25, 0, 1, 1]
    assert ply.elements["vertex"].scalars["red"].tolist() == [255, 0, 7, 9]
    assert ply.elements["face"].scalars["quality"].tolist() == [0.5, 1.5]
    assert sorted(triangles_from_faces(ply, 4).tolist()) == [[0, 1, 2], [0, 1, 2], [0, 2, 3]]


@pytest.mark.parametrize("order", ["<", ">"])
def test_binary_polygons_of_unequal_length_are_read_in_either_byte_order(order):
    word = {"<": "little", ">": "big"}[order]
    head = f"ply\nformat binary_{word}_endian 1.0\nelement face 2\nproperty list uchar int vertex_index\nproperty short tag\nend_header\n"
    body = b"".join(
        np.uint8(len(polygon)).tobytes() + np.array(polygon, order + "i4").tobytes() + np.array(tag, order + "i2").tobytes()
        for polygon, tag in [([0, 1, 2], -3), ([3, 2, 1, 0], 300)]
    )
    ply = parse_ply(head.encode() + body)
    assert ply.elements["face"].scalars["tag"].tolist() == [-3, 300]
    assert triangles_from_faces(ply, 4).tolist() == [[0, 1, 2], [3, 2, 1], [3, 1, 0]]


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (lambda data: data[:-4], "truncated"),
        (lambda data: data.replace(b"ply", b"pyl", 1), "is not a PLY"),
        (lambda data: data.replace(b"element vertex 4", b"element vertex 99999999"), "beyond the limit"),
        (lambda data: data.replace(b"property float x", b"property half x"), "not understood"),
        (lambda data: data.replace(b"end_header", b"end_head"), "no end_header"),
        (lambda data: data.replace(b"property float x", b"property float y"), "repeats a property"),
        (lambda data: data.replace(b"255", b"red"), "no number"),
        (lambda data: data.replace(b"4 0 1 2 3", b"-4 0 1 2 3"), "not the length"),
    ],
)
def test_a_damaged_file_is_refused_with_its_name_and_the_fault(damage, sentence):
    with pytest.raises(ValueError, match=rf"^cube\.ply: .*{sentence}"):
        parse_ply(damage(ASCII_QUAD), "cube.ply")


def test_a_truncated_binary_file_and_a_face_beyond_the_vertices_are_refused():
    data = encode_ply({"vertex": {"x": np.zeros(3, "f4")}}, np.array([[0, 1, 3]]))
    with pytest.raises(ValueError, match="truncated"):
        parse_ply(data[:-1])
    with pytest.raises(ValueError, match="names vertex 3, but there are 3"):
        triangles_from_faces(parse_ply(data), 3)


def test_gaussians_survive_writing_and_reading_bit_for_bit():
    arrays = gaussian_arrays()
    read = decode_gaussian_ply(encode_gaussian_ply(arrays, np.zeros((7, 3), np.float32)))
    assert read.keys() == arrays.keys()
    for name, values in arrays.items():
        assert values.tobytes() == np.ascontiguousarray(read[name]).tobytes(), name


def test_gaussian_columns_follow_the_splatting_convention():
    arrays = gaussian_arrays()
    ply = parse_ply(encode_gaussian_ply(arrays, np.zeros((7, 3), np.float32)))
    vertex = ply.elements["vertex"].scalars
    expected = [
        "x",
        "y",
        "z",
        "nx",
        "ny",
        "nz",
        *(f"f_dc_{k}" for k in range(3)),
        *(f"f_rest_{k}" for k in range(45)),
        "opacity",
        "scale_0",
        "scale_1",
    ]
    assert list(vertex) == [*expected, *(f"rot_{k}" for k in range(4)), *(f"base_color_{k}" for k in range(3)), "metallic", "roughness"]
    assert np.array_equal(vertex["f_rest_0"], arrays["sh"][:, 1, 0])
    assert np.array_equal(vertex["f_rest_15"], arrays["sh"][:, 1, 1])  # channel-major: green starts after red's 15
    assert "SplatRenderMode: 2dgs" in ply.comments
    assert any("activated" in comment for comment in ply.comments)


def test_the_variant_for_3dgs_viewers_has_a_flat_third_scale_and_reads_back():
    arrays = gaussian_arrays()
    data = encode_gaussian_ply(arrays, np.zeros((7, 3), np.float32), third_scale=True)
    ply = parse_ply(data)
    assert (ply.elements["vertex"].scalars["scale_2"] < np.log(1e-5)).all()
    assert not any("SplatRenderMode" in comment for comment in ply.comments)
    assert np.array_equal(decode_gaussian_ply(data)["log_scales"], arrays["log_scales"])


def test_surfels_far_smaller_than_the_object_stay_flat_for_3dgs_viewers():
    arrays = gaussian_arrays()
    arrays["log_scales"][:, 0] = np.log(1e-5 * np.ptp(arrays["centers"], axis=0).max())
    data = encode_gaussian_ply(arrays, np.zeros((7, 3), np.float32), third_scale=True)
    assert np.array_equal(decode_gaussian_ply(data)["log_scales"], arrays["log_scales"])


def test_round_gaussians_missing_columns_and_nan_are_refused():
    arrays = gaussian_arrays()
    normals = np.zeros((7, 3), np.float32)
    columns = dict(parse_ply(encode_gaussian_ply(arrays, normals)).elements["vertex"].scalars)
    with pytest.raises(ValueError, match="3D Gaussians"):
        decode_gaussian_ply(encode_ply({"vertex": columns | {"scale_2": columns["scale_0"]}}))
    with pytest.raises(ValueError, match="lacks the columns rot_2"):
        decode_gaussian_ply(encode_ply({"vertex": {key: values for key, values in columns.items() if key != "rot_2"}}))
    arrays["roughness"][3] = np.nan
    with pytest.raises(ValueError, match="'roughness' holds 1 values that are not finite"):
        decode_gaussian_ply(encode_gaussian_ply(arrays, normals))


def test_a_plain_splat_of_lower_degree_gets_zero_bands_and_default_materials():
    columns = parse_ply(encode_gaussian_ply(gaussian_arrays(), np.zeros((7, 3), np.float32))).elements["vertex"].scalars
    kept = {
        k: v
        for k, v in columns.items()
        if not k.startswith(("base_", "metallic", "roughness")) and not (k.startswith("f_rest_") and int(k[7:]) > 8)
    }
    read = decode_gaussian_ply(encode_ply({"vertex": kept}))
    assert np.array_equal(read["sh"][:, 3, 1], columns["f_rest_5"]) and not read["sh"][:, 4:].any()
    assert (read["albedo"] == 0.5).all() and (read["roughness"] == 0.5).all() and not read["metallic"].any()
