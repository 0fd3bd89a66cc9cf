"""The surface follows the normals that shading found and the masks' outlines, and the light on it is traced anew.

In: the state of a fit on the mesh (fit_surface, fit_mesh_materials), its faces, views with masks. Out, in the same state: moved vertices, normals
nearer to theirs, the share of an open sky's irradiance that arrives at each, and on demand what is metal; a tracer of the moved mesh.
"""

import math
from dataclasses import dataclass, field
from functools import cached_property

import torch
from torch import Tensor

from drgs.reconstruct.capture.build_box import BuildBox, whole_or_within
from drgs.reconstruct.fit.evidence.light_from_paint import PaintLightSettings, light_from_paint
from drgs.reconstruct.fit.evidence.light_from_turns import TurnedLightSettings, even_choice, light_from_turns
from drgs.reconstruct.fit.evidence.matched_texture import matched_texture
from drgs.reconstruct.fit.evidence.metal_evidence import ViewSums, light_scale, metal_evidence, view_sums
from drgs.reconstruct.fit.fit_loop import FitState
from drgs.reconstruct.fit.light.environment_pyramid import ENVIRONMENT_PYRAMID, environment_table, upsampled
from drgs.reconstruct.fit.light.ground_light import ground_light
from drgs.reconstruct.fit.light.mesh_light import LightOf, MeshLight, irradiance_share
from drgs.reconstruct.fit.light.split_sum import filter_environment, shade_split_sum
from drgs.reconstruct.fit.light.turned_light import COARSE, Fineness, SeenSky, light_of_views, seen_sky
from drgs.reconstruct.fit.surfel_parameters import logits_of_shares
from drgs.reconstruct.fit.view_targets import ViewTarget
from drgs.reconstruct.geometry.average_around import Averaging, averaged, averaging_matrix
from drgs.reconstruct.geometry.integrate_normals import IntegrationSettings, Places, integrate_normals
from drgs.reconstruct.geometry.mask_outlines import OutlineRays, mask_outlines, outline_rays, outline_residuals
from drgs.reconstruct.geometry.mesh_edges import mesh_edges
from drgs.reconstruct.geometry.thickness import OtherSide, other_side
from drgs.render.intersect.trace_rays import build_tracer
from drgs.render.intersect.tracer import AbstractTracer
from drgs.scene.environment import Environment
from drgs.scene.mesh import TriangleMesh, vertex_normals
from drgs.scene.views import Views

SHARED_RINGS = 2
"""Edges over which shares of irradiance are averaged."""
MEAN_VIEWS = 8
"""Photographs over which irradiance is averaged where the light turns with the camera."""
LEAST_CELLS = 1.5
"""Of the mesh that is made anew, below which no move makes a part thinner: what is thinner than a cell has holes then."""
ALIKE = 16
"""Power of the cosine between normals by which a neighbour counts."""


@dataclass(frozen=True)
class MoveSettings:
    """How the surface follows."""

    integration: IntegrationSettings = field(default_factory=IntegrationSettings)
    solves: int = 2
    """Of positions: outlines are found anew between."""
    to_surface: float = 1.0
    """Share by which normals return to the surface's own afterwards."""
    resolution: int = 200
    """Cells along the longest side, with which the surface is meshed anew."""
    share_rays: int = 48
    """A vertex, for the irradiance that arrives there."""
    texture_radius: float = 0.0
    """Of the object [world units], in shares of which texture is looked for before and behind the surface; 0: it is not looked for."""
    paint_light: PaintLightSettings = field(default_factory=PaintLightSettings)
    """By which paint is alike on all sides."""
    box: BuildBox | None = None
    """Of the build, which the surface does not leave."""


class MovingSurface:
    """Final. The mesh of a fit, with the tracer of where it is now."""

    def __init__(
        self, views: Views, faces: Tensor, state: FitState, same_place: "MovingSurface | None" = None, fineness: Fineness = COARSE
    ) -> None:
        """
        Args:
            same_place: a surface whose vertices lie where the state's do, and whose faces these are: what rays find there need not be found anew.
            fineness: of what each vertex sees of light that turns.
        """
        self._state, self.faces = state, faces
        self._cameras = tuple(camera.to(faces.device) for camera in views.cameras)
        self._views = views
        self.light_turns = views.light_from_world is not None
        self._fineness = fineness
        self.ground = None if views.ground is None else ground_light(views.ground, faces.device)
        self._seen_sky: SeenSky | None = None
        self._around: Averaging | None = None
        if same_place is None:
            self.edges, self.tracer = mesh_edges(faces), self._tracer()
        else:
            self.edges, self._seen_sky = same_place.edges, same_place.sky
            self.tracer = same_place.tracer.with_materials(mesh_from_surface_fit(state, faces))

    @cached_property
    def _outlines(self) -> OutlineRays:
        outlines = mask_outlines(self._views) if self._views.has_masks else []
        return outline_rays(self._cameras if outlines else (), outlines, self.faces.device)

    @property
    def sky(self) -> SeenSky | None:
        """What the vertices see, where the light turns: traced when it is first asked for after relight, as fits do many times between two moves."""
        if self.light_turns and self._seen_sky is None:
            self._seen_sky = seen_sky(self.tracer, self._fineness)
        return self._seen_sky

    def _tracer(self) -> AbstractTracer:
        tracer = build_tracer(mesh_from_surface_fit(self._state, self.faces))
        _ = tracer.face_normals  # computed once, shared by the copies with other materials
        return tracer

    @torch.no_grad()
    def follow(self) -> None:
        """The tracer lies where the state's vertices do now; what light arrives stays what it was."""
        self.tracer, self._around = self._tracer(), None

    @torch.no_grad()
    def behind(self, settings: MoveSettings) -> OtherSide:
        """The other side of what is thin, as the tracer has it now."""
        vertices = self.tracer.mesh.vertices
        cell = float((vertices.amax(0) - vertices.amin(0)).max()) / settings.resolution
        return other_side(self.tracer, LEAST_CELLS * cell)

    @torch.no_grad()
    def move(self, settings: MoveSettings, relight: bool = True) -> None:
        """Positions from normals and outlines, then light that the moved surface blocks and sends back.

        Args:
            relight: False: what arrives stays what it was, for the surface is meshed anew, and moves, before it is shaded again.
        """
        parameters = self._state.parameters
        normals = torch.nn.functional.normalize(parameters["normals"], dim=-1)
        for _ in range(settings.solves):
            residuals = outline_residuals(self.tracer, self._outlines)
            vertices, homeward = parameters["vertices"], parameters["homeward"]
            # Of metal mirrors say where it lies.
            homes = Places(homeward, (-parameters["metal"]).clamp(0, 1))
            texture = Places(parameters["to_texture"], parameters["texture_weight"])
            moved = integrate_normals(
                vertices, self.faces, normals, self.edges, residuals, settings.integration, homes, texture, self.behind(settings)
            )
            moved = whole_or_within(settings.box, moved)
            for place in (homeward, parameters["to_texture"]):
                place += vertices - moved
            vertices.copy_(moved)
            self.follow()
        own = vertex_normals(parameters["vertices"], self.faces)
        back = (1 - settings.to_surface) * normals + settings.to_surface * own
        parameters["normals"].copy_(torch.nn.functional.normalize(back, dim=-1))
        if relight:
            self.relight(settings.share_rays)
        else:
            self.tracer = self.tracer.with_materials(mesh_from_surface_fit(self._state, self.faces))

    @torch.no_grad()
    def look_for_texture(self, settings: MoveSettings) -> None:
        """Where the photographs show now that the surface's pattern lies. Not before metal was looked for: what mirrors would be taken for a pattern."""
        parameters = self._state.parameters
        if not settings.texture_radius or not bool(parameters["metal"].any()):
            return
        normals = torch.nn.functional.normalize(parameters["normals"], dim=-1)
        found = matched_texture(self.tracer, normals, parameters["metal"], self.edges, self._views, settings.texture_radius)
        parameters["texture_weight"].copy_(found.weight)
        parameters["to_texture"].copy_(found.places - parameters["vertices"])

    @torch.no_grad()
    def relight(self, share_rays: int) -> None:
        """Light that the surface, as it is now, blocks and sends back.

        Args:
            share_rays: a vertex, for the irradiance that arrives there.
        """
        parameters = self._state.parameters
        self.tracer = self.tracer.with_materials(mesh_from_surface_fit(self._state, self.faces))
        self._seen_sky = None
        if self.light_turns:
            return
        radiance = environment_table(parameters)
        light = MeshLight(filter_environment(radiance), parameters["open_share"], ground=self.ground)
        share = irradiance_share(self.tracer, Environment(radiance), light, share_rays, self._state.generator)
        parameters["open_share"].copy_(self._agreed_share(share))

    def _agreed_share(self, share: Tensor) -> Tensor:
        """The means around of (vertex, 3) shares. A few rays a vertex err by a tenth, which materials and normals would then explain; light changes less
        than that within two edges, but for places that face elsewhere: they count little."""
        return averaged(self.around(), share, SHARED_RINGS)

    def around(self) -> Averaging:
        """averaging_matrix over neighbours that face the same way, of the surface as it lies now; made anew after a move."""
        if self._around is None:
            normals = vertex_normals(self._state.parameters["vertices"], self.faces)
            start, end = self.edges.vertices.unbind(1)
            alike = (normals[start] * normals[end]).sum(-1).clamp(min=0) ** ALIKE
            self._around = averaging_matrix(self.edges, len(normals), alike)
        return self._around

    @torch.no_grad()
    def look_for_light(self, targets: list[ViewTarget], settings: MoveSettings) -> None:
        """The light under which paint is alike on all sides, and the paint's albedo under it."""
        parameters = self._state.parameters
        radiance = environment_table(parameters)
        self.tracer = self.tracer.with_materials(mesh_from_surface_fit(self._state, self.faces))
        paint, generator = parameters["metal"] <= 0, self._state.generator
        light_of = self.light_of(filter_environment(radiance))
        if self.light_turns:
            own = TurnedLightSettings(settings.paint_light)
            factor = light_from_turns(self.tracer, radiance, light_of, targets, paint, own, generator)
        else:
            factor = light_from_paint(self.tracer, radiance, light_of(targets[0]), paint, settings.paint_light, generator)
        if factor is None:
            return
        before = self._mean_irradiance(targets)
        parameters[f"environment_{ENVIRONMENT_PYRAMID[1]}"] += upsampled(factor.log().permute(2, 0, 1)[None], ENVIRONMENT_PYRAMID[1])
        if not self.light_turns:
            self.relight(settings.share_rays)
        after = self._mean_irradiance(targets)
        albedo = torch.sigmoid(parameters["albedo_logits"])
        # Gloss goes with the light, and paint has to make up for it.
        gloss = settings.paint_light.gloss
        changed = logits_of_shares((albedo + gloss) * before / after.clamp(min=1e-6) - gloss)
        parameters["albedo_logits"].copy_(torch.where(paint[:, None], changed, parameters["albedo_logits"]))

    def _mean_irradiance(self, targets: list[ViewTarget]) -> Tensor:
        """(vertex, 3) of irradiance; where the light turns, over some photographs from whose side a vertex faces."""
        light_of = self.light_of(filter_environment(environment_table(self._state.parameters)))
        if not self.light_turns:
            return self.irradiance(light_of(targets[0]))
        mesh = self.tracer.mesh
        total, weight = torch.zeros_like(mesh.vertices), torch.full_like(mesh.vertices[:, :1], 1e-6)
        for target in (targets[k] for k in even_choice(len(targets), MEAN_VIEWS)):
            towards = torch.nn.functional.normalize(target.camera.center_world - mesh.vertices, dim=-1)
            facing = (mesh.normals * towards).sum(-1, keepdim=True).clamp(min=0) + 1e-6
            total += facing * self.irradiance(light_of(target))
            weight += facing
        return total / weight

    def irradiance(self, light: MeshLight) -> Tensor:
        """(vertex, 3), over pi, that arrives."""
        normals = torch.nn.functional.normalize(self._state.parameters["normals"], dim=-1)
        black, one = torch.zeros_like(normals), torch.ones_like(normals)
        white, none = (
            shade_split_sum(
                albedo, black, black, one[:, 0].contiguous(), normals, normals, light.tables,
                open_share=light.open_share, light_from_world=light.light_from_world,
            )
            for albedo in (one, black)
        )  # fmt: skip
        return white - none

    def light_of(self, tables: Tensor, normals: Tensor | None = None) -> LightOf:
        """What light arrives at the surface in each photograph.

        Args:
            tables: of filter_environment. normals: of light_of_views.
        """
        parameters = self._state.parameters
        albedo = torch.sigmoid(parameters["albedo_logits"].detach())
        return light_of_views(tables, parameters["open_share"], albedo, self.sky, normals, self.ground)

    @torch.no_grad()
    def look_for_metal(self, targets: list[ViewTarget], settings: MoveSettings) -> ViewSums:
        """What the photographs say now of which places are metal, and of how bright the light is. Returns by what they say it, under the light as it is afterwards."""
        sums = self.sums(targets)
        parameters = self._state.parameters
        scale = light_scale(sums)
        parameters["metal"].copy_(metal_evidence(sums, self.edges, self.light_turns, scale))
        if scale != 1:
            parameters[f"environment_{ENVIRONMENT_PYRAMID[0]}"] += math.log(scale)
            parameters["albedo_logits"].copy_(logits_of_shares(torch.sigmoid(parameters["albedo_logits"]) / scale))
            self.relight(settings.share_rays)
            return self.sums(targets)
        return sums

    @torch.no_grad()
    def sums(self, targets: list[ViewTarget]) -> ViewSums:
        """What the photographs say of each vertex, under the light as it is."""
        tables = filter_environment(environment_table(self._state.parameters))
        return view_sums(self.tracer, targets, self.light_of(tables))


def mesh_from_surface_fit(state: FitState, faces: Tensor) -> TriangleMesh:
    """The mesh as it is now; its normals are the fitted ones."""
    p = {name: value.detach() for name, value in state.parameters.items()}
    return TriangleMesh(
        p["vertices"].contiguous(),
        faces,
        torch.nn.functional.normalize(p["normals"], dim=-1),
        torch.sigmoid(p["albedo_logits"]),
        torch.sigmoid(p["roughness_logits"]),
        torch.sigmoid(p["metallic_logits"]),
    )
