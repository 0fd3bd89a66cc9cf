"""Make the sample capture: a procedural object photographed by Mitsuba, an independent path tracer.

The object is one closed surface, the level set of a signed distance: a glazed ring around a gold ball, on a turned stoneware
foot with a brushed copper band. Four materials, each vertex taking the one of the nearest part. The light is
env/daylight_room.exr, painted by examples/environments/make_environments.py.

    pip install mitsuba==3.9.1
    python examples/sample_capture/make_sample_capture.py            # everything; minutes
    python examples/sample_capture/make_sample_capture.py --spp 16 --views 4 --out out/sample_capture   # a look

With Debian's libllvm19 and DRJIT_LIBLLVM_PATH set, the LLVM variant is used, about three times as fast as the scalar one.
"""

import argparse
import json
import os
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np
from PIL import Image
from skimage.measure import marching_cubes

from drgs.maths.color_numpy import srgb_from_linear

mi.set_variant("llvm_ad_rgb" if os.environ.get("DRJIT_LIBLLVM_PATH") else "scalar_rgb")

HERE = Path(__file__).parent
SIZE = 256
ANGLE_X = 0.55
"""Horizontal field of view [rad]."""
DISTANCE = 3.75
TRAIN_VIEWS, TEST_VIEWS = 56, 6
CELLS = 176
"""Voxels along an edge of the box in which the surface is found."""


@dataclass(frozen=True)
class Material:
    base_color: tuple[float, float, float]
    """Linear."""
    roughness: float
    metallic: float


STONEWARE = Material((0.62, 0.56, 0.47), 0.75, 0.0)
STONEWARE_DARK = Material((0.16, 0.14, 0.15), 0.75, 0.0)
COPPER = Material((0.93, 0.52, 0.37), 0.32, 1.0)
GOLD = Material((1.0, 0.76, 0.34), 0.12, 1.0)
GLAZE = Material((0.02, 0.19, 0.24), 0.13, 0.0)
GLAZE_LIGHT = Material((0.72, 0.60, 0.42), 0.13, 0.0)


def smooth_union(a: np.ndarray, b: np.ndarray, radius: float) -> np.ndarray:
    """Smallest of two distances, the seam filleted (polynomial smooth minimum, Quilez 2013)."""
    h = np.clip(0.5 + 0.5 * (b - a) / radius, 0, 1)
    return b + (a - b) * h - radius * h * (1 - h)


def ring(p: np.ndarray) -> np.ndarray:
    """A standing torus whose rounded-square cross-section turns three quarters around while it goes round once."""
    x, y, z = p[..., 0], p[..., 1], p[..., 2] - 0.26
    around = np.arctan2(z, x)
    radial, side = np.hypot(x, z) - 0.47, y
    turn = 0.75 * around
    c, s = np.cos(turn), np.sin(turn)
    u, v = np.abs(c * radial - s * side) - 0.075, np.abs(s * radial + c * side) - 0.075
    outside = np.hypot(np.maximum(u, 0), np.maximum(v, 0))
    return 0.9 * (outside + np.minimum(np.maximum(u, v), 0) - 0.075)


def ball(p: np.ndarray) -> np.ndarray:
    return np.linalg.norm(p - np.array([0, 0, 0.165]), axis=-1) - 0.235


def foot(p: np.ndarray) -> np.ndarray:
    """A turned foot: a plate, a waist, and a shallow dish the ring stands in."""
    radius, z = np.hypot(p[..., 0], p[..., 1]), p[..., 2]

    def disc(height: float, disc_radius: float, half_thickness: float, rounding: float) -> np.ndarray:
        a, b = radius - (disc_radius - rounding), np.abs(z - height) - (half_thickness - rounding)
        return np.hypot(np.maximum(a, 0), np.maximum(b, 0)) + np.minimum(np.maximum(a, b), 0) - rounding

    body = smooth_union(disc(-0.80, 0.46, 0.055, 0.05), disc(-0.58, 0.20, 0.20, 0.05), 0.12)
    body = smooth_union(body, disc(-0.35, 0.42, 0.07, 0.06), 0.12)
    hollow = np.linalg.norm(p - np.array([0, 0, 0.42]), axis=-1) - 0.77
    return np.maximum(body, -hollow)


def band(p: np.ndarray) -> np.ndarray:
    radius, z = np.hypot(p[..., 0], p[..., 1]), p[..., 2]
    return np.hypot(radius - 0.235, z + 0.585) - 0.055


def parts(p: np.ndarray) -> np.ndarray:
    """(..., 4) signed distances: ring, ball, foot, band."""
    return np.stack([ring(p), ball(p), foot(p), band(p)], -1)


def build_mesh() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (v, 3), normals (v, 3), faces (f, 3), and materials (v, 5) = base colour, roughness, metallic."""
    low, cell = -1.0, 2.0 / CELLS
    axis = low + cell * np.arange(CELLS + 1)
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)
    distance = parts(grid).min(-1)
    vertices, faces, _, _ = marching_cubes(distance, 0.0)
    vertices = low + cell * vertices
    step = 1e-4
    gradient = [(parts(vertices + step * e).min(-1) - parts(vertices - step * e).min(-1)) for e in np.eye(3)]
    normals = np.stack(gradient, -1)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    corners = vertices[faces]
    if np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) < 0:
        faces = faces[:, ::-1]
    return vertices, normals, faces, vertex_materials(vertices)


def vertex_materials(vertices: np.ndarray) -> np.ndarray:
    """(v, 5) base colour, roughness, metallic of the nearest part; ring and foot carry a pattern."""
    nearest = parts(vertices).argmin(-1)
    around = np.arctan2(vertices[:, 2] - 0.26, vertices[:, 0])
    light_stripe = np.sin(5 * around + 6 * vertices[:, 1]) > 0.72
    dark_dish = (vertices[:, 2] > -0.44) & (np.hypot(vertices[:, 0], vertices[:, 1]) < 0.37)
    materials = np.zeros((len(vertices), 5))
    for mask, material in (
        ((nearest == 0) & ~light_stripe, GLAZE),
        ((nearest == 0) & light_stripe, GLAZE_LIGHT),
        (nearest == 1, GOLD),
        ((nearest == 2) & ~dark_dish, STONEWARE),
        ((nearest == 2) & dark_dish, STONEWARE_DARK),
        (nearest == 3, COPPER),
    ):
        materials[mask] = [*material.base_color, material.roughness, material.metallic]
    return materials


def camera_positions(count: int, phase: float) -> np.ndarray:
    """(count, 3) spread evenly (Fibonacci) over the sphere between 40 degrees below and 72 degrees above the horizon."""
    k = np.arange(count) + 0.5
    low, high = np.sin(np.radians(-40)), np.sin(np.radians(72))
    z = high + (low - high) * k / count
    azimuth = np.pi * (1 + 5**0.5) * k + phase
    radius = np.sqrt(1 - z * z)
    return DISTANCE * np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], -1)


def world_from_opengl(position: np.ndarray) -> np.ndarray:
    """(4, 4) camera at `position` looking at the origin down its -z, world z up."""
    back = position / np.linalg.norm(position)
    right = np.cross([0, 0, 1.0], back)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, :4] = np.stack([right, np.cross(back, right), back, position], -1)
    return matrix


def mitsuba_scene(environment: Path) -> mi.Scene:
    vertices, normals, faces, materials = build_mesh()
    mesh = mi.Mesh("object", len(vertices), len(faces), has_vertex_normals=True, props=_principled_from_vertices())
    mesh.add_attribute("vertex_base_color", 3, materials[:, :3].astype(np.float32).ravel())
    mesh.add_attribute("vertex_roughness", 1, materials[:, 3].astype(np.float32))
    mesh.add_attribute("vertex_metallic", 1, materials[:, 4].astype(np.float32))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = vertices.astype(np.float32).ravel()
    parameters["vertex_normals"] = normals.astype(np.float32).ravel()
    parameters["faces"] = np.ascontiguousarray(faces, dtype=np.uint32).ravel()
    parameters.update()
    # Mitsuba's own mapping has y up; this turns it into ours.
    to_world = mi.ScalarTransform4f([[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    return mi.load_dict({
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 6, "hide_emitters": True},
        "object": mesh,
        "environment": {"type": "envmap", "filename": str(environment), "to_world": to_world},
    })  # fmt: skip


def _principled_from_vertices() -> mi.Properties:
    def attribute(name: str) -> dict:
        return {"type": "mesh_attribute", "name": name}

    bsdf = mi.load_dict({
        "type": "principled", "specular": 0.5, "base_color": attribute("vertex_base_color"),
        "roughness": attribute("vertex_roughness"), "metallic": attribute("vertex_metallic"),
    })  # fmt: skip
    properties = mi.Properties()
    properties["mesh_bsdf"] = bsdf
    return properties


def render(scene: mi.Scene, matrix: np.ndarray, spp: int, seed: int) -> np.ndarray:
    """(SIZE, SIZE, 4) straight-alpha sRGB, 8 bit."""
    # Mitsuba's cameras look down +z with x to the left.
    to_world = mi.ScalarTransform4f((matrix @ np.diag([-1.0, 1.0, -1.0, 1.0])).tolist())
    sensor = mi.load_dict({
        "type": "perspective", "fov": float(np.degrees(ANGLE_X)), "fov_axis": "x", "to_world": to_world,
        "film": {"type": "hdrfilm", "width": SIZE, "height": SIZE, "pixel_format": "rgba", "rfilter": {"type": "box"}},
        "sampler": {"type": "independent", "sample_count": spp},
    })  # fmt: skip
    premultiplied = np.array(mi.render(scene, sensor=sensor, spp=spp, seed=seed), dtype=np.float64)
    alpha = np.clip(premultiplied[..., 3:], 0, 1)
    linear = np.clip(premultiplied[..., :3] / np.maximum(alpha, 1e-6), 0, 1)
    return np.round(np.concatenate([np.where(alpha > 0, srgb_from_linear(linear), 0), alpha], -1) * 255).astype(np.uint8)


def write_split(scene: mi.Scene, out: Path, split: str, positions: np.ndarray, spp: int, seed: int) -> None:
    """The PNGs and transforms_{split}.json, in NeRF-synthetic's layout."""
    (out / split).mkdir(parents=True, exist_ok=True)
    frames = []
    for index, position in enumerate(positions):
        matrix = world_from_opengl(position)
        rgba = render(scene, matrix, spp, seed + index)
        Image.fromarray(rgba).save(out / split / f"r_{index:03d}.png", optimize=True)
        frames.append({"file_path": f"./{split}/r_{index:03d}", "transform_matrix": np.round(matrix, 9).tolist()})
        print(f"{split} {index + 1}/{len(positions)}", flush=True)
    (out / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": ANGLE_X, "frames": frames}, indent=1) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=HERE)
    parser.add_argument("--spp", type=int, default=256)
    parser.add_argument("--views", type=int, default=TRAIN_VIEWS)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    scene = mitsuba_scene(HERE / "env" / "daylight_room.exr")
    write_split(scene, arguments.out, "train", camera_positions(arguments.views, 0.0), arguments.spp, arguments.seed)
    write_split(scene, arguments.out, "test", camera_positions(TEST_VIEWS, 1.0), arguments.spp, arguments.seed + 10_000)


if __name__ == "__main__":
    main()
