"""Rigs for tests: a small writer of ASCII FBX 7.4, and the tower of two bones of write_rig.py."""

from pathlib import Path

import numpy as np

from tests.exchange.write_rig import tower

TICKS = 46186158000
"""FBX's units of time in a second."""
LINEAR, STEP = 0x4, 0x2


def values(array) -> str:
    flat = np.asarray(array).reshape(-1)
    return f"*{len(flat)} {{\n a: {','.join(repr(value) for value in flat.tolist())}\n}}"


class FbxWriter:
    """A document that grows: objects, then what connects them. Object 0 is the scene."""

    def __init__(self, up: str = "y", unit_centimeters: float = 1.0) -> None:
        axes = {"y": (1, 2, 0), "z": (2, 1, 0)}[up]
        front = {"y": 1, "z": -1}[up]
        self.settings = {
            "UpAxis": axes[0],
            "UpAxisSign": 1,
            "FrontAxis": axes[1],
            "FrontAxisSign": front,
            "CoordAxis": 0,
            "CoordAxisSign": 1,
        }
        self.unit = unit_centimeters
        self.objects: list[str] = []
        self.connections: list[str] = []

    def add(self, kind: str, name: str, sort: str, body: str = "", properties: dict | None = None) -> int:
        """Id of a new object."""
        index = 1000 + len(self.objects)
        lines = []
        for key, value in (properties or {}).items():
            sort_of_value = "KTime" if isinstance(value, int) else "Vector3D" if np.ndim(value) else "Number"
            lines.append(f'P: "{key}", "{sort_of_value}", "", "A",{",".join(repr(v) for v in np.atleast_1d(value).tolist())}\n')
        self.objects.append(f'{kind}: {index}, "{kind}::{name}", "{sort}" {{\nProperties70: {{\n{"".join(lines)}}}\n{body}\n}}\n')
        return index

    def connect(self, child: int, parent: int, name: str | None = None) -> None:
        kind = "OO" if name is None else "OP"
        self.connections.append(f'C: "{kind}",{child},{parent}' + ("" if name is None else f', "{name}"') + "\n")

    def node(self, name: str, parent: int = 0, sort: str = "Null", **properties) -> int:
        """Euler angles in degrees: `Lcl Rotation` turns about x, then y, then z."""
        index = self.add("Model", name, sort, "Version: 232", {key.replace("_", " "): value for key, value in properties.items()})
        self.connect(index, parent)
        return index

    def mesh(self, node: int, vertices: np.ndarray, polygons: list[list[int]]) -> int:
        corners = np.concatenate([[*polygon[:-1], -polygon[-1] - 1] for polygon in polygons])
        body = f"Vertices: {values(vertices)}\nPolygonVertexIndex: {values(corners)}\nGeometryVersion: 124"
        index = self.add("Geometry", "shape", "Mesh", body)
        self.connect(index, node)
        return index

    def skin(self, geometry: int, method: str = "Linear") -> int:
        index = self.add("Deformer", "skin", "Skin", f'Version: 101\nLink_DeformAcuracy: 50\nSkinningType: "{method}"')
        self.connect(index, geometry)
        return index

    def cluster(self, skin: int, bone: int, vertices, weights, bone_from_mesh: np.ndarray, world_from_bone: np.ndarray) -> None:
        """Matrices (4, 4) at bind time."""
        body = f"Version: 100\nIndexes: {values(vertices)}\nWeights: {values(weights)}\n"
        body += f"Transform: {values(bone_from_mesh.T)}\nTransformLink: {values(world_from_bone.T)}"
        index = self.add("Deformer", "cluster", "Cluster", body)
        self.connect(index, skin)
        self.connect(bone, index)

    def blend(self, geometry: int, name: str, vertices, offsets, full_weights=(100.0,), percent: float = 0.0) -> int:
        """Id of a channel with one shape, or with several in between."""
        deformer = self.add("Deformer", "blend", "BlendShape", "Version: 100")
        self.connect(deformer, geometry)
        channel = self.add(
            "Deformer", name, "BlendShapeChannel", f"Version: 100\nFullWeights: {values(full_weights)}", {"DeformPercent": percent}
        )
        self.connect(channel, deformer)
        for _ in full_weights:
            body = f"Version: 100\nIndexes: {values(vertices)}\nVertices: {values(offsets)}"
            self.connect(self.add("Geometry", name, "Shape", body), channel)
        return channel

    def animation(self, name: str, start: float = 0.0, stop: float = 0.0) -> int:
        """Id of the layer of a new animation, played from `start` to `stop` [s]."""
        span = {"LocalStart": round(start * TICKS), "LocalStop": round(stop * TICKS)}
        stack, layer = self.add("AnimationStack", name, "", "", span), self.add("AnimationLayer", name, "")
        self.connect(stack, 0)
        self.connect(layer, stack)
        return layer

    def animate(self, layer: int, target: int, name: str, times, *curves, flag: int = LINEAR) -> None:
        """Curves for x, y and z of a property, or one for a number."""
        parts = ["X", "Y", "Z"] if len(curves) == 3 else [name]
        node = self.add("AnimationCurveNode", name, "", "", {f"d|{part}": curve[0] for part, curve in zip(parts, curves, strict=True)})
        self.connect(node, layer)
        self.connect(node, target, name)
        for part, curve in zip(parts, curves, strict=True):
            body = f"KeyVer: 4009\nKeyTime: {values([round(t * TICKS) for t in times])}\nKeyValueFloat: {values(curve)}\n"
            body += f"KeyAttrFlags: {values([flag])}\nKeyAttrDataFloat: {values([0.0] * 4)}\nKeyAttrRefCount: {values([len(curve)])}"
            self.connect(self.add("AnimationCurve", "", "", body), node, f"d|{part}")

    def save(self, path: Path) -> Path:
        settings = "".join(f'P: "{key}", "int", "Integer", "",{value}\n' for key, value in self.settings.items())
        settings += f'P: "UnitScaleFactor", "double", "Number", "",{self.unit!r}\n'
        path.write_text(
            "; FBX 7.4.0 project file\nFBXHeaderExtension: {\nFBXHeaderVersion: 1003\nFBXVersion: 7400\n}\n"
            f"GlobalSettings: {{\nVersion: 1000\nProperties70: {{\n{settings}}}\n}}\n"
            f"Objects: {{\n{''.join(self.objects)}}}\nConnections: {{\n{''.join(self.connections)}}}\n"
        )
        return path


def shifted(*by: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, 3] = by
    return matrix


def two_bones_in_fbx(height: float = 2.0, radius: float = 0.3, rings: int = 9) -> FbxWriter:
    """`write_rig.two_bones` in centimetres and z up, with its animation "Bend" and its faces.

    glTF's (x, y, z) are (x, -z, y) here: what turns about z there turns about -y.
    """
    writer = FbxWriter("z", 1.0)
    vertices, faces = tower(rings, height, radius)
    share = np.clip((vertices[:, 1] / height - 0.25) * 2, 0, 1)
    places = 100 * np.stack([vertices[:, 0], -vertices[:, 2], vertices[:, 1]], -1)
    root = writer.node("root", sort="LimbNode")
    upper = writer.node("upper", root, "LimbNode", Lcl_Translation=(0, 0, 50 * height))
    body = writer.node("body", sort="Mesh")
    shape = writer.mesh(body, places, faces.tolist())
    skin = writer.skin(shape)
    middle = shifted(0, 0, 50 * height)
    for bone, weights, world_from_bone in ((root, 1 - share, np.eye(4)), (upper, share, middle)):
        held = np.flatnonzero(weights)
        writer.cluster(skin, bone, held, weights[held], np.linalg.inv(world_from_bone), world_from_bone)
    layer = writer.animation("Bend")
    writer.animate(layer, upper, "Lcl Rotation", [0, 1], [0.0, 0.0], [0.0, -90.0], [0.0, 0.0])
    return writer
