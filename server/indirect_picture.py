"""The channel of indirect light: the whole light less the direct one, of the same rays.

Both are summed side by side. They draw the same numbers, so that what they share cancels exactly and no noise of it is left.
"""

from typing import TYPE_CHECKING

from server.channels import eight_bit
from server.messages import Settings
from server.render_session import AbstractPicture, Explanation, LinearPixels, Picked, Pixels

if TYPE_CHECKING:
    from server.drgs_renderer import Picture


class IndirectPicture(AbstractPicture):
    """Final."""

    def __init__(self, whole: "Picture", direct: "Picture", settings: Settings) -> None:
        """
        Args:
            whole: with bounces, not denoised. direct: the same view with none.
        """
        self.whole, self.direct = whole, direct
        self.width, self.height = whole.width, whole.height
        self.notes = whole.notes
        self._settings = settings

    @property
    def samples(self) -> int:  # type: ignore[override]
        return min(self.whole.samples, self.direct.samples)

    @property
    def samples_target(self) -> int:  # type: ignore[override]
        return self.whole.samples_target

    def refine(self) -> None:
        """Whichever is behind follows, so that both have the same samples whenever they are looked at."""
        behind, ahead = sorted((self.whole, self.direct), key=lambda picture: picture.samples)
        if behind.samples == ahead.samples:
            behind.refine()
        while behind.samples != ahead.samples:
            behind, ahead = sorted((behind, ahead), key=lambda picture: picture.samples)
            behind.refine(up_to=ahead.samples)

    def resolve(self) -> Pixels:
        from drgs.render.tonemap import tonemap

        whole, direct = self.whole.frame(), self.direct.frame()
        linear = (whole.radiance_linear - direct.radiance_linear).clamp(min=0)
        return eight_bit(tonemap(linear, whole.gbuffer.coverage, self._settings.exposure_stops, curve=self._settings.tone_curve))

    def linear(self) -> LinearPixels:
        raise ValueError("indirect light is for looking at only")

    def pick(self, x: float, y: float) -> Picked | None:
        return self.whole.pick(x, y)

    def explain(self) -> Explanation:
        return self.whole.explain()
