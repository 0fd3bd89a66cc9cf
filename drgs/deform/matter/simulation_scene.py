"""What is simulated, as plain data: matter, gravity, floor, things that hold or push. One schema for sim.json and for edits.

Lengths and positions are in world units and refer to the object at rest; material constants are in SI units, and the asset's metres
per unit convert them. A preset needs no constants: its stiffness follows the object's size, E / (rho g L) being what one sees.
"""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

import torch
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from drgs.deform.matter.measure_solid import measure_solid, read_collider
from drgs.deform.matter.mpm.records import Box, Condition, Law, Material, Plane, Solid, Sphere
from drgs.scene.edits import Coordinate, Index, Length, Triple

EARTH = 9.81
"""m/s^2: what presets are made for, whatever gravity the scene has."""
Preset = Literal["jelly", "rubber", "clay", "sand", "snow", "honey"]
Density = Annotated[float, Field(ge=1e-3, le=1e6)]
"""kg/m^3: from thin air to beyond any solid."""
Modulus = Annotated[float, Field(ge=1e-3, le=1e13)]
"""Pa: from foam to beyond diamond."""
Pressure = Annotated[float, Field(ge=0, le=1e13)]
Friction = Annotated[float, Field(ge=0, le=1e3)]
Moment = Annotated[float, Field(ge=0, le=1e6)]
"""Seconds."""


class _Plain(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class Matter(_Plain):
    """A preset, a law with constants, or a preset with some constants changed."""

    preset: Preset | None = None
    law: Law | None = None
    density: Density | None = None
    """kg/m^3."""
    young_modulus: Modulus | None = None
    """Pa."""
    poisson_ratio: Annotated[float, Field(ge=0, le=0.49)] | None = None
    yield_stress: Pressure | None = None
    """Pa; von_mises."""
    hardening: Annotated[float, Field(ge=0, le=1e3)] | None = None
    friction_angle: Annotated[float, Field(ge=0, lt=90)] | None = None
    """Degrees; drucker_prager."""
    bulk_modulus: Modulus | None = None
    """Pa; fluid."""
    exponent: Annotated[float, Field(gt=1, le=100)] | None = None
    viscosity: Annotated[float, Field(ge=0, le=1e9)] | None = None
    """Pa s; fluid."""

    @model_validator(mode="after")
    def _says_what_it_is(self) -> "Matter":
        if self.preset is None and self.law is None:
            raise ValueError("matter has a preset or a law; found neither")
        return self


class PlaneShape(_Plain):
    point: Triple
    normal: Triple


class SphereShape(_Plain):
    center: Triple
    radius: Length


class BoxShape(_Plain):
    minimum: Triple
    maximum: Triple


class MeshShape(_Plain):
    """A closed triangle mesh: a file, or its arrays. Parts thinner than two cells of the simulation do not hold matter back."""

    file: str | None = None
    """OBJ or PLY (world units, z up), or an asset's folder. For those who simulate where the files are; not over a network."""
    vertices: Annotated[list[Triple], Field(min_length=4, max_length=20_000)] | None = None
    """World units."""
    faces: Annotated[list[tuple[Index, Index, Index]], Field(min_length=4, max_length=40_000)] | None = None
    offset: Triple = (0.0, 0.0, 0.0)
    """Where the mesh's origin comes to lie [world units]."""

    @model_validator(mode="after")
    def _one_source(self) -> "MeshShape":
        if (self.file is None) == (self.vertices is None) or (self.vertices is None) != (self.faces is None):
            raise ValueError("a mesh is either a file, or vertices and faces")
        return self


class Shape(_Plain):
    """Exactly one field is set."""

    plane: PlaneShape | None = None
    sphere: SphereShape | None = None
    box: BoxShape | None = None
    mesh: MeshShape | None = None

    @model_validator(mode="after")
    def _exactly_one(self) -> "Shape":
        given = [name for name in type(self).model_fields if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"a shape is exactly one of plane, sphere, box, mesh; found {given or 'none'}")
        return self


class Region(_Plain):
    """Another matter in a part of the object, at rest."""

    shape: Shape
    matter: Matter


class Act(_Plain):
    """Something that holds, guides, stops or pushes matter inside a shape (see Condition)."""

    shape: Shape
    effect: Literal["sticky", "slip", "separate", "push"] = "separate"
    friction: Friction = 0.0
    velocity: Triple = (0.0, 0.0, 0.0)
    """World units/s; for push, an acceleration."""
    start: Moment = 0.0
    end: Annotated[float, Field(gt=0, le=1e6)] | None = None
    """Seconds."""


class Floor(_Plain):
    height: Coordinate | None = None
    """Along the up axis [world units]; None: where the object stands."""
    effect: Literal["sticky", "slip", "separate"] = "separate"
    friction: Friction = 0.5


class SimulationScene(_Plain):
    matter: Matter = Matter(preset="jelly")
    regions: list[Region] = Field(default_factory=list, max_length=64)
    """The last that holds a particle counts."""
    gravity: Annotated[float, Field(ge=0, le=1000)] = EARTH
    """m/s^2."""
    up: Literal["x", "y", "z"] = "z"
    floor: Floor | None = Floor()
    acts: list[Act] = Field(default_factory=list, max_length=64)
    pins: list[Index] = Field(default_factory=list, max_length=200_000)
    """Vertices of the mesh that stay where they are, and the matter near them."""
    velocity: Triple = (0.0, 0.0, 0.0)
    """Of the whole object at the start [world units/s]."""
    spin: Triple = (0.0, 0.0, 0.0)
    """Of the whole object about its centre at the start [radians/s]."""
    duration: Annotated[float, Field(gt=0, le=60)] = 2.0
    """Seconds."""
    fps: Annotated[float, Field(ge=1, le=240)] = 24.0
    particles: Annotated[int, Field(ge=1, le=4_000_000)] = 20_000
    room: BoxShape | None = None
    """Matter cannot leave it; None: three times the object's size on every side."""
    damping: Annotated[float, Field(ge=0, le=100)] = 0.0
    """Decay of all velocities [1/s]."""
    courant: Annotated[float, Field(gt=0, le=0.9)] = 0.4
    variant: Literal["corrected", "paper"] = "corrected"
    """paper: PIC transfers, all vertices as massive particles, and Algorithm 3, centred, for the surfels."""
    seed: Annotated[int, Field(ge=0, le=2**31 - 1)] = 0


def parse_simulation_scene(data: object) -> SimulationScene:
    """Validate plain data or JSON text.

    Raises:
        ValueError: one sentence naming the first wrong field.
    """
    try:
        if isinstance(data, str | bytes):
            return SimulationScene.model_validate_json(data)
        return SimulationScene.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        raise ValueError(f"simulation scene: {'.'.join(map(str, first['loc'])) or 'document'}: {first['msg']}") from error


def make_material(matter: Matter, size: float, meters_per_unit: float) -> Material:
    """Constants in world units (kg, s, unit) of matter that makes an object of this size [world units].

    Stiffness of presets: E = number x rho g L; the weight alone then presses a column of jelly to 95 % of its height.
    """
    weight = EARTH / meters_per_unit * size  # g L
    density = (matter.density or _PRESETS[matter.preset or "jelly"]["density"]) * meters_per_unit**3
    values: dict = {"law": matter.law or "fixed_corotated", "density": density, "young_modulus": 10 * density * weight}
    if matter.preset is not None:
        given = _PRESETS[matter.preset]
        values |= {"law": given["law"], "young_modulus": given.get("stiffness", 10) * density * weight}
        values |= {name: given[name] for name in ("poisson_ratio", "friction_angle", "hardening") if name in given}
        if "yield" in given:
            values["yield_stress"] = given["yield"] * density * weight
        if "reynolds" in given:
            # Sound ten times as fast as waves of this length, and the viscosity of a spoonful at whatever size.
            values |= {"bulk_modulus": density * 100 * weight / 7, "viscosity": density * size * math.sqrt(weight) / given["reynolds"]}
    if matter.law == "fluid" and matter.preset is None:
        values["bulk_modulus"] = density * 100 * weight / 7
    if matter.law is not None:
        values["law"] = matter.law
    for name in ("young_modulus", "yield_stress", "bulk_modulus", "viscosity"):  # Pa and Pa s: kg / (m s^2), kg / (m s)
        if getattr(matter, name) is not None:
            values[name] = getattr(matter, name) * meters_per_unit
    for name in ("poisson_ratio", "hardening", "friction_angle", "exponent"):
        if getattr(matter, name) is not None:
            values[name] = getattr(matter, name)
    return Material(**values)


_PRESETS: dict[str, dict] = {
    "jelly": {"law": "fixed_corotated", "density": 1000.0, "stiffness": 10.0, "poisson_ratio": 0.3},
    "rubber": {"law": "neo_hookean", "density": 1100.0, "stiffness": 100.0, "poisson_ratio": 0.4},
    "clay": {"law": "von_mises", "density": 1800.0, "stiffness": 100.0, "poisson_ratio": 0.3, "yield": 0.7},
    "sand": {"law": "drucker_prager", "density": 1600.0, "stiffness": 100.0, "poisson_ratio": 0.2, "friction_angle": 35.0},
    "snow": {"law": "snow", "density": 400.0, "stiffness": 60.0, "poisson_ratio": 0.2},
    "honey": {"law": "fluid", "density": 1400.0, "reynolds": 14.0},
}
"""stiffness and yield in units of rho g L."""


Files = Callable[[str], Path]
"""Finds what a scene calls by name, or refuses with a ValueError."""


def refuse_files(name: str) -> Path:
    """For scenes from strangers, and for those that belong to no folder."""
    raise ValueError(f"the simulation scene names the file {name!r}; here a mesh is given by its vertices and faces")


def mesh_files(scene: SimulationScene) -> list[str]:
    """The files that a scene names."""
    shapes = [act.shape for act in scene.acts] + [region.shape for region in scene.regions]
    return [shape.mesh.file for shape in shapes if shape.mesh is not None and shape.mesh.file is not None]


def make_condition(act: Act, dx: float, find: Files = refuse_files) -> Condition:
    """The condition of an act on a grid of spacing dx; `find` opens the files that it names."""
    shape = make_shape(act.shape, dx, find)
    return Condition(shape, act.effect, act.friction, act.velocity, act.start, math.inf if act.end is None else act.end)


def make_shape(shape: Shape, dx: float, find: Files = refuse_files) -> Plane | Sphere | Box | Solid:
    if shape.plane is not None:
        return Plane(shape.plane.point, shape.plane.normal)
    if shape.sphere is not None:
        return Sphere(shape.sphere.center, shape.sphere.radius)
    if shape.mesh is not None:
        mesh = shape.mesh
        if mesh.file is not None:
            vertices, faces = read_collider(find(mesh.file))
        else:
            vertices, faces = torch.tensor(mesh.vertices), torch.tensor(mesh.faces)
        return measure_solid(vertices.double() + torch.tensor(mesh.offset, dtype=torch.float64), faces, dx)
    assert shape.box is not None
    return Box(shape.box.minimum, shape.box.maximum)
