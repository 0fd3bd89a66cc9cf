"""Compile what pictures need, before somebody waits for one.

    python -m drgs.render.compile_kernels [auto|cpu|cuda]

In: a device. Out: compiled kernels where Warp keeps them, and a note that they are there (drgs/compiled_kernels.py). Small pictures of a small object are
made as a server makes them: of a camera that moves, and at rest, filtered, with what an edit of materials makes old.
"""

import sys
from dataclasses import replace

import torch

from drgs.compiled_kernels import note
from drgs.render.film.resolve_frame import resolve_frame
from drgs.render.progressive.refine import refine_frame
from drgs.render.progressive.start_frame import start_frame
from drgs.render.records import RenderSettings
from drgs.scene.camera import Camera
from drgs.scene.environment import Environment
from drgs.scene.mesh import TriangleMesh, vertex_normals
from drgs.scene.posed_scene import PosedScene
from drgs.warp_torch import device_from_name

SIDE = 32
"""Of the pictures [pixels]."""
PASSES = 6
"""At rest: from the fifth on they look unevenly."""


def compile_kernels(device: torch.device) -> None:
    """Make the pictures; Warp compiles what it has not yet."""
    scene = PosedScene(None, _octahedron(device), Environment(_sky(device)))
    moving = RenderSettings(samples_per_pixel=32, samples_per_pass=32, denoise="svgf", keep_light=True)
    state = None
    for step in range(4):
        state = refine_frame(start_frame(scene, _camera(0.02 * step, device), moving, previous=state))
        resolve_frame(state)
    camera = _camera(0.06, device)
    state = start_frame(scene, camera, replace(moving, samples_per_pass=None), previous=state)
    for _ in range(PASSES):
        state = refine_frame(state)
    resolve_frame(state)
    painted = replace(scene, mesh=replace(scene.mesh, roughness=0.5 * scene.mesh.roughness))
    resolve_frame(refine_frame(start_frame(painted, camera, replace(moving, samples_per_pass=None), previous=state)))


def main() -> None:
    """Compile, and leave the note."""
    compile_kernels(device_from_name(sys.argv[1] if len(sys.argv) > 1 else "auto"))
    try:
        note().parent.mkdir(parents=True, exist_ok=True)
        note().touch()
    except OSError as error:  # a home that cannot be written to: the next start compiles again, from Warp's own memory
        print(f"drgs: that kernels are compiled cannot be noted ({error})", file=sys.stderr)


def _octahedron(device: torch.device) -> TriangleMesh:
    """Half of it metal: all strategies of sampling are used."""
    vertices = torch.cat([torch.eye(3), -torch.eye(3)]).to(device)
    faces = torch.tensor(
        [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]], dtype=torch.int32, device=device
    )
    metallic = (vertices[:, 0] > 0).float()
    return TriangleMesh(
        vertices, faces, vertex_normals(vertices, faces), torch.full_like(vertices, 0.5), torch.full_like(metallic, 0.4), metallic
    )


def _sky(device: torch.device) -> torch.Tensor:
    """With a lamp, so that directions are chosen among several."""
    radiance = torch.full((16, 32, 3), 0.5)
    radiance[4, 7] = 200.0
    return radiance.to(device)


def _camera(shift: float, device: torch.device) -> Camera:
    """Looks along z at the object, from a little beside."""
    camera_from_world = torch.eye(4)
    camera_from_world[:3, 3] = torch.tensor([shift, 0.0, 4.0])
    intrinsics = torch.tensor([[1.6 * SIDE, 0, SIDE / 2], [0, 1.6 * SIDE, SIDE / 2], [0, 0, 1]])
    return Camera(camera_from_world, intrinsics, SIDE, SIDE).to(device)


if __name__ == "__main__":
    main()
