"""Numbers at the ends of what JSON can say: each edit that holds one is refused in a sentence, or poses the object with finite numbers."""

import copy
from collections.abc import Iterator
from typing import Any

import pytest
import torch

from drgs.deform.matter.simulation_scene import make_material, parse_simulation_scene
from drgs.deform.pose_scene import pose_scene
from drgs.scene.edits import parse_edits
from tests.deform.test_pose_scene import plate_asset

EXTREMES = (1e-320, -1e-320, 1e-30, 1e9, -1e9, 1e38, -1e38, 1e308, float("inf"), float("nan"), 10**400, 2**31, -1)
EDITS: list[dict] = [
    {"op": "material", "select": {"sphere": {"center": [0.0, 0.0, 0.0], "radius": 1.0, "falloff": 0.5}}, "set": {"roughness": 0.5}},
    {"op": "material", "select": {"box": {"minimum": [0.0] * 3, "maximum": [1.0] * 3, "falloff": 0.5}}, "set": {"albedo": [0.5] * 3}},
    {"op": "material", "select": {"similar": {"point": [0.0] * 3, "tolerance": 0.5}}, "set": {"metallic": 0.5}},
    {"op": "material", "select": {"region": 0}, "set": {"roughness": 2.0}, "mode": "multiply"},
    {"op": "environment", "rotation": 30.0, "intensity": 2.0},
    {"op": "deform", "map": {"type": "twist", "rate": 0.5}},
    {"op": "deform", "map": {"type": "bend", "curvature": 0.5}},
    {"op": "deform", "map": {"type": "stretch", "factor": 1.5}},
    {"op": "deform", "handles": {"drag": [{"point": [0.0] * 3, "radius": 0.3, "target": [0.0, 0.0, 1.0], "turn": [0.0, 0.0, 10.0]}]}},
]
SCENES: list[dict] = [
    {"matter": {"preset": "jelly", "density": 1000.0, "young_modulus": 1e5, "poisson_ratio": 0.3}},
    {"matter": {"law": "von_mises", "density": 1000.0, "yield_stress": 1e4, "hardening": 0.5}},
    {"matter": {"law": "fluid", "density": 1000.0, "bulk_modulus": 1e5, "exponent": 7.0, "viscosity": 1.0}},
    {"matter": {"law": "drucker_prager", "density": 1000.0, "friction_angle": 30.0}},
    {"gravity": 9.81, "duration": 1.0, "fps": 24.0, "particles": 100, "damping": 0.5, "courant": 0.4, "seed": 3},
    {
        "acts": [
            {"shape": {"sphere": {"center": [0.0] * 3, "radius": 1.0}}, "friction": 0.5, "velocity": [0.0] * 3, "start": 0.5, "end": 1.0}
        ]
    },
]


def with_each_number_replaced(document: Any, number: float) -> Iterator[Any]:
    """The document once for each number in it."""

    def places(node: Any, way: tuple) -> Iterator[tuple]:
        if isinstance(node, dict | list):
            for key, inner in node.items() if isinstance(node, dict) else enumerate(node):
                yield from places(inner, (*way, key))
        elif isinstance(node, int | float):
            yield way

    for way in places(document, ()):
        changed = copy.deepcopy(document)
        node = changed
        for key in way[:-1]:
            node = node[key]
        node[way[-1]] = number
        yield changed


@pytest.mark.parametrize("number", EXTREMES, ids=[str(number)[:8] for number in EXTREMES])
def test_extreme_edits_are_refused_or_finite(number: float) -> None:
    asset = plate_asset()
    for edit in EDITS:
        for changed in with_each_number_replaced(edit, number):
            try:
                scene = pose_scene(asset, parse_edits([changed]))
            except ValueError as refusal:
                assert len(str(refusal)) < 1000, changed
                continue
            mesh = scene.mesh
            for values in (mesh.vertices, mesh.normals, mesh.albedo, mesh.roughness, mesh.metallic):
                assert torch.isfinite(values).all(), changed


@pytest.mark.parametrize("number", EXTREMES, ids=[str(number)[:8] for number in EXTREMES])
def test_extreme_matter_is_refused_or_has_finite_constants(number: float) -> None:
    for scene in SCENES:
        for changed in with_each_number_replaced(scene, number):
            try:
                material = make_material(parse_simulation_scene(changed).matter, 1.0, 1.0)
            except ValueError:
                continue
            assert all(abs(value) < 1e38 for value in (*material.parameters, material.wave_speed)), changed
