"""Photographs as the losses want them, and which of them a step looks at.

In: Views. Out: one ViewTarget a view, at full or at half size, on the fit's device; of the whole photograph or of what is around its mask.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from drgs.maths.color import linear_from_srgb, srgb_from_linear
from drgs.reconstruct.kept_with_views import kept_with_views
from drgs.scene.camera import Camera, scaled_camera, windowed_camera
from drgs.scene.views import Views

BOX_MARGIN = 8
"""[pixels] around the mask."""
WINDOW_SHARE = 8
"""The windows of `windowed` are wider than the mask's box by its longer side over this, on each side."""


@dataclass(frozen=True, eq=False)
class ViewTarget:
    """A photo as the losses want it."""

    camera: Camera
    photo: Float[Tensor, "height width 3"]
    """SRGB times mask."""
    saturation: Float[Tensor, "height width 3"]
    """SRGB as stored; of views with gains or tints, as the mean exposure and white balance would have stored it, above 1 where that clips."""
    mask: Float[Tensor, "height width"]
    rows: slice
    columns: slice
    """Box around the mask: outside it only coverage is compared."""
    ceiling: float = 1.0
    """Value of `saturation` from which the camera's sensor clipped."""
    light_from_world: Float[Tensor, "3 3"] | None = None
    """Rotation of directions in the world to those of the light's table; None: the same."""
    whole: Camera | None = None
    """Of the photograph, where this is a window of it; None: this is all of it."""

    @property
    def share(self) -> float:
        """Pixels over the whole photograph's."""
        whole = self.whole or self.camera
        return self.camera.width * self.camera.height / (whole.width * whole.height)

    @property
    def box(self) -> tuple[slice, slice]:
        """Rows and columns."""
        return self.rows, self.columns


def view_targets(views: Views, factor: float, device: torch.device) -> list[ViewTarget]:
    """Photos at `factor` times their size, of one exposure and white balance, premultiplied by their masks."""
    targets = []
    gains = views.gains or (1.0,) * len(views.cameras)
    turns = views.light_from_world or (None,) * len(views.cameras)
    tints = views.tints or ((1.0, 1.0, 1.0),) * len(views.cameras)
    seen = zip(views.cameras, views.images_srgb, views.coverage, gains, tints, turns, strict=True)
    for camera, image, mask, gain, tint, turn in seen:
        photo, alpha, ceiling = image.float() / 255, mask.float() / 255, 1.0
        if gain != 1 or tint != (1.0, 1.0, 1.0):
            kept = gain * torch.tensor(tint)
            # Of all channels from where the first clips: a colour of which one is cut off says no more than that it is as bright.
            ceiling = float(srgb_from_linear(1 / kept.max()))
            photo = srgb_from_linear(linear_from_srgb(photo) / kept).clamp(max=ceiling)
        small = scaled_camera(camera, factor)
        if factor != 1:
            stacked = torch.cat([photo * alpha[..., None], alpha[..., None], photo], -1).permute(2, 0, 1)[None]
            stacked = torch.nn.functional.interpolate(stacked, (small.height, small.width), mode="area")[0].permute(1, 2, 0)
            premultiplied, alpha, photo = stacked[..., :3], stacked[..., 3], stacked[..., 4:]
        else:
            premultiplied = photo * alpha[..., None]
        rows, columns = (alpha > 0).any(1).nonzero().flatten(), (alpha > 0).any(0).nonzero().flatten()
        down, across = (
            slice(max(0, int(x[0]) - BOX_MARGIN), int(x[-1]) + BOX_MARGIN + 1) if len(x) else slice(0, 1) for x in (rows, columns)
        )
        premultiplied, photo, alpha = (x.contiguous().to(device) for x in (premultiplied, photo, alpha))
        turn = None if turn is None else turn.to(device)
        targets.append(ViewTarget(small.to(device), premultiplied, photo, alpha, down, across, ceiling, turn))
    return targets


@kept_with_views
def whole_targets(views: Views, device: torch.device) -> list[ViewTarget]:
    """view_targets at full size, which all fits of the surface and of its materials share."""
    return view_targets(views, 1.0, device)


def windowed(target: ViewTarget) -> ViewTarget:
    """The part of a photograph around its mask's box, with a margin in which what strays beyond the mask is still seen."""
    height, width = target.mask.shape
    down, across = (slice(part.start, min(part.stop, size)) for part, size in zip(target.box, (height, width), strict=True))
    margin = -(-max(down.stop - down.start, across.stop - across.start) // WINDOW_SHARE)
    rows, columns = (slice(max(0, part.start - margin), min(size, part.stop + margin)) for part, size in ((down, height), (across, width)))
    photo, saturation, mask = (x[rows, columns].contiguous() for x in (target.photo, target.saturation, target.mask))
    return replace(
        target,
        camera=windowed_camera(target.camera, rows, columns),
        photo=photo,
        saturation=saturation,
        mask=mask,
        rows=slice(down.start - rows.start, down.stop - rows.start),
        columns=slice(across.start - columns.start, across.stop - columns.start),
        whole=target.camera,
    )


def drawn_view(iteration: int, count: int, seed: int) -> int:
    """Which of `count` views a step looks at: all once a round, in an order that only seed and round decide, so a resumed fit keeps it."""
    rounds, place = divmod(iteration, count)
    return int(torch.randperm(count, generator=torch.Generator().manual_seed(seed * 1_000_003 + rounds))[place])
