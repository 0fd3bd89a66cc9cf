"""A scene that wears what is known of it as its colour, so that whatever shows albedo shows certainty.

In: a posed scene, its asset's certainty and binding. Out: the same scene with red for shape, green for albedo and blue for material, the
less certain of roughness and metallic, in place of albedo (0..1): white is known, black is a guess. Shape and light stay as they are.
"""

from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from drgs.scene.binding import Binding
from drgs.scene.certainty import Certainty
from drgs.scene.posed_scene import PosedScene


def paint_certainty(
    scene: PosedScene, faces: Int[Tensor, "face 3"], certainty: Certainty | None, binding: Binding | None
) -> PosedScene | None:
    """None where nothing is known of what cameras see: there is no certainty, or none for Gaussians that are not bound to the mesh.

    Args:
        faces: of the asset's mesh. certainty: of its vertices. binding: of its Gaussians.
    """
    if certainty is None or (scene.primary == "gaussians" and binding is None):
        return None
    colors = certainty_colors(certainty)
    surfels = scene.surfels
    if surfels is not None and binding is not None:
        corners = colors[faces[binding.face.long()].long()]
        blended = (binding.barycentric[..., None] * corners).sum(1).clamp(0, 1)
        if scene.surfel_source is not None:
            blended = torch.cat([blended, colors[scene.surfel_source]])
        surfels = replace(surfels, materials=replace(surfels.materials, albedo=blended))
    if scene.vertex_source is not None:
        colors = colors[scene.vertex_source]
    return replace(scene, mesh=replace(scene.mesh, albedo=colors), surfels=surfels)


def certainty_colors(certainty: Certainty) -> Float[Tensor, "vertex 3"]:
    """Shape, albedo, and the less certain of roughness and metallic; float32."""
    material = torch.minimum(certainty.roughness, certainty.metallic)
    return torch.stack([certainty.shape, certainty.albedo, material], -1).float()
