"""The channel that shows the surfels themselves: one drawing and no light, finished at once."""

from functools import cached_property
from typing import TYPE_CHECKING

from drgs_server.render.channels import eight_bit
from drgs_server.render.interface import AbstractPicture, Explanation, LinearPixels, Picked, Pixels

if TYPE_CHECKING:
    from collections.abc import Callable

    from drgs.scene.camera import Camera
    from drgs.scene.posed_scene import PosedScene

NO_SURFELS = "this asset was made from a mesh: it has no surfels to show"


class SurfelPicture(AbstractPicture):
    """Final. Keeps the picture of another channel that came before it, whose work the next one may go on with."""

    samples = samples_target = 1

    def __init__(
        self, scene: "PosedScene", camera: "Camera", before: AbstractPicture | None, maps: "Callable[[], AbstractPicture]"
    ) -> None:
        """
        Args:
            maps: begins a picture of the same view that knows where surfaces are, for picking.
        """
        self.before = before
        self.width, self.height = camera.width, camera.height
        self.notes = () if scene.surfels is not None else (NO_SURFELS,)
        self._scene, self._camera, self._begin_maps = scene, camera, maps

    def refine(self) -> None:
        """There is nothing to add."""

    def resolve(self) -> Pixels:
        return self._pixels

    @cached_property
    def _pixels(self) -> Pixels:
        import torch

        from drgs.render.visible.draw_surfels import draw_surfels

        if self._scene.surfels is None:
            return eight_bit(torch.zeros(self.height, self.width, 4))
        return eight_bit(draw_surfels(self._scene.surfels, self._camera))

    def linear(self) -> LinearPixels:
        raise ValueError("the surfels' colours stand for no values")

    def pick(self, x: float, y: float) -> Picked | None:
        return self._maps.pick(x, y)

    @cached_property
    def _maps(self) -> AbstractPicture:
        picture = self._begin_maps()
        picture.refine()
        return picture

    def explain(self) -> Explanation:
        return Explanation({}, ())
