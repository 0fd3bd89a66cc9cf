"""A finished picture of any size in memory that does not grow with it: band after band of its rows, with the very bits that the whole has.

In: a scene, a camera, settings. Out: bands from the top down, each as a FrameState that resolve_frame shows. A pixel's rays depend on its
number in the image and on nothing around it; only the denoiser looks beyond a band's edge, so its neighbours stay until it has been shown.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from drgs.render.film.denoise.svgf import filter_reach
from drgs.render.integrate.plan import samples_per_pass
from drgs.render.intersect.tracer import AbstractTracer
from drgs.render.progressive.frame_state import FrameState, GaussianView, MeshView, Tiles
from drgs.render.progressive.frame_sums import FrameSums
from drgs.render.progressive.refine import refine_frame
from drgs.render.progressive.start_frame import start_frame
from drgs.render.records import FrameInputs, GBuffer, RenderSettings
from drgs.render.visible.image_tiles import TILE
from drgs.scene.camera import Camera
from drgs.scene.posed_scene import PosedScene

BAND_PIXELS = 1 << 18
"""Of a band, about: a pixel in the making takes some 400 bytes, so that a band takes 100 MB."""


@dataclass(frozen=True, eq=False)
class Band:
    """Finished rows of a picture."""

    rows: slice
    """Of the picture."""
    state: FrameState
    """Holds these rows, and those around them that a denoiser looks at."""

    @property
    def within(self) -> slice:
        """Where the rows lie in the state's maps."""
        top = self.state.inputs.rows.start
        return slice(self.rows.start - top, self.rows.stop - top)


def render_bands(
    scene: PosedScene,
    camera: Camera,
    settings: RenderSettings | None = None,
    tracer: AbstractTracer | None = None,
    slice_seconds: float | None = None,
    band_pixels: int = BAND_PIXELS,
) -> Iterator[Band | None]:
    """The bands of what render_frame makes, and None in between, wherever `slice_seconds` have passed.

    Args:
        slice_seconds: about how long the caller waits for the next value; None: until there is a band.

    Raises:
        ValueError: the denoiser needs the whole picture at once.
    """
    settings = settings or RenderSettings()
    a_pass = samples_per_pass(FrameInputs(scene, camera, settings)).total
    wanted = max(1, -(-settings.samples_per_pixel // a_pass))
    around = _rows_around(settings, wanted * a_pass)
    bands = band_rows(camera.width, camera.height, band_pixels, at_least=around)
    made: list[FrameState] = []
    for index, rows in enumerate(bands):
        state = start_frame(scene, camera, settings, tracer, previous=made[-1] if made else None, band=rows)
        passes = 1 if slice_seconds is not None else wanted
        while state.passes < wanted:
            began, before = time.perf_counter(), state.passes
            state = refine_frame(state, min(passes, wanted - before), consume=True)
            seconds = (time.perf_counter() - began) / (state.passes - before)
            if slice_seconds is not None and state.passes < wanted:
                yield None
                passes = max(1, min(int(slice_seconds / max(seconds, 1e-4)), 2 * passes))
        made.append(state)
        if not around:
            yield Band(rows, state)
        elif index:
            yield _with_surroundings(made, bands[index - 1], around, camera.height)
        del made[: -2 if around else -1]
    if around:
        yield _with_surroundings(made, bands[-1], around, camera.height)


def band_rows(width: int, height: int, band_pixels: int = BAND_PIXELS, at_least: int = 0) -> list[slice]:
    """The rows of an image's bands, whole tiles each: as many as hold `band_pixels`, or `at_least` rows."""
    rows = max(TILE, at_least, band_pixels // width // TILE * TILE)
    return [slice(top, min(top + rows, height)) for top in range(0, height, rows)]


def _rows_around(settings: RenderSettings, samples: int) -> int:
    """How far beyond its own rows a band's picture depends on others, in whole tiles [pixels]."""
    if settings.denoise == "oidn":
        raise ValueError("the denoiser oidn looks at the whole picture at once; bands are filtered by svgf or none")
    return 0 if settings.denoise == "none" else -(-filter_reach(samples) // TILE) * TILE


def _with_surroundings(made: Sequence[FrameState], rows: slice, around: int, height: int) -> Band:
    """The band of these rows with `around` rows above and below it, out of bands that follow each other."""
    return Band(rows, join_bands(made, slice(max(0, rows.start - around), min(height, rows.stop + around))))


def join_bands(states: Sequence[FrameState], rows: slice) -> FrameState:
    """A frame that holds these rows, from a tile's edge to a tile's edge, of bands that follow each other; for showing, not for going on."""

    def within(state: FrameState) -> slice:
        own = state.inputs.rows
        return slice(max(rows.start, own.start) - own.start, min(rows.stop, own.stop) - own.start)

    parts = [(state, within(state)) for state in states if within(state).start < within(state).stop]
    first, width = parts[0][0], parts[0][0].inputs.camera.width

    def of_pixels(name: str) -> Any:
        if getattr(first.sums, name) is None:
            return None
        kept = [getattr(state.sums, name).unflatten(0, (-1, width))[part] for state, part in parts]
        return torch.cat(kept).flatten(0, 1)

    def of_tiles(name: str) -> Tensor:
        across = -(-width // TILE)
        kept = [getattr(state.tiles, name).view(-1, across)[part.start // TILE : -(-part.stop // TILE)] for state, part in parts]
        return torch.cat(kept).flatten()

    view: GaussianView | MeshView = MeshView()
    if isinstance(first.view, GaussianView):
        seen = [(state.view.gbuffer, part) for state, part in parts if isinstance(state.view, GaussianView)]
        maps = GBuffer(**{name: torch.cat([getattr(maps, name)[part] for maps, part in seen]) for name in vars(first.view.gbuffer)})
        view = GaussianView(maps, first.view.primary_points)
    return replace(
        first,
        inputs=replace(first.inputs, band=rows),
        view=view,
        tiles=Tiles(of_tiles("covered"), of_tiles("passes"), of_tiles("active")),
        sums=FrameSums(**{name: of_pixels(name) for name in vars(first.sums)}),
    )
