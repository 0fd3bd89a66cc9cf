"""The interface of all ways to drive a captured object: bind once, pose as often as it moves, draw.

In: an asset and its photographs (`Subject`). `bind` makes what a way needs beyond them, as named tensors that a file keeps; `pose` drives it by a
field and gives what draws a camera's picture. A way that draws Gaussians is three functions, binding, driver and appearance, put together by
`SplatVariant`; ours has a file of its own.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from benchmarks.paper.fields import Field
from benchmarks.paper.harmonics import BakeSettings, ShadedColors, bake_harmonics, harmonic_colors
from benchmarks.paper.splats import Splats, draw, resting
from drgs.scene.asset import Asset
from drgs.scene.camera import Camera
from drgs.scene.environment import Environment
from drgs.scene.gaussians import surfel_tangents
from drgs.scene.views import Views

Picture = Float[Tensor, "height width 4"]
Draw = Callable[[Camera], Tensor]
"""Straight sRGB with alpha, (height, width, 4), 0..1."""


@dataclass(frozen=True, eq=False)
class Subject:
    """What every way starts from: the same geometry, the same photographs."""

    asset: Asset
    views: Views
    """Training photographs."""
    budget: int
    """Gaussians that ways with faces of their own get; the others have the asset's."""
    bake: BakeSettings
    samples_per_pixel: int
    """Of ways that trace rays."""


class AbstractVariant(ABC):
    """One way to drive and show an object."""

    name: str
    """In file names and on the command line."""
    title: str
    relights: bool
    """Whether another light changes its pictures."""
    simplified: str
    """What is simpler here than in the paper it stands for."""

    @abstractmethod
    def bind(self, subject: Subject) -> dict[str, Tensor]:
        """All that is made before anything moves."""

    @abstractmethod
    def pose(self, subject: Subject, bound: dict[str, Tensor], field: Field, light: Environment | None) -> Draw:
        """The object moved by a field.

        Args:
            light: None: that of the photographs, as recovered or as baked.
        """


@dataclass(frozen=True, eq=False)
class FaceAnchors:
    """Where Gaussians sit on a mesh."""

    vertices: Float[Tensor, "vertex 3"]
    """At rest, world."""
    faces: Int[Tensor, "face 3"]
    face: Int[Tensor, "splat"]
    barycentric: Float[Tensor, "splat 3"]
    offset: Float[Tensor, "splat"]
    """Along the face's unit normal [world units]."""

    def corners(self, vertices: Tensor) -> Float[Tensor, "splat 3 3"]:
        """Vertices (vertex, 3) of each Gaussian's face: (splat, corner, 3)."""
        return vertices[self.faces.long()[self.face.long()]]


@dataclass(frozen=True, eq=False)
class Bound:
    """Gaussians at rest, and what they are tied to."""

    splats: Splats
    anchors: FaceAnchors | None = None
    """None: to nothing; they are the particles."""


Binding = Callable[[Subject], Bound]
Driver = Callable[[Bound, Field], Splats]
Appearance = Callable[[Subject, Splats, Environment | None], ShadedColors]
"""What is shaded, not baked, of Gaussians under a light (None: that of the photographs)."""


class SplatVariant(AbstractVariant):
    """A way that draws Gaussians: harmonics are baked for what its appearance leaves."""

    def __init__(
        self, name: str, title: str, binding: Binding, driver: Driver, appearance: Appearance, relights: bool, simplified: str
    ) -> None:
        self.name, self.title, self.relights, self.simplified = name, title, relights, simplified
        self._binding, self._driver, self._appearance = binding, driver, appearance

    def bind(self, subject: Subject) -> dict[str, Tensor]:
        bound = self._binding(subject)
        sh = bake_harmonics(subject.views, bound.splats, self._appearance(subject, bound.splats, None), subject.bake)
        return tensors_of_bound(bound) | {"sh": sh}

    def pose(self, subject: Subject, bound: dict[str, Tensor], field: Field, light: Environment | None) -> Draw:
        moved = self._driver(bound_of_tensors(bound), field)
        shaded = self._appearance(subject, moved, light)
        return lambda camera: draw(moved, harmonic_colors(bound["sh"], moved, camera, shaded), camera)


def own_gaussians(subject: Subject) -> Bound:
    """Binding: the asset's Gaussians themselves are what moves.

    Raises:
        ValueError: the asset has none.
    """
    gaussians = subject.asset.gaussians
    if gaussians is None:
        raise ValueError("the asset holds no Gaussians; expected one that drgs build made")
    return Bound(resting(gaussians.centers, surfel_tangents(gaussians), torch.sigmoid(gaussians.opacity_logits)))


def baked(subject: Subject, splats: Splats, light: Environment | None) -> ShadedColors:
    """Appearance: everything is in the harmonics, whatever the light."""
    return lambda camera: torch.full_like(splats.centers, 0.5)


def tensors_of_bound(bound: Bound) -> dict[str, Tensor]:
    """Its tensors by name, as a file holds them."""
    splats = bound.splats
    named = {"centers": splats.centers, "tangents": splats.tangents, "opacities": splats.opacities}
    return named if bound.anchors is None else named | vars(bound.anchors)


def bound_of_tensors(tensors: dict[str, Tensor]) -> Bound:
    """Inverse of tensors_of_bound."""
    anchors = (
        FaceAnchors(*(tensors[name] for name in ("vertices", "faces", "face", "barycentric", "offset"))) if "face" in tensors else None
    )
    return Bound(resting(tensors["centers"], tensors["tangents"], tensors["opacities"]), anchors)
