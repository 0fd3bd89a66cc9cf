"""File > Import > DR-GS: an asset of drgs (its asset.json, or the folder zipped) as a collection of Blender objects.

    NAME            an empty, which scales world units to metres; all others are its children
      NAME          the mesh; its vertices carry the materials, which a Principled BSDF reads
      NAME splats   the 2D Gaussians as points and discs, hidden, for they lie where the mesh lies
      ...           the photographs' cameras; the first one becomes the scene's, with the size of its picture

The scene gets a world with the asset's light, and Cycles as many transparent bounces as discs need. Nothing else of the scene is changed. read_asset reads, add_... make objects; this file has the
operator and its place in the menu.
"""

from pathlib import Path

import bpy
from bpy_extras.io_utils import ImportHelper

from .add_cameras import add_cameras
from .add_environment import add_environment
from .add_mesh import add_mesh
from .add_splats import TRANSPARENT_BOUNCES, add_splats
from .read_asset import BlenderAsset, read_asset


class ImportAsset(bpy.types.Operator, ImportHelper):
    """Mesh, materials, splats, light and cameras of an object built from photographs"""

    bl_idname = "import_scene.drgs"
    bl_label = "Import DR-GS"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012  # as Blender asks for it
    filename_ext = ".json"
    filter_glob: bpy.props.StringProperty(default="asset.json;*.zip", options={"HIDDEN"})  # type: ignore[valid-type]
    with_environment: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Light", description="Give the scene a world with the light that was found in the photographs", default=True
    )
    with_cameras: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Cameras", description="The photographs' cameras; the first becomes the scene's, with its picture's size", default=True
    )
    with_splats: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Splats", description="The 2D Gaussians as discs, hidden: in the light of the capture, seen from all sides alike", default=True
    )

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            asset = read_asset(Path(self.filepath))
        except (ValueError, OSError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        place_asset(asset, context, self.with_environment, self.with_cameras, self.with_splats)
        turns = "; its light stood still with the camera, and is that of the first" if asset.light_turns else ""
        self.report({"INFO"}, f"{asset.name}: {len(asset.faces)} faces, {len(asset.cameras)} cameras{turns}")
        return {"FINISHED"}


def place_asset(asset: BlenderAsset, context: bpy.types.Context, with_environment: bool, with_cameras: bool, with_splats: bool) -> None:
    """Put what was asked for into the scene."""
    collection = bpy.data.collections.new(asset.name)
    context.scene.collection.children.link(collection)
    root = bpy.data.objects.new(asset.name, None)
    root.scale = (asset.meters_per_unit,) * 3
    cameras = add_cameras(asset) if with_cameras else []
    splats = [add_splats(asset.splats, f"{asset.name} splats")] if with_splats and asset.splats is not None else []
    for placed in (root, add_mesh(asset), *splats, *cameras):
        collection.objects.link(placed)
        if placed is not root:
            placed.parent = root
    for placed in splats:
        placed.hide_render = True
        placed.hide_set(True)
        context.scene.cycles.transparent_max_bounces = max(context.scene.cycles.transparent_max_bounces, TRANSPARENT_BOUNCES)
    if with_environment:
        context.scene.world = add_environment(asset)
    if cameras:
        context.scene.camera = cameras[0]
        render, first = context.scene.render, asset.cameras[0]
        render.resolution_x, render.resolution_y, render.resolution_percentage = first.width, first.height, 100
        # Pixels that are not square: Blender has them by the scene, and counts how much higher than wide one is.
        render.pixel_aspect_x, render.pixel_aspect_y = 1.0, first.intrinsics[0, 0] / first.intrinsics[1, 1]


def _menu_entry(menu: bpy.types.Menu, context: bpy.types.Context) -> None:
    menu.layout.operator(ImportAsset.bl_idname, text="DR-GS (asset.json, .zip)")


def register() -> None:
    bpy.utils.register_class(ImportAsset)
    bpy.types.TOPBAR_MT_file_import.append(_menu_entry)


def unregister() -> None:
    bpy.types.TOPBAR_MT_file_import.remove(_menu_entry)
    bpy.utils.unregister_class(ImportAsset)
