"""One frame, from the posed scene to the picture."""

from drgs.render.accumulate import RenderSettings, passes_needed, refine_frame, resolve_frame, start_frame
from drgs.render.records import Frame
from drgs.render.tracer import AbstractTracer
from drgs.scene.camera import Camera
from drgs.scene.posed_scene import PosedScene


def render_frame(scene: PosedScene, camera: Camera, settings: RenderSettings | None = None, tracer: AbstractTracer | None = None) -> Frame:
    """What the camera sees of the scene under its environment.

    Args:
        tracer: of scene.mesh (trace_rays.build_tracer), to reuse one over several frames.
    """
    state = start_frame(scene, camera, settings or RenderSettings(), tracer)
    return resolve_frame(refine_frame(state, passes_needed(state)))
