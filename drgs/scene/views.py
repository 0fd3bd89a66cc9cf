"""A capture: posed photographs with masks, and, where known, sparse points."""

from dataclasses import dataclass

from jaxtyping import Float, UInt8
from torch import Tensor

from drgs.scene.camera import Camera
from drgs.scene.ground import Ground
from drgs.scene.lens import Lens


@dataclass(frozen=True, eq=False)
class Views:
    """Photographs of one object. Written by load_views, read by fit_gaussians and fit_materials."""

    cameras: tuple[Camera, ...]
    images_srgb: tuple[UInt8[Tensor, "_height _width 3"], ...]
    """Of each view: straight (un-premultiplied) 8-bit sRGB, of its camera's size."""
    coverage: tuple[UInt8[Tensor, "_height _width"], ...]
    """Of each view, its mask: 255 object, 0 background."""
    points_world: Float[Tensor, "point 3"] | None
    """Sparse points of the capture (COLMAP), or None."""
    point_colors_srgb: Float[Tensor, "point 3"] | None
    has_masks: bool
    """False when the capture has neither alpha nor masks: coverage is then 255 everywhere."""
    source: str
    """Which reader recognised the folder: nerf-synthetic, nerfstudio, colmap, metashape, realitycapture, nero."""
    lenses: tuple[Lens | None, ...] = ()
    """As the photographs on disc were calibrated, one a view: None where it was a pinhole already. The images here are undistorted."""
    gains: tuple[float, ...] | None = None
    """Of each view, how much more of the light its exposure keeps than the mean one (mean of logarithms 0); None: all alike."""
    tints: tuple[tuple[float, float, float], ...] | None = None
    """Of each view, how much more of red, green and blue its white balance keeps than the mean one, beside its gain; green 1, means of logarithms 0. None: all
    alike."""
    light_from_world: tuple[Float[Tensor, "3 3"], ...] | None = None
    """Of each view, the rotation of directions in the world to those of the light's own table; None: the light stands still in the world."""
    ground: Ground | None = None
    """Without masks, what the object stands on; coverage is then 255 where a picture may show it. None: not known, or masks tell the object."""
    masks_moved: float = 0.0
    """By how much sharpen_masks moved the capture's outlines to edges of its photographs, root mean square [pixels]."""
    cameras_moved: float = 0.0
    """By how much register_cameras moved what the cameras see, root mean square [pixels]."""
