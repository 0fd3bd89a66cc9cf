"""What a photograph says of places on faces, against the same as operations on whole tensors in float64."""

import torch
from torch import Tensor

from drgs.maths.color import linear_from_srgb
from drgs.reconstruct.fit.evidence.albedo_kernels import add_photograph
from drgs.reconstruct.fit.evidence.metal_evidence import DARK
from drgs.reconstruct.fit.evidence.seen_vertices import SOLID
from drgs.reconstruct.fit.image_terms import SATURATED
from drgs.reconstruct.fit.view_targets import ViewTarget
from drgs.reconstruct.geometry.face_samples import FaceSamples, face_samples
from drgs.scene.camera import Camera
from tests.reconstruct.fit.evidence.test_matched_texture import cameras_above, sheet

SIDES = 4


def sums_twin(
    target: ViewTarget, samples: FaceSamples, vertices: Tensor, side: Tensor, black: Tensor, slope: Tensor, cosine: Tensor
) -> tuple[Tensor, Tensor]:
    """The specification."""
    camera, count = target.camera, len(samples.corners)
    shown = samples.between(side >= 0).nonzero().squeeze(1)
    some = FaceSamples(samples.number, samples.corners[shown], samples.weights[shown].double())
    transform = camera.camera_from_world.double()
    at = (some.at(vertices.double()) @ transform[:3, :3].T + transform[:3, 3]) @ camera.intrinsics.double().T
    place, size = at[:, :2] / at[:, 2:], torch.tensor([camera.width, camera.height])
    inside = ((place > 1) & (place < size - 1)).all(1).nonzero().squeeze(1)
    column, row = place[inside].long().unbind(1)
    whole = (target.mask[row, column] > SOLID) & (target.saturation[row, column].amax(-1) < SATURATED * target.ceiling)
    usable = inside[whole]
    grid = (2 * place[usable] / size - 1)[None, None]
    picture = target.saturation.double().permute(2, 0, 1)[None]
    photo = linear_from_srgb(torch.nn.functional.grid_sample(picture, grid, align_corners=False)[0, :, 0].T)
    own = some[usable]
    share = own.at(cosine.double()[:, None]) / (photo + DARK)
    weighed = share**2 * own.at(slope.double())
    explained, weight = (torch.zeros(SIDES, count, 3, dtype=torch.float64) for _ in range(2))
    chosen = side[own.nearest].long(), shown[usable]
    explained[chosen] = weighed * (photo - own.at(black.double()))
    weight[chosen] = weighed * own.at(slope.double())
    return explained, weight


def made_case(number: int) -> tuple[ViewTarget, FaceSamples, tuple[Tensor, ...]]:
    """A patterned sheet that is partly out of the picture, whose mask has a hole, of which a part is overexposed and a tenth of the vertices are hidden."""
    generator, mesh = torch.Generator().manual_seed(number), sheet(12)
    camera = cameras_above(4)[number]
    camera = Camera(camera.camera_from_world, camera.intrinsics, 96, 80, camera.name)
    picture = 0.9 * torch.rand(80, 96, 3, generator=generator)
    picture[20:40, 50:60] = 1.0
    mask = torch.ones(80, 96)
    mask[50:60, 30:45] = 0.5
    target = ViewTarget(camera, picture * mask[..., None], picture, mask, slice(0, 80), slice(0, 96))
    count = len(mesh.vertices)
    side = torch.randint(0, SIDES, (count,), generator=generator, dtype=torch.int32)
    side[torch.rand(count, generator=generator) < 0.1] = -1
    values = [torch.rand(count, 3, generator=generator) for _ in range(2)] + [torch.rand(count, generator=generator)]
    vertices = mesh.vertices * torch.tensor([1.5, 1.5, 1.0])
    return target, face_samples(mesh.faces, count, 5), (vertices, side, *values)


def test_sums_are_those_of_whole_tensors(device: str) -> None:
    expected = [torch.zeros(()), torch.zeros(())]
    found: list[Tensor] = []
    for number in range(2):
        target, samples, values = made_case(number)
        expected = [total + more for total, more in zip(expected, sums_twin(target, samples, *values), strict=True)]
        found = found or [torch.zeros(SIDES, len(samples.corners), 3, device=device) for _ in range(2)]
        moved = FaceSamples(*(x.to(device) for x in (samples.number, samples.corners, samples.weights)))
        photo, saturation, mask = (x.to(device) for x in (target.photo, target.saturation, target.mask))
        there = ViewTarget(target.camera.to(torch.device(device)), photo, saturation, mask, target.rows, target.columns)
        add_photograph(there, moved, *(x.to(device) for x in values), *found)
    said = int((expected[1] > 0).any(-1).any(0).sum())
    assert 0.3 * found[0].shape[1] < said < 0.9 * found[0].shape[1]
    for sums, twins in zip(found, expected, strict=True):
        # A sample that lies on the border of a pixel falls to either side of it: those are few, and each is counted or not.
        wrong = ((sums.cpu() - twins).abs() > 2e-4 * (1 + twins.abs())).any(-1).any(0)
        assert int(wrong.sum()) <= 2
