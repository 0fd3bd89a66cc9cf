"""The ways that are compared, in the order of the tables."""

from benchmarks.paper.variant import AbstractVariant
from benchmarks.paper.variants.gaussian_mesh import GAUSSIAN_MESH
from benchmarks.paper.variants.gsp import GSP
from benchmarks.paper.variants.mani_gs import MANI_GS
from benchmarks.paper.variants.ours import OURS_GAUSSIANS, OURS_MESH, OURS_PARTICLES
from benchmarks.paper.variants.physgaussian import PHYSGAUSSIAN
from benchmarks.paper.variants.sugar import SUGAR

VARIANTS: dict[str, AbstractVariant] = {
    variant.name: variant for variant in (SUGAR, GAUSSIAN_MESH, MANI_GS, PHYSGAUSSIAN, GSP, OURS_GAUSSIANS, OURS_MESH, OURS_PARTICLES)
}
