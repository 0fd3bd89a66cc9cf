"""The mesh of an asset, with its materials on its vertices and a Principled BSDF that reads them."""

import bpy
import numpy as np

from .read_asset import BlenderAsset

BASE_COLOR, ROUGHNESS, METALLIC = "base_color", "roughness", "metallic"
"""Attributes of the vertices, for materials and Geometry Nodes."""


def add_mesh(asset: BlenderAsset) -> bpy.types.Object:
    """An object that is in no collection yet; its mesh is in world units."""
    mesh = bpy.data.meshes.new(asset.name)
    mesh.vertices.add(len(asset.vertices))
    mesh.vertices.foreach_set("co", np.ascontiguousarray(asset.vertices, np.float32).ravel())
    mesh.loops.add(asset.faces.size)
    mesh.loops.foreach_set("vertex_index", np.ascontiguousarray(asset.faces, np.int32).ravel())
    mesh.polygons.add(len(asset.faces))
    mesh.polygons.foreach_set("loop_start", np.arange(0, asset.faces.size, 3, dtype=np.int32))
    mesh.update(calc_edges=True)
    mesh.normals_split_custom_set_from_vertices(asset.normals.tolist())
    colors = np.concatenate([asset.base_color, np.ones((len(asset.vertices), 1))], axis=1, dtype=np.float32)
    mesh.color_attributes.new(BASE_COLOR, "FLOAT_COLOR", "POINT").data.foreach_set("color", colors.ravel())
    for name, values in ((ROUGHNESS, asset.roughness), (METALLIC, asset.metallic)):
        mesh.attributes.new(name, "FLOAT", "POINT").data.foreach_set("value", np.ascontiguousarray(values, np.float32))
    mesh.materials.append(_material(asset.name))
    return bpy.data.objects.new(asset.name, mesh)


def _material(name: str) -> bpy.types.Material:
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    tree = material.node_tree
    principled = next(node for node in tree.nodes if node.bl_idname == "ShaderNodeBsdfPrincipled")
    for row, (attribute, output, socket) in enumerate(
        ((BASE_COLOR, "Color", "Base Color"), (ROUGHNESS, "Fac", "Roughness"), (METALLIC, "Fac", "Metallic"))
    ):
        node = tree.nodes.new("ShaderNodeAttribute")
        node.attribute_name = node.label = attribute
        node.location = (principled.location.x - 250, principled.location.y - 180 * row)
        tree.links.new(node.outputs[output], principled.inputs[socket])
    return material
