"""What an object stands on, as light: rays that meet it see its picture, from wherever they come.

The learned environment is infinitely far. What faces down on a table is lit by the table beside it, and mirrors it, each place another part: the environment can
say none of that, and metal, which mirrors, was the next best word for it. So where a build has found what the object stands on (Ground), rays that pass
the object by and would meet it see it, and not the environment. With true masks and cameras, and the true table, of a bunny on a printed one
(`draft`): metallic RMSE .431 to .052, relit 25.1 and 25.0 to 25.9 and 27.3 dB. It is a picture alone: as bright from all sides, and not lit by the object.

In: the ground. Out: what kernels look it up by; and an environment that shows it, for those who have no ground.
"""

from dataclasses import dataclass, replace
from typing import Any

import torch
import warp as wp
from jaxtyping import Bool, Float
from torch import Tensor

from drgs.maths.color import linear_from_srgb
from drgs.reconstruct.fit.light.split_sum import texel_directions
from drgs.scene.ground import Ground
from drgs.warp_torch import launch, warp_argument, warp_device

wp.set_module_options({"enable_backward": False})

COVERED = 0.5
"""Cover from which a place of the fitted ground is one."""


@wp.func
def ground_along(texels: wp.array2d[wp.vec4], frame: wp.mat33, middle: wp.vec3, origin: wp.vec3, direction: wp.vec3) -> wp.vec4:
    """Linear radiance, and 1, of what a ray meets of the ground; 0 where it meets none.

    Args:
        texels: of GroundLight; empty: there is none. frame: rows are both axes over half a side, and the normal.
    """
    none = wp.vec4(0.0, 0.0, 0.0, 0.0)
    side = texels.shape[0]
    if side == 0:
        return none
    here = frame * (origin - middle)
    step = frame * direction
    if here[2] <= 0.0 or step[2] >= -1.0e-6:
        return none
    reach = -here[2] / step[2]
    u = here[0] + reach * step[0]
    v = here[1] + reach * step[1]
    if wp.abs(u) >= 1.0 or wp.abs(v) >= 1.0:
        return none
    x = wp.clamp((u + 1.0) * 0.5 * float(side) - 0.5, 0.0, float(side) - 1.0)
    y = wp.clamp((v + 1.0) * 0.5 * float(side) - 0.5, 0.0, float(side) - 1.0)
    column = wp.min(int(x), side - 2)
    row = wp.min(int(y), side - 2)
    fx = x - float(column)
    fy = y - float(row)
    top = texels[row, column] * (1.0 - fx) + texels[row, column + 1] * fx
    bottom = texels[row + 1, column] * (1.0 - fx) + texels[row + 1, column + 1] * fx
    found = top * (1.0 - fy) + bottom * fy
    if found[3] < COVERED:
        return none
    return wp.vec4(found[0] / found[3], found[1] / found[3], found[2] / found[3], 1.0)


@wp.kernel
def ground_kernel(
    first: int,
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    texels: wp.array2d[wp.vec4],
    frame: wp.mat33,
    middle: wp.vec3,
    # outputs
    met: wp.array[wp.bool],
    radiance: wp.array[wp.vec3],
):
    i = first + wp.tid()
    found = ground_along(texels, frame, middle, origins[i], directions[i])
    met[i] = found[3] > 0.0
    radiance[i] = wp.vec3(found[0], found[1], found[2])


@dataclass(frozen=True, eq=False)
class GroundLight:
    """A ground as rays see it."""

    texels: Float[Tensor, "side side 4"]
    """Linear radiance where there is ground, and 1 there; else 0."""
    frame: Float[Tensor, "3 3"]
    """Rows: both axes over half a side, and the normal."""
    middle: Float[Tensor, "3"]
    """[world units]"""

    def arguments(self) -> list[Any]:
        """Of ground_along, from `texels` to `middle`."""
        return [warp_argument(self.texels, wp.vec4), wp.mat33(*self.frame.flatten().tolist()), wp.vec3(*self.middle.tolist())]

    def along(
        self, origins: Float[Tensor, "ray 3"], directions: Float[Tensor, "ray 3"]
    ) -> tuple[Bool[Tensor, "ray"], Float[Tensor, "ray 3"]]:
        """Which rays meet it, whatever is before it, and its linear radiance there."""
        origins, directions = origins.contiguous(), directions.contiguous()
        met, radiance = torch.empty(len(origins), dtype=torch.bool, device=origins.device), torch.empty_like(origins)
        inputs = [warp_argument(origins, wp.vec3), warp_argument(directions, wp.vec3), *self.arguments()]
        launch(ground_kernel, len(origins), inputs, [warp_argument(met), warp_argument(radiance, wp.vec3)], warp_device(origins))
        return met, radiance


def no_ground(device: torch.device) -> GroundLight:
    """That no ray meets."""
    return GroundLight(torch.empty(0, 0, 4, device=device), torch.eye(3), torch.zeros(3))


def ground_light(ground: Ground, device: torch.device) -> GroundLight:
    """Of a ground with its picture."""
    radiance = torch.cat([linear_from_srgb(ground.color_srgb), torch.ones_like(ground.known)]) * ground.known
    frame = torch.stack([*(ground.axes / ground.half), ground.normal])
    return GroundLight(radiance.permute(1, 2, 0).contiguous().to(device), frame.cpu(), ground.middle.cpu())


def fitted_ground(logits: Float[Tensor, "1 4 side side"], ground: Ground) -> Ground:
    """The ground with the picture that stage 1 has fitted (ground_layer), also where the object hid it; known: where there is any."""
    fitted = torch.sigmoid(logits.detach()[0]).cpu()
    return replace(ground, color_srgb=fitted[:3].contiguous(), known=(fitted[3:] > COVERED).to(fitted))


def environment_with_ground(
    radiance: Float[Tensor, "rows columns 3"], ground: GroundLight, point: Float[Tensor, "3"]
) -> Float[Tensor, "rows columns 3"]:
    """The environment that shows, from a point, the ground where there is one: for pictures of the object alone, whose ground is then as far as all else."""
    directions = texel_directions(len(radiance)).to(radiance).reshape(-1, 3).contiguous()
    met, seen = ground.along(point.to(radiance).expand_as(directions), directions)
    return torch.where(met[:, None], seen, radiance.reshape(-1, 3)).view_as(radiance)
