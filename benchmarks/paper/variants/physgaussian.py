"""PhysGaussian's way: the Gaussians are the particles. Covariance F S F^T, and harmonics turned with the rotation of F.

Source: Xie et al. 2024 (docs/sources.md: xie2024).
"""

from benchmarks.paper.fields import Field
from benchmarks.paper.splats import Splats, moved_splats
from benchmarks.paper.variant import Bound, SplatVariant, baked, own_gaussians


def drive_particles(bound: Bound, field: Field) -> Splats:
    """Each Gaussian by the position and the gradient of its own centre."""
    centers, gradient = field(bound.splats.centers)
    return moved_splats(bound.splats, centers, gradient)


PHYSGAUSSIAN = SplatVariant(
    "physgaussian",
    "PhysGaussian",
    own_gaussians,
    drive_particles,
    baked,
    relights=False,
    simplified="the Gaussians are flat, and those of our surface; a known deformation moves them where the paper simulates; no particles are filled in, "
    "for nothing weighs",
)
