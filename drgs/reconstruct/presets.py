"""The presets of a build: all numbers that differ between draft, fast and full.

In: nothing. Out: PRESETS, by name; each a Preset, settings of every stage.
"""

from dataclasses import dataclass, field, replace
from typing import Literal

from drgs.reconstruct.capture.find_hollows import HollowSettings
from drgs.reconstruct.capture.open_vessels import VesselSettings
from drgs.reconstruct.capture.visual_hull import VisualHullSettings
from drgs.reconstruct.fit.densify import DensifySettings
from drgs.reconstruct.fit.evidence.solve_albedo import DetailSettings
from drgs.reconstruct.fit.surface.fit_mesh_materials import MeshMaterialSettings
from drgs.reconstruct.fit.surface.fit_surface import SurfaceRates, SurfaceSettings
from drgs.reconstruct.fit.surface.surface_passes import PASS_MESH, PassSettings
from drgs.reconstruct.fit.surfels.fit_gaussians import FitSettings
from drgs.reconstruct.fit.surfels.fit_materials import MaterialSettings
from drgs.reconstruct.fit.surfels.fit_mesh_surfels import MeshFitSettings
from drgs.reconstruct.geometry.divide_faces import DivisionSettings
from drgs.reconstruct.geometry.extract_mesh import FAST_MESH, FULL_MESH, MeshSettings
from drgs.render.records import SampleCounts


@dataclass(frozen=True)
class UnderTurningLight:
    """What a build takes more of where light turns with the camera. Shadows move there, of which stage 1 has coarse ones: it leaves a worse shape."""

    times_stage_one: int = 1
    """Its iterations, times so many."""
    passes: int = 0
    """More of them."""
    displacement_steps: int = 0
    """At least so many (PassSettings.displacement_steps)."""


@dataclass(frozen=True)
class Preset:
    """All numbers that differ between draft, fast and full."""

    points: int
    image_side: int
    """Photos are reduced to at most this [pixels]."""
    fit: FitSettings
    mesh: MeshSettings
    surface: PassSettings = field(default_factory=PassSettings)
    materials: MeshMaterialSettings = field(default_factory=MeshMaterialSettings)
    detail: DetailSettings = field(default_factory=DetailSettings)
    """Of the albedo between vertices."""
    hollows: HollowSettings = field(default_factory=HollowSettings)
    mesh_surfels: MeshFitSettings = field(default_factory=MeshFitSettings)
    """For binding mesh: its fine-tuning."""
    materials_on: Literal["mesh", "surfels"] = "mesh"
    """surfels: the mesh stays as it was extracted, and materials are fitted on surfels, as in the paper; then `surface` and `materials`
    are idle."""
    surfel_materials: MaterialSettings = field(default_factory=MaterialSettings)
    """Of materials_on surfels. Bound to the mesh, that one has as many faces at most as surfels are allowed (fit.densify.budget)."""
    hull: VisualHullSettings = field(default_factory=VisualHullSettings)
    """Of the masks, on whose surface points begin."""
    vessels: VesselSettings = field(default_factory=VesselSettings)
    """Whose insides that surface is to have."""
    turning: UnderTurningLight = field(default_factory=UnderTurningLight)
    """What under_turning_light adds."""

    def under_turning_light(self) -> "Preset":
        """The same where light turns with the camera."""
        more, surface = self.turning, self.surface.with_more_passes(self.turning.passes)
        surface = replace(surface, displacement_steps=max(surface.displacement_steps, more.displacement_steps))
        return replace(self, surface=surface, fit=replace(self.fit, iterations=more.times_stage_one * self.fit.iterations))


FINE_MATERIALS = MeshMaterialSettings(rates=SurfaceRates(normals=0.0015), gradient_rings=2, times_light=2)
"""Stage 2 that has steps enough for normals to go on by it."""

PRESETS = {
    "draft": Preset(
        8_000,
        256,
        FitSettings(iterations=400, half_size_share=0.6, densify=DensifySettings(budget=12_000)),
        replace(FAST_MESH, resolution=160, face_limit=30_000),
        PassSettings(
            3,
            SurfaceSettings(rounds=1, steps_a_round=50),
            replace(PASS_MESH, resolution=120, face_limit=30_000),
            cameras_after=(1, 2),
            division=DivisionSettings(most_faces=0),
        ),
        MeshMaterialSettings(iterations=80, points_a_step=2048, times_light=2),
        DetailSettings(most_samples=500_000, side=1024),
        mesh_surfels=MeshFitSettings(iterations=150),
        surfel_materials=MaterialSettings(iterations=80, points_a_step=512),
        turning=UnderTurningLight(times_stage_one=2, passes=2, displacement_steps=400),
    ),
    "fast": Preset(
        15_000,
        512,
        FitSettings(iterations=400, densify=DensifySettings(budget=30_000)),
        FAST_MESH,
        PassSettings(5, SurfaceSettings(rounds=1, steps_a_round=70, pixels_a_step=32_768), cameras_after=(1, 2, 3)),
        replace(FINE_MATERIALS, iterations=330, rounds=3),
        DetailSettings(),
        mesh_surfels=MeshFitSettings(iterations=300),
        surfel_materials=MaterialSettings(iterations=300),
        turning=UnderTurningLight(times_stage_one=3, passes=2, displacement_steps=150),
    ),
    "full": Preset(
        25_000,
        1024,
        FitSettings(iterations=1400, half_size_share=0.25, most_pixels=320_000, densify=DensifySettings(budget=40_000)),
        FULL_MESH,
        PassSettings(
            10,
            mesh=replace(PASS_MESH, resolution=320, face_limit=200_000),
            cameras_after=(2, 4, 6),
            try_after=(2,),
            displacement_steps=600,
            division=DivisionSettings(most_faces=400_000),
        ),
        replace(FINE_MATERIALS, iterations=2400, rounds=12, points_a_step=8192),
        DetailSettings(most_samples=6_000_000, side=4096),
        mesh_surfels=MeshFitSettings(iterations=500),
        surfel_materials=MaterialSettings(iterations=500, samples=SampleCounts(96, 48, 48)),
    ),
}
