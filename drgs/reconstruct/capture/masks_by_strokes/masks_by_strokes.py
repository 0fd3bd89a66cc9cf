"""A few strokes over some pictures say what the object is: from them and the cameras, the masks of all pictures, in seconds.

The stroked pictures are divided first, each by the strokes' colours and its own edges. What lies behind both masks bounds the object; then pictures and
volume take turns: around the volume's silhouette each picture learns the colours of its own surroundings, from within all pictures together those of the
object; every picture is divided by them, and all pictures vote on the volume, with fewer and fewer allowed to say no. No colour need therefore be of the
object alone: surroundings are each picture's own, and what a few pictures get wrong others outvote.

In: Views and strokes. Out: the same Views with masks. It does not know depth, so that what stands on the table and has its colours must be stroked.
Source: after Campbell et al. 2007 (docs/sources.md: campbell2007), with the cuts of Rother et al. 2004 (rother2004) relaxed.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int8, Int32, UInt8
from numpy import ndarray
from PIL import Image, ImageDraw
from scipy import ndimage
from torch import Tensor

from drgs.reconstruct.capture.find_masks import smaller_views
from drgs.reconstruct.capture.initial_points import seen_by_all
from drgs.reconstruct.capture.load_views.checks import CaptureFault, shown
from drgs.reconstruct.capture.masks_by_strokes.color_shares import Shares, cells_of, color_shares, log_odds
from drgs.reconstruct.capture.masks_by_strokes.cut_picture import Cut, Edges, cut_picture, edges_of, undecided
from drgs.reconstruct.capture.masks_by_strokes.vote_volume import Region, Volume, silhouette, vote_volume
from drgs.scene.camera import Camera
from drgs.scene.strokes import Stroke
from drgs.scene.views import Views

MORE_STROKES = "Draw over more of the object and of what is around it, in pictures from other sides."
CERTAIN = 50.0
"""Cost of calling a stroked pixel what its stroke denies."""
OUTSIDE = 20.0
"""The same of a pixel far from the volume's silhouette."""
SURE_PIXELS = 50
"""Fewer within a silhouette tell no colours."""


@dataclass(frozen=True)
class Round:
    """Pictures are divided, then vote."""

    reach: float
    """How far outside the volume's silhouette the object may be, as a share of the picture's longer side."""
    cells: int
    """Of the volume, along its longest side."""
    against: float
    """Share of the pictures of which more may not call a place background."""
    kept: float
    """Of the volume before: if it became smaller than that, `most_against` may do so."""


@dataclass(frozen=True)
class StrokeSettings:
    side: int = 192
    """Pictures are divided at this size [pixels]."""
    fine_side: int = 512
    """And at the end along their outlines at this, where they are as large."""
    fine_band: float = 2.0
    """On either side of the outline, what is then asked again [pixels of `side`]."""
    edge: float = 4.0
    """What it costs to part neighbours of one colour, in units of log odds."""
    most_odds: float = 3.0
    """Log odds that colours may give one pixel."""
    strays_first: float = 0.05
    """Share of the object's colours that the strokes did not meet."""
    strays: float = 0.05
    """The same once whole masks have told them, and"""
    strays_around: float = 0.01
    """share of the surroundings' colours that were not met beside the silhouette."""
    strays_bound: float = 0.02
    """This and the next: the same two while the volume is but a bound. What nobody knows is then rather not the object, lest it grow into its surroundings."""
    strays_around_bound: float = 0.05
    from_strokes: float = 0.3
    """Weight of the strokes' colours among those that whole masks tell."""
    own: float = 0.3
    """Weight of a picture's own colours among the object's."""
    around: float = 0.25
    """Width of what counts as a picture's surroundings, outside the reach, as a share of its longer side."""
    inner: float = 1.0
    """Log odds in favour of pixels that lie a margin deeper within the silhouette."""
    stroked_rounds: int = 3
    stroked_steps: int = 150
    steps: int = 60
    most_against: float = 0.35
    first_size: float = 1.6
    """Half the first volume's side, as a share of the sphere that all cameras see: objects may be off its middle."""
    first_reach: float = 0.08
    """As of a round, of the stroked pictures' masks."""
    rounds: tuple[Round, ...] = (
        Round(0.08, 48, 0.25, 0.02),
        Round(0.06, 64, 0.15, 0.5),
        Round(0.04, 80, 0.10, 0.6),
        Round(0.02, 96, 0.06, 0.7),
    )


@dataclass(eq=False)
class _Picture:
    """What is known of one picture while the work lasts."""

    camera: Camera
    cells: Int32[ndarray, "height width"]
    edges: Edges
    strokes: Int8[ndarray, "height width"]
    """1: object, -1: background, 0: nobody said."""
    cut: Cut

    @property
    def side(self) -> int:
        return max(self.camera.width, self.camera.height)

    @property
    def mask(self) -> Bool[ndarray, "height width"]:
        return (self.cut.value > 0.5).numpy()

    def divide(self, odds: Float32[ndarray, "height width"], steps: int) -> None:
        """`odds`: in favour of the object; strokes are certain."""
        cost = np.where(self.strokes == 0, -odds, -CERTAIN * self.strokes).astype(np.float32)
        cut_picture(self.cut, cost, self.edges, steps)


def check_strokes(strokes: Sequence[Stroke], names: Sequence[str]) -> None:
    """
    Raises:
        CaptureFault: a stroke is over a picture that the capture does not have, or none says what is the object, or what is not.
    """
    known = set(names)
    foreign = next((stroke.picture for stroke in strokes if stroke.picture not in known), None)
    if foreign is not None:
        few = ", ".join(shown(name) for name in list(names)[:3])
        raise CaptureFault(
            f"strokes: no picture of the capture is called {shown(foreign)}, expected one of {len(known)} names such as {few}.",
            "Names are those of the files, without their endings.",
        )
    for kind, what in (("object", "what the object is"), ("background", "what is not the object")):
        if not any(stroke.shows == kind for stroke in strokes):
            raise CaptureFault(f"strokes: none of {len(strokes)} says {what}, expected at least one that shows {kind!r}.", MORE_STROKES)


def masks_by_strokes(
    views: Views,
    strokes: Sequence[Stroke],
    settings: StrokeSettings = StrokeSettings(),
    report: Callable[[float], None] = lambda share: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> Views | None:
    """The capture masked as strokes say, whatever masks it had; None when should_stop() said so.

    Args:
        report: is told how much of the work is done, 0..1.

    Raises:
        CaptureFault: as check_strokes, or what the strokes say is the object is nowhere in the world.
    """
    check_strokes(strokes, [camera.name for camera in views.cameras])
    small = smaller_views(views, settings.side)
    pictures = [_picture(camera, image.numpy(), strokes, settings) for camera, image in zip(small.cameras, small.images_srgb, strict=True)]
    stroked = [picture for picture in pictures if picture.strokes.any()]
    said, inside = _divide_stroked(stroked, settings)
    volume = _first_volume(stroked, seen_by_all(small), settings)
    for number, step in enumerate(settings.rounds):
        if should_stop():
            return None
        report(number / (len(settings.rounds) + 1))
        for picture in pictures:
            _divide_around(picture, volume, step.reach, inside, said, settings, trusted=number > 0)
        masks = [picture.cut.value for picture in pictures]
        region, least = volume.around(step.cells), step.kept * volume.size
        volume = _found(vote_volume(region, [picture.camera for picture in pictures], masks, step.against, least, settings.most_against))
        counted = ((picture.cells, _sure(picture, volume) & picture.mask) for picture in pictures)
        inside = _mixed(color_shares(counted), said.object, settings.from_strokes)
    for picture in pictures:
        _divide_around(picture, volume, 0.0, inside, said, settings, trusted=True)
    if should_stop():
        return None
    report(len(settings.rounds) / (len(settings.rounds) + 1))
    return replace(views, coverage=tuple(_fine_masks(views, pictures, strokes, inside, settings)), has_masks=True)


def _picture(camera: Camera, color_srgb: UInt8[ndarray, "height width 3"], strokes: Sequence[Stroke], settings: StrokeSettings) -> _Picture:
    edges = edges_of(color_srgb, settings.edge)
    return _Picture(camera, cells_of(color_srgb), edges, _drawn(strokes, camera), undecided(edges))


def _drawn(strokes: Sequence[Stroke], camera: Camera) -> Int8[ndarray, "height width"]:
    """The strokes over one picture; later ones cover earlier ones."""
    width, height = camera.width, camera.height
    said = Image.new("L", (width, height), 1)
    draw = ImageDraw.Draw(said)
    for stroke in strokes:
        if stroke.picture != camera.name:
            continue
        ink, radius = 2 if stroke.shows == "object" else 0, max(0.5, stroke.radius * max(width, height))
        # Pillow's pixel centres lie at whole numbers.
        places = [(x * width - 0.5, y * height - 0.5) for x, y in stroke.points]
        draw.line(places, ink, max(1, round(2 * radius)), "curve")
        for x, y in places:
            draw.ellipse((x - radius, y - radius, x + radius, y + radius), ink)
    return np.asarray(said).astype(np.int8) - 1


@dataclass(frozen=True, eq=False)
class _Said:
    """Colours by the strokes."""

    object: Shares
    background: Shares


def _divide_stroked(stroked: Sequence[_Picture], settings: StrokeSettings) -> tuple[_Said, Shares]:
    """Each by all strokes' colours, and then by those of the masks that this gave. Also the object's colours by these."""
    said = _Said(*(color_shares((picture.cells, picture.strokes == sign) for picture in stroked) for sign in (1, -1)))
    inside, around = said.object, said.background
    for _ in range(settings.stroked_rounds):
        odds = log_odds(inside, around, settings.strays_first, settings.strays_around, settings.most_odds)
        for picture in stroked:
            picture.divide(odds[picture.cells], settings.stroked_steps)
        inside = _mixed(color_shares((picture.cells, picture.mask) for picture in stroked), said.object, 0.5)
        around = _mixed(color_shares((picture.cells, ~picture.mask) for picture in stroked), said.background, 0.5)
    return said, inside


def _first_volume(stroked: Sequence[_Picture], sphere: tuple[ndarray, float], settings: StrokeSettings) -> Volume:
    """What lies behind all stroked pictures' masks, and a little around them."""
    center, radius = sphere
    half = settings.first_size * radius
    region = Region(center - half, center + half, settings.rounds[1].cells)
    masks = [
        torch.from_numpy(ndimage.binary_dilation(picture.mask, iterations=max(1, round(settings.first_reach * picture.side)))).float()
        for picture in stroked
    ]
    cameras = [picture.camera for picture in stroked]
    volume = _found(vote_volume(region, cameras, masks, 0.5 / len(stroked)))
    return _found(vote_volume(volume.around(region.cells), cameras, masks, 0.5 / len(stroked)))


def _found(volume: Volume | None) -> Volume:
    if volume is None:
        raise CaptureFault(
            "strokes: what they say is the object is at no one place in the world, expected the same thing in all.", MORE_STROKES
        )
    return volume


def _margin(stride: int) -> float:
    """How far a silhouette's outline may be off [pixels]."""
    return max(2.0, stride + 1.0)


def _sure(picture: _Picture, volume: Volume) -> Bool[ndarray, "height width"]:
    """Pixels that lie deeper within the volume's silhouette than its cells are wide."""
    seen = silhouette(volume, picture.camera)
    return ndimage.distance_transform_edt(seen.covers) > _margin(seen.cell_pixels)


# Many arguments because the object's colours change from round to round, and the rest does not.
def _divide_around(
    picture: _Picture, volume: Volume, reach: float, inside: Shares, said: _Said, settings: StrokeSettings, trusted: bool
) -> None:
    """By the object's colours and those just outside the volume's silhouette.

    Args:
        trusted: the volume is more than a bound: what lies deep within it is likely to be the object, and tells its colours.
    """
    seen = silhouette(volume, picture.camera)
    outside = ndimage.distance_transform_edt(~seen.covers)
    margin = _margin(seen.cell_pixels)
    begin = max(margin, reach * picture.side)
    beside = (outside > begin) & (outside < begin + settings.around * picture.side)
    around = color_shares([(picture.cells, beside)]) if beside.any() else said.background
    if picture.strokes.any():
        around = _mixed(around, said.background, settings.from_strokes)
    depth = ndimage.distance_transform_edt(seen.covers)
    deep = depth > margin
    if trusted and deep.sum() > SURE_PIXELS:
        inside = _mixed(color_shares([(picture.cells, deep)]), inside, 1 - settings.own)
    strays = (settings.strays, settings.strays_around) if trusted else (settings.strays_bound, settings.strays_around_bound)
    odds = log_odds(inside, around, *strays, settings.most_odds)[picture.cells]
    if trusted:
        odds = odds + settings.inner * (depth / margin - 1).clip(0, 2)
    picture.divide(np.where(outside > begin, -OUTSIDE, odds).astype(np.float32), settings.steps)


def _mixed(shares: Shares, others: Shares, weight: float) -> Shares:
    """`weight`: of the others; theirs alone where nothing was counted."""
    return others if not shares.any() else ((1 - weight) * shares + weight * others).astype(np.float32)


def _fine_masks(
    views: Views, pictures: Sequence[_Picture], strokes: Sequence[Stroke], inside: Shares, settings: StrokeSettings
) -> Iterator[UInt8[Tensor, "_height _width"]]:
    """Masks of the views' own sizes: outlines are found again in pictures of `fine_side`, near where they were found."""
    fine = smaller_views(views, settings.fine_side)
    for picture, camera, image, whole in zip(pictures, fine.cameras, fine.images_srgb, views.cameras, strict=True):
        value = picture.cut.value
        if camera.width > picture.camera.width:
            value = _fine_cut(picture, _picture(camera, image.numpy(), strokes, settings), inside, settings)
        sized = torch.nn.functional.interpolate(value[None, None], size=(whole.height, whole.width), mode="bilinear", align_corners=False)
        yield (255 * sized[0, 0]).round().to(torch.uint8)


def _fine_cut(coarse: _Picture, fine: _Picture, inside: Shares, settings: StrokeSettings) -> Float[Tensor, "height width"]:
    size = (fine.camera.height, fine.camera.width)
    fine.cut.value = torch.nn.functional.interpolate(coarse.cut.value[None, None], size=size, mode="bilinear", align_corners=False)[0, 0]
    mask = fine.mask
    within, outside = ndimage.distance_transform_edt(mask), ndimage.distance_transform_edt(~mask)
    band = settings.fine_band * fine.side / coarse.side
    around = color_shares([(fine.cells, (outside > band) & (outside < settings.around * fine.side))])
    own = color_shares([(fine.cells, within > band)])
    odds = log_odds(_mixed(own, inside, 1 - settings.own), around, settings.strays, settings.strays_around, settings.most_odds)[fine.cells]
    fine.divide(np.where(within > band, OUTSIDE, np.where(outside > band, -OUTSIDE, odds)).astype(np.float32), settings.steps)
    return fine.cut.value
