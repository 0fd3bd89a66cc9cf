"""All channels of one view as the layers of one EXR: those of `drgs render --aov`, and what else the viewer shows.

Imported only on the render thread; torch only inside functions.
"""

from typing import TYPE_CHECKING

import numpy as np

from drgs.maths.color_numpy import linear_from_srgb
from drgs_server.render.interface import AbstractStill, Layers, Pixels
from drgs_server.render.still import SurfelStill

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from torch import Tensor

    from drgs.render.progressive.frame_state import FrameState
    from drgs.render.render_bands import Band


class LayeredStill(AbstractStill):
    """Final. One picture after the other: the light with the maps behind it, then what needs a scene or rays of its own."""

    def __init__(
        self, parts: "Sequence[tuple[Iterator[Band | None], Callable[[FrameState], dict[str, Tensor]]]]", surfels: SurfelStill | None
    ) -> None:
        """
        Args:
            parts: bands of each picture, and the layers (height, width) that a band's state holds.
            surfels: as colours for the eye; None where the asset has none.
        """
        self._parts = list(parts)
        self._surfels = surfels
        self._bands: dict[str, list[np.ndarray]] = {}

    def work(self) -> bool:
        if not self._parts:
            return self._surfels is not None and self._surfels.work()
        bands, layers_of = self._parts[0]
        try:
            band = next(bands)
        except StopIteration:
            del self._parts[0]
            return True
        if band is not None:
            for name, values in layers_of(band.state).items():
                self._bands.setdefault(name, []).append(values[band.within].cpu().numpy())
        return True

    def picture(self) -> Layers:
        # A layer's bands go as it is joined, so that nothing is held twice.
        layers = {name: np.concatenate(self._bands.pop(name)) for name in list(self._bands)}
        return layers if self._surfels is None else layers | _surfel_layers(self._surfels.picture())


def light_layers(state: "FrameState") -> "dict[str, Tensor]":
    """Light and surface. R, G and B are straight, before exposure and tone curve; where nothing is, all are 0 and the depth +inf."""
    from drgs.render.film.resolve_frame import resolve_frame

    frame = resolve_frame(state)
    maps, light = frame.gbuffer, frame.radiance.indirect
    assert light is not None, "the frame was made without split_indirect"
    layers = _colors("", frame.radiance_linear) | _colors("albedo.", maps.albedo) | _colors("normal.", maps.normal_world, "XYZ")
    layers |= {"depth.Z": maps.depth, "roughness.Y": maps.roughness, "metallic.Y": maps.metallic}
    layers |= _colors("indirect.", light) | {"variance.Y": frame.radiance.variance}
    return {"A": maps.coverage} | _where_covered(layers, maps.coverage)


def visibility_layers(state: "FrameState") -> "dict[str, Tensor]":
    """Of a scene under a white sky."""
    from drgs.render.film.resolve_frame import resolve_frame

    frame = resolve_frame(state)
    return _where_covered({"visibility.Y": frame.radiance.visibility}, frame.gbuffer.coverage)


def certainty_layers(state: "FrameState") -> "dict[str, Tensor]":
    """Of a scene that wears it as its albedo."""
    from drgs.render.film.resolve_frame import resolve_frame

    maps = resolve_frame(state).gbuffer
    return _where_covered(_colors("certainty.", maps.albedo), maps.coverage)


def _colors(layer: str, values: "Tensor", names: str = "RGB") -> "dict[str, Tensor]":
    return {f"{layer}{name}": values[..., k] for k, name in enumerate(names)}


def _where_covered(layers: "dict[str, Tensor]", coverage: "Tensor") -> "dict[str, Tensor]":
    """What EXRs of maps hold (drgs.exchange.exr.encode_maps)."""
    import torch

    return {name: torch.where(coverage > 0, values, torch.inf if name == "depth.Z" else 0.0) for name, values in layers.items()}


def _surfel_layers(pixels: Pixels) -> Layers:
    """Their colours in linear light, straight, and their opacity."""
    color = linear_from_srgb(pixels[..., :3] / np.float32(255))
    return {f"surfels.{name}": color[..., k] for k, name in enumerate("RGB")} | {"surfels.A": pixels[..., 3] / np.float32(255)}
