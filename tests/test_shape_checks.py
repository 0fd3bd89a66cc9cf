"""The checks that the whole suite runs with do check, and leave alone what they must."""

import pytest
import torch
from jaxtyping import TypeCheckError

from drgs.deform.maps import evaluate_map
from drgs.reconstruct.fit.densify import ScreenGradientStats
from drgs.reconstruct.fit.losses import mask_loss
from drgs.reconstruct.geometry.bind_gaussians import query_closest_faces
from drgs.scene.edits import TwistMap


def test_arguments_of_other_shapes_are_refused():
    mask_loss(torch.full((4, 5), 0.5), torch.ones(4, 5))
    with pytest.raises(TypeCheckError, match="mask_loss"):
        mask_loss(torch.full((4, 5), 0.5), torch.ones(5, 4))


def test_records_whose_fields_disagree_are_refused():
    with pytest.raises(TypeCheckError, match="ScreenGradientStats"):
        ScreenGradientStats(torch.zeros(3), torch.zeros(4))


def test_other_types_are_refused():
    twist = TwistMap(type="twist", rate=1)
    evaluate_map(twist, torch.zeros(2, 3))
    with pytest.raises(TypeCheckError, match="points_world"):
        evaluate_map(twist, torch.zeros(2, 3, dtype=torch.int32))
    ScreenGradientStats.zeros(3, torch.device("cpu"))
    with pytest.raises(TypeCheckError, match="count"):
        ScreenGradientStats.zeros("3", torch.device("cpu"))


def test_kernels_are_left_to_warp():
    assert not hasattr(query_closest_faces.func, "__wrapped__")
