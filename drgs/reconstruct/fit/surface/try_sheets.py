"""Narrow hollows of metal that were filled are emptied where photographs are explained better: the sheets beside them are tried as their walls.

try_depths sinks a filling as it is; in a groove of metal every floor in between mirrors the wrong things, so only the groove itself is explained better than its cap
(docs/decisions/0003-fitting.md). So what is tried has the groove's shape: one wall is the surface beside the cap, gone on with (find_fillings). All fillings are emptied
at once, by several shares of their width, and meshed anew, for a wall has no vertices yet; normals and materials get some steps. Of most that explains far
worse: nothing was filled there. The others are loose; they alone are emptied in one more trial, each by the share that was best, and stay so where that is better.
Only metal is asked, whose walls mirror each other: on paint what is explained better is seldom righter, and try_depths finds it.

In: the state of a fit on the mesh (fit_surface), photographs. Out: that state, its surface without such fillings.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_matrix
from torch import Tensor

from drgs.reconstruct.fit.fit_loop import FitReport
from drgs.reconstruct.fit.surface.try_depths import FOREIGN_ERROR, Settled, Trials, TrialSettings, error_ratio
from drgs.reconstruct.geometry.average_around import averaged, averaging_matrix, rings_as_wide_as
from drgs.reconstruct.geometry.extract_mesh import MeshSettings
from drgs.reconstruct.geometry.find_fillings import FillingSettings, emptied, find_fillings
from drgs.reconstruct.geometry.mesh_edges import mesh_edges
from drgs.reconstruct.geometry.remesh import remesh
from drgs.scene.mesh import vertex_normals
from drgs.scene.views import Views

BLENDED = 2
"""Rings over which what is emptied passes into what stays."""
PAINT_RINGS = 60
"""Over which paint grows into fillings."""
CARRIED = 0.3
"""Of a vertex meshed anew: what at least it must have of emptied ones, to take its normal from the surface."""


@dataclass(frozen=True)
class SheetSettings:
    """Which fillings are tried, and how it is decided."""

    fillings: FillingSettings = field(default_factory=FillingSettings)
    shares: tuple[float, ...] = (0.35, 0.65, 1.0)
    """Of a cap's width, for which the sheet goes on."""
    trials: TrialSettings = field(default_factory=lambda: TrialSettings(steps=100))
    """Of its settings `steps`, `rates`, weights, pixels, rays and `spread`."""
    loose: float = 1.15
    """Share of the error that is left where a filling is tried once more, at most. Right places have 1.4 and more."""
    better: float = 0.95
    """The same where it is emptied."""

    @property
    def iterations(self) -> int:
        """Steps of all trials together: as it is, the shares and the last one."""
        return (len(self.shares) + 2) * self.trials.steps


@dataclass(frozen=True, eq=False)
class TriedSheets:
    """What trials found."""

    parameters: dict[str, Tensor]
    """Of the surface as it is now."""
    moved: Bool[Tensor, "vertex"]
    """What was emptied."""


def try_sheets(
    views: Views,
    parameters: dict[str, Tensor],
    faces: Int[Tensor, "face 3"],
    settings: SheetSettings,
    mesh: MeshSettings,
    radius: float,
    seed: int,
    report: Callable[[FitReport], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> TriedSheets | None:
    """The surface without what trials say fills its hollows; None: should_stop(), asked before each step, said so.

    Args:
        parameters: of a surface's fit. mesh: how fine what is tried is meshed. radius: of the object's bounding sphere [world units]. report: is told of
            the steps of all trials.

    Raises:
        NothingEnclosed: the surface, or one without its fillings, has no inside.
    """
    parameters = {name: value.detach() for name, value in parameters.items()}
    vertices, count = parameters["vertices"], len(parameters["vertices"])
    normals = torch.nn.functional.normalize(parameters["normals"], dim=-1)
    found = find_fillings(vertices, faces, normals, radius, settings.fillings)
    fillings = [filling for filling in found if bool(parameters["metal"][filling.vertices].mean() > 0)]
    edges = mesh_edges(faces)
    around = averaging_matrix(edges, count)
    nothing = torch.zeros(count, dtype=torch.bool, device=vertices.device)
    if not fillings:
        return TriedSheets(parameters, nothing)
    rings = rings_as_wide_as(settings.trials.spread * radius, edges, vertices)

    def smoothed(values: Tensor, over: int = rings) -> Tensor:
        return averaged(around, values.float().view(count, -1), over).squeeze(1)

    without = [emptied(vertices, fillings, share, around) for share in settings.shares]
    filled = without[0][1]
    # What a cap needs to look like the hollow is no paint of the hollow.
    painted = parameters | _paint_from_around(parameters, smoothed(filled, BLENDED) > 0, around)
    trials = _SheetTrials(views, painted, faces, settings, mesh, seed, report, should_stop)
    if not trials.begin(vertices):
        return None

    ratios = []
    for places, _ in without:
        errors = trials.errors(places, filled)
        if errors is None:
            return None
        ratios.append(error_ratio(*(smoothed(sums) for sums in errors)))
    least, best = torch.stack(ratios, 1).nan_to_num(nan=torch.inf).min(1)
    loose = filled & (least < settings.loose)
    if not loose.any():
        return TriedSheets(parameters, nothing)
    places = vertices.clone()
    for number, (there, _) in enumerate(without):
        places += smoothed(loose & (best == number), BLENDED)[:, None] * (there - vertices)
    errors = trials.errors(places, loose)
    if errors is None:
        return None
    ratio = error_ratio(*(smoothed(sums) for sums in errors))
    kept = smoothed(loose & (ratio < settings.better), max(1, rings // 2)) > 0.5
    share = smoothed(kept, BLENDED)
    moved = share > CARRIED
    final = vertices + share[:, None] * (places - vertices)
    result = {
        name: torch.where(moved.view(count, *[1] * (value.ndim - 1)), painted[name], value)
        for name, value in parameters.items()
        if not name.startswith("environment_")
    }
    result["vertices"] = final
    result["normals"] = torch.where(moved[:, None], vertex_normals(final, faces), parameters["normals"])
    return TriedSheets(parameters | result, moved)


def _paint_from_around(parameters: dict[str, Tensor], filled: Bool[Tensor, "vertex"], around: csr_matrix) -> dict[str, Tensor]:
    """Materials, those of fillings grown in from around them."""
    outside = (~filled).float()[:, None]
    grown = {}
    for name in ("albedo_logits", "roughness_logits", "metallic_logits"):
        values = parameters[name].view(len(filled), -1)
        sums = averaged(around, torch.cat([outside * values, outside], 1).double(), PAINT_RINGS)
        paint = torch.where(sums[:, -1:] > 0, sums[:, :-1] / sums[:, -1:].clamp(min=1e-300), values.double()).to(values)
        grown[name] = torch.where(filled[:, None], paint, values).view(parameters[name].shape)
    return grown


class _SheetTrials:
    """Final. Shapes of one surface, each meshed anew, compared by the pixels that see its places as they are."""

    def __init__(
        self,
        views: Views,
        parameters: dict[str, Tensor],
        faces: Tensor,
        settings: SheetSettings,
        mesh: MeshSettings,
        seed: int,
        report: Callable[[FitReport], None] | None,
        should_stop: Callable[[], bool] | None,
    ) -> None:
        self._views, self._parameters, self._faces = views, parameters, faces
        self._settings, self._mesh, self._seed = settings, mesh, seed
        self._report, self._should_stop, self._done = report, should_stop, 0
        self._before: Settled
        self._nearest: list[Tensor] = []

    def begin(self, vertices: Float[Tensor, "vertex 3"]) -> bool:
        """The surface as it is; False: should_stop() said so."""
        before, corner = self._settled(vertices, torch.zeros(len(vertices), dtype=torch.bool, device=vertices.device))
        if before is None:
            return False
        self._before = before
        self._nearest = [torch.where(seen >= 0, corner[seen.clamp(min=0)], seen) for seen in before.nearest]
        return True

    def errors(self, vertices: Float[Tensor, "vertex 3"], moved: Bool[Tensor, "vertex"]) -> tuple[Tensor, Tensor] | None:
        """For each vertex of the surface as it was, (vertex, 2) sum of squared errors and number of pixels: with the vertices there, and as it is."""
        there, _ = self._settled(vertices, moved)
        if there is None:
            return None
        sums = torch.zeros(2, len(vertices), 2, device=vertices.device)
        views = zip(self._nearest, there.nearest, there.squares, self._before.squares, strict=True)
        for nearest, sees, new, old in views:
            # A hole where the object is seen.
            new = torch.where(sees < 0, torch.full_like(new, FOREIGN_ERROR), new)
            both = (nearest >= 0) & ~new.isnan() & ~old.isnan()
            for total, squares in zip(sums, (new, old), strict=True):
                total.index_add_(0, nearest[both], torch.stack([squares[both], torch.ones_like(squares[both])], 1))
        return sums[0], sums[1]

    def _settled(self, vertices: Tensor, moved: Tensor) -> tuple[Settled | None, Tensor]:
        """With the vertices there, and of each of its own vertices the nearest one of the surface as it was."""
        new = remesh(vertices, self._faces, self._mesh)
        values = {name: value if name.startswith("environment_") else new.carried(value) for name, value in self._parameters.items()}
        values["vertices"] = new.vertices
        own = new.carried(moved.float()[:, None]) > CARRIED
        values["normals"] = torch.where(own, vertex_normals(new.vertices, new.faces), values["normals"])
        trials = Trials(self._views, new.faces, self._settings.trials, self._seed, self._tell, self._should_stop)
        settled = trials.settled(values)
        self._done += self._settings.trials.steps
        corner = new.corners.gather(1, new.weights.argmax(1, keepdim=True)).squeeze(1)
        return (None if trials.stopped else settled), corner

    def _tell(self, r: FitReport) -> None:
        if self._report is not None:
            self._report(replace(r, iteration=self._done + r.iteration, iterations=self._settings.iterations))
