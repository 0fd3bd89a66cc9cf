"""The denoiser that the settings name; what each does is its own file's."""

from drgs.render.film.denoise.oidn import denoise_oidn
from drgs.render.film.denoise.svgf import MOVING, denoise_svgf
from drgs.render.records import DenoiseMethod, GBuffer, Radiance
from drgs.scene.camera import Camera


def denoise(radiance: Radiance, gbuffer: GBuffer, camera: Camera, method: DenoiseMethod, moving: bool = False) -> Radiance:
    """Radiance as shown.

    Args:
        moving: it is one of a moving camera.

    Raises:
        ValueError: the method is unknown, not installed here, or misses what it goes by.
    """
    if method == "none":
        return radiance
    if method == "svgf":
        return denoise_svgf(radiance, gbuffer, camera, MOVING if moving else None)
    if method == "oidn":
        return denoise_oidn(radiance, gbuffer)
    raise ValueError(f"denoiser {method!r} is unknown; expected none, svgf or oidn")
