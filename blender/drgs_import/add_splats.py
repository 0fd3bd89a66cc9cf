"""2D Gaussians as points, which Geometry Nodes lay discs on: as the camera of the capture saw them, in the light of the capture.

Each disc is a square of three standard deviations to every side, whose opacity falls off as the Gaussian does, and which sends out its mean radiance.
"""

import bpy
import numpy as np

from .read_asset import Splats

EXTENT = 3.0
"""Half of a square's side [standard deviations]; beyond it a Gaussian is below 0.012."""
TRANSPARENT_BOUNCES = 64
"""A ray passes many discs before it has met enough of them."""


def add_splats(splats: Splats, name: str) -> bpy.types.Object:
    """An object of points that is in no collection yet, in world units."""
    mesh = bpy.data.meshes.new(name)
    count = len(splats.centers)
    mesh.vertices.add(count)
    mesh.vertices.foreach_set("co", np.ascontiguousarray(splats.centers, np.float32).ravel())
    scales = np.concatenate([splats.scales, np.ones((count, 1))], axis=1)
    colors = np.concatenate([splats.radiance, np.ones((count, 1))], axis=1)
    for attribute, kind, field, values in (
        ("rotation", "QUATERNION", "value", splats.quats_wxyz),
        ("scale", "FLOAT_VECTOR", "vector", scales),
        ("radiance", "FLOAT_COLOR", "color", colors),
        ("opacity", "FLOAT", "value", splats.opacities),
    ):
        mesh.attributes.new(attribute, kind, "POINT").data.foreach_set(field, np.ascontiguousarray(values, np.float32).ravel())
    placed = bpy.data.objects.new(name, mesh)
    modifier = placed.modifiers.new("discs", "NODES")
    modifier.node_group = _discs(_material(name), name)
    return placed


def _discs(material: bpy.types.Material, name: str) -> bpy.types.GeometryNodeTree:
    tree = bpy.data.node_groups.new(name, "GeometryNodeTree")
    tree.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")

    def node(kind: str, x: float, y: float) -> bpy.types.Node:
        made = tree.nodes.new(kind)
        made.location = (x, y)
        return made

    def attribute(of: str, kind: str, y: float) -> bpy.types.NodeSocket:
        made = node("GeometryNodeInputNamedAttribute", 400, y)
        made.data_type = kind
        made.inputs["Name"].default_value = of
        return made.outputs["Attribute"]

    given, result = node("NodeGroupInput", 400, 200), node("NodeGroupOutput", 900, 0)
    square = node("GeometryNodeMeshGrid", -300, 0)
    for socket, value in (("Size X", 2 * EXTENT), ("Size Y", 2 * EXTENT), ("Vertices X", 2), ("Vertices Y", 2)):
        square.inputs[socket].default_value = value
    stored = node("GeometryNodeStoreNamedAttribute", 0, 0)
    stored.data_type, stored.domain = "FLOAT_VECTOR", "POINT"
    stored.inputs["Name"].default_value = "deviations"
    painted = node("GeometryNodeSetMaterial", 200, 0)
    painted.inputs["Material"].default_value = material
    placed = node("GeometryNodeInstanceOnPoints", 650, 0)
    links = (
        (square.outputs["Mesh"], stored.inputs["Geometry"]),
        (node("GeometryNodeInputPosition", -300, -250).outputs["Position"], stored.inputs["Value"]),
        (stored.outputs["Geometry"], painted.inputs["Geometry"]),
        (painted.outputs["Geometry"], placed.inputs["Instance"]),
        (given.outputs["Geometry"], placed.inputs["Points"]),
        (attribute("rotation", "QUATERNION", -100), placed.inputs["Rotation"]),
        (attribute("scale", "FLOAT_VECTOR", -300), placed.inputs["Scale"]),
        (placed.outputs["Instances"], result.inputs["Geometry"]),
    )
    for source, target in links:
        tree.links.new(source, target)
    return tree


def _material(name: str) -> bpy.types.Material:
    """Emission of `radiance`, let through by 1 - opacity exp(-r^2 / 2)."""
    material = bpy.data.materials.new(f"{name} discs")
    material.use_nodes = True
    # Otherwise Cycles would take each of them for a lamp.
    material.cycles.emission_sampling = "NONE"
    material.surface_render_method = "BLENDED"
    tree = material.node_tree
    tree.nodes.clear()

    def attribute(of: str, kind: str) -> bpy.types.Node:
        made = tree.nodes.new("ShaderNodeAttribute")
        made.attribute_name, made.attribute_type = of, kind
        return made

    def math(operation: str, first: bpy.types.NodeSocket, second: bpy.types.NodeSocket | float | None = None) -> bpy.types.NodeSocket:
        made = tree.nodes.new("ShaderNodeMath")
        made.operation = operation
        tree.links.new(first, made.inputs[0])
        if isinstance(second, float):
            made.inputs[1].default_value = second
        elif second is not None:
            tree.links.new(second, made.inputs[1])
        return made.outputs[0]

    place = attribute("deviations", "GEOMETRY").outputs["Vector"]
    squared = tree.nodes.new("ShaderNodeVectorMath")
    squared.operation = "DOT_PRODUCT"
    tree.links.new(place, squared.inputs[0])
    tree.links.new(place, squared.inputs[1])
    falloff = math("EXPONENT", math("MULTIPLY", squared.outputs["Value"], -0.5))
    alpha = math("MULTIPLY", falloff, attribute("opacity", "INSTANCER").outputs["Fac"])
    light, clear = tree.nodes.new("ShaderNodeEmission"), tree.nodes.new("ShaderNodeBsdfTransparent")
    mixed, output = tree.nodes.new("ShaderNodeMixShader"), tree.nodes.new("ShaderNodeOutputMaterial")
    tree.links.new(attribute("radiance", "INSTANCER").outputs["Color"], light.inputs["Color"])
    tree.links.new(alpha, mixed.inputs[0])
    tree.links.new(clear.outputs[0], mixed.inputs[1])
    tree.links.new(light.outputs[0], mixed.inputs[2])
    tree.links.new(mixed.outputs[0], output.inputs["Surface"])
    return material
