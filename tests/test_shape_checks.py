"""The checks that the whole suite runs with do check, and leave alone what they must."""

import random

import numpy as np
import pytest
import torch
from jaxtyping import Float, Int, Shaped, TypeCheckError
from jaxtyping._storage import get_shape_memo, pop_shape_memo, push_shape_memo

from drgs.deform.displace.maps import evaluate_map
from drgs.reconstruct.fit.densify import ScreenGradientStats
from drgs.reconstruct.fit.losses import mask_loss
from drgs.reconstruct.geometry.bind_gaussians import query_closest_faces
from drgs.scene.edits import TwistMap
from tests.shape_checks import CALLS_A_CHECK, FIRST_CALLS, count_calls_anew, is_array_of, is_array_of_jaxtyping


def test_arguments_of_other_shapes_are_refused():
    mask_loss(torch.full((4, 5), 0.5), torch.ones(4, 5))
    with pytest.raises(TypeCheckError, match="mask_loss"):
        mask_loss(torch.full((4, 5), 0.5), torch.ones(5, 4))


def test_of_many_calls_the_first_and_then_one_of_sixteen_are_checked():
    refused = []
    for call in range(1, FIRST_CALLS + 10 * CALLS_A_CHECK + 1):
        try:
            ScreenGradientStats(torch.zeros(3), torch.zeros(4))
        except TypeCheckError:
            refused.append(call)
    assert refused[:FIRST_CALLS] == list(range(1, FIRST_CALLS + 1)) and len(refused) == FIRST_CALLS + 10
    count_calls_anew()
    with pytest.raises(TypeCheckError, match="ScreenGradientStats"):
        ScreenGradientStats(torch.zeros(3), torch.zeros(4))


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


AXES = ("", "n", "n 3", "n n", "3", "n m", "*batch", "*batch 3", "2 *batch n", "...", "... n", "_ n", "#n 2", "n+1", "{size} n", "k=2 n")


def test_arrays_are_taken_as_jaxtyping_takes_them_and_letters_stand_for_the_same():
    chosen, taken = random.Random(0), [0, 0]
    hints = [kind[array, axes] for kind in (Float, Int, Shaped) for array in (torch.Tensor, np.ndarray) for axes in AXES]
    for _ in range(3000):
        asked = [chosen.choice(hints) for _ in range(3)]
        things = [_thing(chosen) for _ in range(3)]
        found = []
        for answers in (is_array_of, is_array_of_jaxtyping):
            push_shape_memo({"size": 2})
            try:
                found.append([_said(answers, hint, thing) for hint, thing in zip(asked, things, strict=True)])
                found[-1] += [{letter: value for letter, value in letters.items()} for letters in get_shape_memo()[:2]]
            finally:
                pop_shape_memo()
        assert found[0] == found[1], (asked, things)
        for answer in found[0][:3]:
            taken[answer is True] += 1
    assert min(taken) > 500


def _thing(chosen: random.Random) -> object:
    shape = [chosen.choice((1, 2, 3)) for _ in range(chosen.randrange(4))]
    dtype = chosen.choice(("float32", "float64", "int64", "bool"))
    made: list[object] = [
        torch.zeros(shape, dtype=getattr(torch, dtype)),
        np.zeros(shape, dtype),
        torch.nn.Parameter(torch.zeros(shape)),
        1.0,
    ]
    return chosen.choices(made, (6, 6, 2, 1))[0]


def _said(answers, hint: type, thing: object) -> object:
    try:
        return answers(hint, thing)
    except Exception as error:  # letters that stand for nothing yet
        return type(error)
