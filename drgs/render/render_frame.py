"""One frame, from the posed scene to the picture."""

from drgs.render.film.resolve_frame import resolve_frame
from drgs.render.intersect.tracer import AbstractTracer
from drgs.render.progressive.frame_state import passes_needed
from drgs.render.progressive.refine import refine_frame
from drgs.render.progressive.start_frame import start_frame
from drgs.render.records import Frame, RenderSettings
from drgs.scene.camera import Camera
from drgs.scene.posed_scene import PosedScene


def render_frame(scene: PosedScene, camera: Camera, settings: RenderSettings | None = None, tracer: AbstractTracer | None = None) -> Frame:
    """What the camera sees of the scene under its environment.

    Args:
        tracer: of scene.mesh (trace_rays.build_tracer), to reuse one over several frames.
    """
    state = start_frame(scene, camera, settings or RenderSettings(), tracer)  # what the camera sees, and a plan of the rays
    state = refine_frame(state, passes_needed(state))  # rays from there: what they meet, and what light they bring
    return resolve_frame(state)  # sums to a picture: mean, denoiser, background, tone curve
