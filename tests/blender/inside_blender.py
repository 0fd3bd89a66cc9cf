"""Run by Blender's own Python, not by pytest: installs the extension as a user does, imports an asset by the menu's operator, renders and tells.

inside_blender.py EXTENSION.zip ASSET REPORT.json [PICTURE.png SAMPLES CAMERA mesh|splats]
"""

import json
import sys
from pathlib import Path

import bpy


def main(extension: str, asset: str, report: str, *picture: str) -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.extensions.package_install_files(filepath=extension, repo="user_default", enable_on_install=True)
    drawn = [entry.__module__ for entry in bpy.types.TOPBAR_MT_file_import._dyn_ui_initialize() if entry.__name__ == "_menu_entry"]
    refused = None
    try:
        answer = bpy.ops.import_scene.drgs(filepath=asset)
    except RuntimeError as error:  # what an operator reports as an error
        answer, refused = {"CANCELLED"}, str(error)
    told = {"version": bpy.app.version_string, "menu": drawn, "answer": sorted(answer), "refused": refused}
    if refused is None:
        told |= described()
        if picture:
            render(*picture)
    Path(report).write_text(json.dumps(told))


def described() -> dict:
    scene = bpy.context.scene
    (mesh,) = [placed for placed in scene.objects if placed.type == "MESH" and len(placed.data.polygons)]
    splats = [placed for placed in scene.objects if placed.type == "MESH" and not len(placed.data.polygons)]
    cameras = [placed for placed in scene.objects if placed.type == "CAMERA"]
    bpy.context.view_layer.update()
    place = [0.0] * (3 * len(mesh.data.vertices))
    mesh.data.vertices.foreach_get("co", place)
    image = next(node.image for node in scene.world.node_tree.nodes if node.bl_idname == "ShaderNodeTexEnvironment")
    return {
        "faces": len(mesh.data.polygons),
        "vertices": place,
        "corner_normal": list(mesh.data.corner_normals[0].vector),
        "corner_vertex": mesh.data.loops[0].vertex_index,
        "attributes": sorted(mesh.data.attributes.keys()),
        "scale": list(mesh.matrix_world.to_scale()),
        "splats": [[len(placed.data.vertices), placed.hide_render] for placed in splats],
        "cameras": {placed.name: [list(row) for row in placed.matrix_world] for placed in cameras},
        "environment": [list(image.size), image.packed_file is not None],
        "environment_pixels": list(image.pixels),
        "size": [scene.render.resolution_x, scene.render.resolution_y],
    }


def render(picture: str, samples: str, camera: str, shows: str) -> None:
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.device, scene.cycles.samples, scene.cycles.use_denoising = "CPU", int(samples), False
    scene.cycles.use_adaptive_sampling = False
    scene.render.threads_mode, scene.render.threads = "FIXED", 1
    scene.camera = scene.objects[camera]
    scene.render.film_transparent = True
    scene.cycles.pixel_filter_type, scene.cycles.filter_width = "BOX", 1.0
    scene.view_settings.view_transform = "Standard"  # sRGB, as ours
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.image_settings.color_depth = "32"
    for placed in scene.objects:
        if placed.type == "MESH":
            placed.hide_render = (len(placed.data.polygons) > 0) != (shows == "mesh")
            placed.hide_set(placed.hide_render)
    scene.render.filepath = picture
    bpy.ops.render.render(write_still=True)


if __name__ == "__main__":
    main(*(sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]))
