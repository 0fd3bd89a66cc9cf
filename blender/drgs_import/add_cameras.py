"""The photographs' cameras."""

import bpy
from mathutils import Matrix

from .read_asset import BlenderAsset, CameraView

SENSOR_MM = 36.0
"""Width of Blender's own default sensor. Only its ratio to the focal length is seen."""


def add_cameras(asset: BlenderAsset) -> list[bpy.types.Object]:
    """Objects that are in no collection yet, in the order of the photographs."""
    return [_camera(view) for view in asset.cameras]


def _camera(view: CameraView) -> bpy.types.Object:
    focal, center_x, center_y = view.intrinsics[0, 0], view.intrinsics[0, 2], view.intrinsics[1, 2]
    camera = bpy.data.cameras.new(view.name)
    camera.sensor_fit = "HORIZONTAL"
    camera.sensor_width = SENSOR_MM
    camera.lens = focal * SENSOR_MM / view.width
    # Blender counts both shifts in widths of the picture; its y goes up.
    camera.shift_x = (view.width / 2 - center_x) / view.width
    camera.shift_y = (center_y - view.height / 2) / view.width
    camera.display_size = 0.2
    placed = bpy.data.objects.new(view.name, camera)
    placed.matrix_basis = Matrix(view.world_from_camera.tolist())
    return placed
