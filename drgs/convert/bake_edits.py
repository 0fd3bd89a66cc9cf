"""An asset with edits put into it for good: what a session saves as a new version.

In: an asset and edits. Out: an asset whose rest state looks as the edits made it; its provenance keeps them. The environment is
turned and dimmed in its table (a turn that is no whole number of texels resamples it once); surfels whose tangents were sheared
become the same Gaussians in the axes of their ellipse. The splats' own baked radiance (SH) stays the capture's.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from drgs.deform.pose_scene import pose_scene
from drgs.maths.frames import quat_wxyz_from_rotation
from drgs.reconstruct.geometry.bind_gaussians import bind_gaussians
from drgs.scene.asset import Asset
from drgs.scene.certainty import Certainty
from drgs.scene.edits import Edit, plain_edit
from drgs.scene.environment import Environment, rotate_environment
from drgs.scene.gaussians import Gaussians
from drgs.scene.materials import Materials
from drgs.scene.mesh import TriangleMesh
from drgs.scene.posed_scene import PosedSurfels

LEAST_SCALE = 1e-12
"""Of a standard deviation, before its logarithm is taken [world units]."""


def bake_edits(asset: Asset, edits: Sequence[Edit], environments: Path, version: int) -> Asset:
    """The asset whose rest state looks as the edits made it.

    Args:
        environments: folder that edits name files in.
        version: of the new asset, for its provenance.

    Raises:
        ValueError: one sentence: an edit that does not fit this asset, or a missing or damaged file.
    """
    scene = pose_scene(asset, edits, environments, confine=True)
    gaussians, binding, horizons, certainty = asset.gaussians, asset.binding, scene.horizons, asset.certainty
    if certainty is not None and scene.vertex_source is not None:
        certainty = Certainty(**{name: values[scene.vertex_source] for name, values in vars(certainty).items()})
    if gaussians is not None and scene.surfels is not None:
        surfels = scene.surfels
        if scene.surfel_source is not None:
            gaussians, surfels = _with_grains(asset.mesh, gaussians, surfels, scene.surfel_source)
        gaussians = replace(
            gaussians, albedo=surfels.materials.albedo, roughness=surfels.materials.roughness, metallic=surfels.materials.metallic
        )
        if any(edit.op in ("deform", "pose", "simulate") for edit in edits):
            log_scales, quats = ellipse_axes(surfels.tangents)
            gaussians = replace(gaussians, centers=surfels.centers, log_scales=log_scales, quats_wxyz=quats)
            binding = bind_gaussians(gaussians.centers, scene.mesh)
    environment = scene.environment
    if scene.environment_rotation_degrees:
        environment = rotate_environment(environment, scene.environment_rotation_degrees)
    if scene.environment_intensity != 1:
        environment = Environment(environment.radiance * scene.environment_intensity)
    history = [*asset.provenance.get("versions", ()), {"version": version, "edits": [plain_edit(edit) for edit in edits]}]
    provenance = asset.provenance | {"versions": history}
    return replace(
        asset, gaussians=gaussians, mesh=scene.mesh, binding=binding, environment=environment, provenance=provenance, horizons=horizons,
        certainty=certainty,
    )  # fmt: skip


def _with_grains(
    mesh: TriangleMesh, gaussians: Gaussians, surfels: PosedSurfels, source: Int[Tensor, "grain_surfel"]
) -> tuple[Gaussians, PosedSurfels]:
    """Without the surfels that matter left when it came apart, and with those of its grains, whose radiance is that of the nearest surfel at rest."""
    _, nearest = cKDTree(gaussians.centers.cpu().numpy()).query(mesh.vertices[source].cpu().numpy())
    kept = (surfels.opacities[: len(gaussians.centers)] > 0).nonzero().flatten()
    taken = torch.cat([kept, torch.as_tensor(nearest, device=kept.device)])
    shown = torch.cat([kept, torch.arange(len(gaussians.centers), len(surfels.centers), device=kept.device)])
    materials = Materials(**{name: values[shown] for name, values in vars(surfels.materials).items()})
    posed = PosedSurfels(surfels.centers[shown], surfels.tangents[shown], surfels.opacities[shown], materials)
    taken_from = Gaussians(**{name: values[taken] for name, values in vars(gaussians).items()})
    grains = torch.logit(posed.opacities[len(kept) :])
    return replace(taken_from, opacity_logits=torch.cat([gaussians.opacity_logits[kept], grains])), posed


def ellipse_axes(tangents: Float[Tensor, "n 3 2"]) -> tuple[Float[Tensor, "n 2"], Float[Tensor, "n 4"]]:
    """Log standard deviations and rotations (wxyz) of the Gaussians that sheared tangents span [world units].

    Tangents B and the product U S of their singular value decomposition have the same covariance. The normal keeps the side of t_u x t_v.
    """
    u, s, vt = torch.linalg.svd(tangents.double(), full_matrices=False)
    # A reflected V would turn the normal over.
    u = torch.stack([u[..., 0], u[..., 1] * torch.linalg.det(vt).sign()[:, None]], -1)
    rotation = torch.cat([u, torch.linalg.cross(u[..., 0], u[..., 1])[..., None]], -1)
    return s.clamp_min(LEAST_SCALE).log().to(tangents.dtype), quat_wxyz_from_rotation(rotation).to(tangents.dtype)
