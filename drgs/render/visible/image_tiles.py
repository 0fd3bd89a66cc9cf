"""Square tiles of the image: which of them a mesh can be seen in, their pixels, and the window around them.

Tiles are numbered row-major, as pixels are. Knows nothing of rays or light.
"""

import math
from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import torch
import warp as wp
from torch import Tensor

from drgs.scene.camera import Camera
from drgs.scene.mesh import TriangleMesh
from drgs.warp_torch import launch, warp_array, warp_device

wp.set_module_options({"enable_backward": False})

TILE = wp.constant(16)
"""Side [pixels]."""
MARGIN = wp.constant(0.01)
"""By which triangles are widened on the screen, against rounding [pixels]."""


_CORNERS = torch.tensor([[corner >> axis & 1 for axis in range(3)] for corner in range(8)], dtype=torch.bool)
"""Of a box: which of both ends on each axis."""


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
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the window."""
        return self.rows.stop - self.rows.start, self.columns.stop - self.columns.start

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
        height, width = self.shape
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


@wp.func
def tile_at(place: wp.float64, tiles: wp.float64) -> int:
    """One tile beyond the image stands for all further ones."""
    return int(wp.clamp(wp.floor(place / wp.float64(TILE)), wp.float64(-1.0), tiles))


@wp.kernel
def project_corners(
    first: int,
    vertices: wp.array[wp.vec3],
    rotation: wp.mat33d,
    translation: wp.vec3d,
    intrinsics: wp.mat33d,
    near: wp.float64,
    across: wp.float64,
    down: wp.float64,
    # outputs
    side: wp.array[int],
    box: wp.array[wp.vec4i],
):
    """Whether each vertex is ahead of the camera's plane (1), on it or behind (-1), and its first and last tile on both axes."""
    i = first + wp.tid()
    v = vertices[i]
    in_camera = rotation * wp.vec3d(wp.float64(v[0]), wp.float64(v[1]), wp.float64(v[2])) + translation
    side[i] = wp.where(in_camera[2] > near, 1, wp.where(in_camera[2] <= -near, -1, 0))
    box[i] = wp.vec4i(0, 0, 0, 0)
    if side[i] < 1:
        return
    on_screen = intrinsics * in_camera
    x = on_screen[0] / on_screen[2]
    y = on_screen[1] / on_screen[2]
    margin = wp.float64(MARGIN)
    box[i] = wp.vec4i(tile_at(x - margin, across), tile_at(y - margin, down), tile_at(x + margin, across), tile_at(y + margin, down))


@wp.kernel
def mark_tiles(
    first: int,
    faces: wp.array[int],
    side: wp.array[int],
    box: wp.array[wp.vec4i],
    across: int,
    down: int,
    # outputs; threads may write the same True to one place
    covered: wp.array[wp.bool],
    crossing: wp.array[wp.bool],
):
    i = 3 * (first + wp.tid())
    a = faces[i]
    b = faces[i + 1]
    c = faces[i + 2]
    nearest = wp.min(side[a], wp.min(side[b], side[c]))
    if nearest < 1:
        if wp.max(side[a], wp.max(side[b], side[c])) > -1:
            crossing[0] = True
        return
    low_x = wp.max(wp.min(box[a][0], wp.min(box[b][0], box[c][0])), 0)
    low_y = wp.max(wp.min(box[a][1], wp.min(box[b][1], box[c][1])), 0)
    high_x = wp.min(wp.max(box[a][2], wp.max(box[b][2], box[c][2])), across - 1)
    high_y = wp.min(wp.max(box[a][3], wp.max(box[b][3], box[c][3])), down - 1)
    for y in range(low_y, high_y + 1):
        for x in range(low_x, high_x + 1):
            covered[y * across + x] = True


def tiles_of_mesh(mesh: TriangleMesh, camera: Camera) -> Tensor:
    """(tile,) bool: False only where no ray through the tile can meet the mesh.

    A triangle's tiles are those of its box on the screen. A triangle that crosses the camera's plane may be seen anywhere.
    """
    device, count = mesh.vertices.device, len(mesh.vertices)
    across, down = tile_grid(camera.width, camera.height)
    pose, intrinsics = camera.camera_from_world.double().cpu(), camera.intrinsics.double().cpu()
    farthest = 0.0 if count == 0 else float(mesh.vertices.detach().abs().max()) + float(pose[:3, 3].abs().max())
    side, box = torch.empty(count, dtype=torch.int32, device=device), torch.empty(count, 4, dtype=torch.int32, device=device)
    launch(
        project_corners,
        count,
        [
            warp_array(mesh.vertices.float(), wp.vec3), wp.mat33d(*pose[:3, :3].flatten().tolist()), wp.vec3d(*pose[:3, 3].tolist()),
            wp.mat33d(*intrinsics.flatten().tolist()), wp.float64(1e-9 * farthest), wp.float64(across), wp.float64(down),
        ],
        [warp_array(side), warp_array(box, wp.vec4i)],
        warp_device(side),
    )  # fmt: skip
    covered, crossing = (torch.zeros(count, dtype=torch.bool, device=device) for count in (across * down, 1))
    inputs = [warp_array(mesh.faces.int().reshape(-1)), warp_array(side), warp_array(box, wp.vec4i), across, down]
    launch(mark_tiles, len(mesh.faces), inputs, [warp_array(covered), warp_array(crossing)], warp_device(covered))
    return torch.ones_like(covered) if bool(crossing) else covered


_boxes: WeakKeyDictionary[TriangleMesh, Tensor] = WeakKeyDictionary()
"""(2, 3) lowest and highest corner of meshes that live: every picture of a moving camera asks for them."""


def tiles_of_box(mesh: TriangleMesh, camera: Camera) -> Tensor:
    """(tile,) bool: those of tiles_of_mesh and more, found without a look at the faces: the rectangle around the mesh's box on the screen."""
    across, down = tile_grid(camera.width, camera.height)
    covered = torch.zeros(down, across, dtype=torch.bool, device=mesh.vertices.device)
    if len(mesh.vertices) == 0:
        return covered.flatten()
    if mesh not in _boxes:
        _boxes[mesh] = torch.stack([mesh.vertices.amin(0), mesh.vertices.amax(0)]).detach().double().cpu()
    low, high = _boxes[mesh]
    corners = torch.where(_CORNERS, high, low)
    pose = camera.camera_from_world.double().cpu()
    in_camera = corners @ pose[:3, :3].T + pose[:3, 3]
    nearest = float(in_camera[:, 2].min())
    if nearest <= 1e-6 * float(in_camera.abs().max()):  # the box reaches behind the camera: it may be seen anywhere
        return torch.ones_like(covered).flatten()
    on_screen = in_camera @ camera.intrinsics.double().cpu().T
    places = on_screen[:, :2] / on_screen[:, 2:]
    first = ((places.amin(0) - float(MARGIN)) / int(TILE)).floor().clamp(min=0).long().tolist()
    last = ((places.amax(0) + float(MARGIN)) / int(TILE)).floor().long().tolist()
    covered[first[1] : max(0, last[1] + 1), first[0] : max(0, last[0] + 1)] = True
    return covered.flatten()


def pixels_of_tiles(tiles: Tensor, width: int, height: int) -> Tensor:
    """(pixel,) int32, ascending: the pixels of chosen tiles (tile,) bool."""
    across, down = tile_grid(width, height)
    wide = tiles.view(down, across).repeat_interleave(TILE, 0)[:height].repeat_interleave(TILE, 1)[:, :width]
    return torch.nonzero(wide.reshape(-1)).squeeze(-1).int()
