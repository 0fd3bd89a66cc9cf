"""Square tiles of the image: which of them a mesh can be seen in, their pixels, and the window around them.

Tiles are numbered row-major, as pixels are. Knows nothing of rays or light.
"""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from drgs.scene.camera import Camera
from drgs.scene.mesh import TriangleMesh

TILE = 16
"""Side [pixels]."""
MARGIN = 0.01
"""By which triangles are widened on the screen, against rounding [pixels]."""


@dataclass(frozen=True)
class Window:
    """The part of an image that holds all there is to see: what lies outside need not be filtered, blended or tone mapped."""

    height: int
    """Of the whole image, as is width [pixels]."""
    width: int
    rows: slice
    columns: slice
    top: int = 0
    """Where the image is a band of a larger one: the row of that at which it begins."""

    @property
    def tiles(self) -> tuple[slice, slice]:
        """Rows and columns of the tiles; the window begins at a tile's corner."""

        def tiles_along(side: slice) -> slice:
            return slice(side.start // TILE, -(-side.stop // TILE))

        return tiles_along(self.rows), tiles_along(self.columns)

    def crop(self, image: Tensor) -> Tensor:
        """The window (rows, columns, ...) of an image (height, width, ...); shares its memory."""
        return image[self.rows, self.columns]

    def pad(self, part: Tensor, outside: float = 0.0) -> Tensor:
        """The image (height, width, ...) that is `part` in the window and `outside` around it."""
        if part.shape[:2] == (self.height, self.width):
            return part
        image = part.new_full((self.height, self.width, *part.shape[2:]), outside)
        image[self.rows, self.columns] = part
        return image

    def camera(self, camera: Camera) -> Camera:
        """The one that sees the window alone."""
        intrinsics = camera.intrinsics.clone()
        intrinsics[0, 2] -= self.columns.start
        intrinsics[1, 2] -= self.top + self.rows.start
        height, width = self.rows.stop - self.rows.start, self.columns.stop - self.columns.start
        return replace(camera, intrinsics=intrinsics, width=width, height=height)


def window_of_tiles(tiles: Tensor, width: int, height: int, top: int = 0) -> Window:
    """The smallest window around chosen tiles (tile,) bool, at least one of them; `top` as of a Window."""
    across, down = tile_grid(width, height)
    chosen = tiles.view(down, across)
    rows, columns = (torch.nonzero(chosen.any(axis)).squeeze(-1).tolist() for axis in (1, 0))
    return Window(
        height,
        width,
        slice(TILE * rows[0], min(height, TILE * (rows[-1] + 1))),
        slice(TILE * columns[0], min(width, TILE * (columns[-1] + 1))),
        top,
    )


def spread_over_pixels(of_tiles: Tensor, window: Window) -> Tensor:
    """(rows, columns) of a window: the value of each pixel's tile (tile,)."""
    across, down = tile_grid(window.width, window.height)
    wide = of_tiles.view(down, across)[window.tiles].repeat_interleave(TILE, 0).repeat_interleave(TILE, 1)
    return wide[: window.rows.stop - window.rows.start, : window.columns.stop - window.columns.start]


def tile_grid(width: int, height: int) -> tuple[int, int]:
    """Tiles across and down.

    Raises:
        ValueError: the picture has no area.
    """
    if width < 1 or height < 1:
        raise ValueError(f"the picture is {width}x{height} pixels; expected at least 1x1")
    return math.ceil(width / TILE), math.ceil(height / TILE)


def tile_of_pixels(pixel: Tensor, width: int) -> Tensor:
    """Tile numbers of row-major pixel numbers."""
    across = math.ceil(width / TILE)
    pixel = pixel.long()
    return (pixel // width // TILE) * across + pixel % width // TILE


def tiles_of_mesh(mesh: TriangleMesh, camera: Camera) -> Tensor:
    """(tile,) bool: False only where no ray through the tile can meet the mesh.

    A triangle's tiles are those of its box on the screen. A triangle that crosses the camera's plane may be seen anywhere.
    """
    device = mesh.vertices.device
    across, down = tile_grid(camera.width, camera.height)
    camera_from_world = camera.camera_from_world.to(device).double()
    in_camera = mesh.vertices.detach().double() @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
    depth = in_camera[:, 2][mesh.faces.long()]
    near = 1e-9 * float(in_camera.abs().max())
    if bool(((depth.amin(1) <= near) & (depth.amax(1) > -near)).any()):
        return torch.ones(across * down, dtype=torch.bool, device=device)
    on_screen = in_camera @ camera.intrinsics.to(device).double().T
    corners = (on_screen[:, :2] / on_screen[:, 2:])[mesh.faces[depth[:, 0] > near].long()]
    low = ((corners.amin(1) - MARGIN) / TILE).floor()
    high = ((corners.amax(1) + MARGIN) / TILE).floor()
    size = torch.tensor([across, down], device=device)
    inside = ((high >= 0) & (low < size)).all(1)
    low = torch.minimum(low[inside].clamp(min=0), size - 1.0).long()
    high = torch.minimum(high[inside].clamp(min=0), size - 1.0).long() + 1
    # Corners of boxes, summed along both axes, count the boxes over each tile.
    edges = torch.zeros((down + 1) * (across + 1), dtype=torch.int64, device=device)
    for y, x, sign in ((low, low, 1), (low, high, -1), (high, low, -1), (high, high, 1)):
        at = y[:, 1] * (across + 1) + x[:, 0]
        edges.index_add_(0, at, torch.full_like(at, sign))
    covered = edges.view(down + 1, across + 1).cumsum(0).cumsum(1)[:down, :across]
    return (covered > 0).reshape(-1)


def pixels_of_tiles(tiles: Tensor, width: int, height: int) -> Tensor:
    """(pixel,) int32, ascending: the pixels of chosen tiles (tile,) bool."""
    across, down = tile_grid(width, height)
    wide = tiles.view(down, across).repeat_interleave(TILE, 0)[:height].repeat_interleave(TILE, 1)[:, :width]
    return torch.nonzero(wide.reshape(-1)).squeeze(-1).int()
