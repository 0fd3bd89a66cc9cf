"""The light of an asset as a world. Its directions are Blender's own, so nothing is turned."""

import tempfile
from pathlib import Path

import bpy

from .read_asset import BlenderAsset


def add_environment(asset: BlenderAsset) -> bpy.types.World:
    """A world that no scene has yet; its picture is packed into the .blend."""
    world = bpy.data.worlds.new(asset.name)
    world.use_nodes = True
    tree = world.node_tree
    texture = tree.nodes.new("ShaderNodeTexEnvironment")
    texture.location = (-300, 300)
    texture.image = _packed_image(f"{asset.name} environment", asset.environment_exr)
    background = next(node for node in tree.nodes if node.bl_idname == "ShaderNodeBackground")
    tree.links.new(texture.outputs["Color"], background.inputs["Color"])
    return world


def _packed_image(name: str, exr: bytes) -> bpy.types.Image:
    # Blender reads pictures from files only, and the asset may be a zip.
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "environment.exr"
        file.write_bytes(exr)
        image = bpy.data.images.load(str(file))
        image.name = name
        image.colorspace_settings.name = "Linear Rec.709"
        image.pack()
    return image
