"""DR-GS: photos in, a relightable, deformable, editable object out.

The names below are the public ones; each is imported when it is first used, so that `import drgs` costs nothing. Import it before torch: it chooses how
torch's idle threads wait (GOMP_SPINCOUNT, unless it is set), which two programs on one machine would else stop each other by. Where torch was first, builds
still shorten that while others want the cores (brief_waits.py).
See docs/roadmap.md for what works.

    asset = drgs.load_asset("out/teapot")
    scene = drgs.pose_scene(asset, drgs.parse_edits([{"op": "environment", "rotation": 30.0}]), base_directory=Path("."))
    frame = drgs.render_frame(scene, asset.cameras[0], drgs.RenderSettings())
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from drgs.installation import missing_package
from drgs.openmp import spin_briefly_unless_told

if TYPE_CHECKING:  # what a type checker knows of the names that come late; a test compares the two lists
    from drgs.convert.export_asset import export_asset as export_asset
    from drgs.convert.import_mesh import import_mesh as import_mesh
    from drgs.convert.page.view import view as view
    from drgs.deform.pose_scene import pose_scene as pose_scene
    from drgs.reconstruct.build_asset import BuildSettings as BuildSettings
    from drgs.reconstruct.build_asset import build_asset as build_asset
    from drgs.reconstruct.capture.load_views import load_views as load_views
    from drgs.render.records import RenderSettings as RenderSettings
    from drgs.render.render_frame import render_frame as render_frame
    from drgs.scene.asset import Asset as Asset
    from drgs.scene.asset import load_asset as load_asset
    from drgs.scene.asset import save_asset as save_asset
    from drgs.scene.edits import parse_edits as parse_edits
    from drgs_server.client import Client as Client

__version__ = "0.2.0"

# Torch reads it when it is loaded, which the modules behind these names do.
spin_briefly_unless_told()

_modules = {
    "Asset": "drgs.scene.asset",
    "load_asset": "drgs.scene.asset",
    "save_asset": "drgs.scene.asset",
    "load_views": "drgs.reconstruct.capture.load_views",
    "BuildSettings": "drgs.reconstruct.build_asset",
    "build_asset": "drgs.reconstruct.build_asset",
    "import_mesh": "drgs.convert.import_mesh",
    "export_asset": "drgs.convert.export_asset",
    "view": "drgs.convert.page.view",
    "parse_edits": "drgs.scene.edits",
    "pose_scene": "drgs.deform.pose_scene",
    "RenderSettings": "drgs.render.records",
    "render_frame": "drgs.render.render_frame",
    "Client": "drgs_server.client",
}

__all__ = ["__version__", *_modules]


if not TYPE_CHECKING:  # a type checker would take it for a promise that any name exists

    def __getattr__(name: str) -> Any:
        if name not in _modules:
            raise AttributeError(f"module 'drgs' has no attribute {name!r}; its public names are {', '.join(_modules)}")
        try:
            return getattr(import_module(_modules[name]), name)
        except ModuleNotFoundError as error:
            if name != "Client" or (error.name or "").startswith("drgs"):
                raise
            raise ImportError(missing_package("drgs.Client", str(error.name), "client")) from error


def __dir__() -> list[str]:
    return __all__
