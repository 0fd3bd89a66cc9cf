"""DR-GS: photos in, a relightable, deformable, editable object out.

The names below are the public ones; each is imported when it is first used, so that `import drgs` costs nothing.
See docs/roadmap.md for what works.

    asset = drgs.load_asset("out/teapot")
    scene = drgs.pose_scene(asset, drgs.parse_edits([{"op": "environment", "rotation": 30.0}]), base_directory=Path("."))
    frame = drgs.render_frame(scene, asset.cameras[0], drgs.RenderSettings())
"""

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

_modules = {
    "Asset": "drgs.scene.asset",
    "load_asset": "drgs.scene.asset",
    "save_asset": "drgs.scene.asset",
    "load_views": "drgs.build.load_views",
    "BuildSettings": "drgs.build.build_asset",
    "build_asset": "drgs.build.build_asset",
    "import_mesh": "drgs.build.import_mesh",
    "export_asset": "drgs.build.export_asset",
    "parse_edits": "drgs.scene.edits",
    "pose_scene": "drgs.deform.pose_scene",
    "RenderSettings": "drgs.render.render_frame",
    "render_frame": "drgs.render.render_frame",
    "Client": "drgs.client",
}

__all__ = ["__version__", *_modules]


def __getattr__(name: str) -> Any:
    if name not in _modules:
        raise AttributeError(f"module 'drgs' has no attribute {name!r}; its public names are {', '.join(_modules)}")
    return getattr(import_module(_modules[name]), name)


def __dir__() -> list[str]:
    return __all__
