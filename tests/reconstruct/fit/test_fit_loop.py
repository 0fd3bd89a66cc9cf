"""The loop on a parabola: what it asks of a stage, in which order, and what it tells."""

import math

import pytest
import torch
from torch import Tensor

from drgs.reconstruct.fit.adam import Adam
from drgs.reconstruct.fit.fit_loop import FitLoop, FitReport, FitState, StepLoss, cosine_rates, run_fit
from tests.render.closed_form_scenes import front_camera

CAMERA = front_camera(8)


def parabola_state() -> FitState:
    parameters = {"opacity_logits": torch.tensor([3.0, -2.0], requires_grad=True), "light": torch.tensor([1.0], requires_grad=True)}
    groups = [{"params": [value], "lr": 0.1, "full_rate": 0.1, "name": name} for name, value in parameters.items()]
    return FitState(parameters, Adam(groups), torch.Generator().manual_seed(0))


def terms_of(state: FitState) -> dict[str, Tensor]:
    return {"near": (state.parameters["opacity_logits"] ** 2).sum(), "far": 0.5 * (state.parameters["light"] ** 2).sum()}


def loop(state: FitState, iterations: int, **more) -> FitLoop:
    given = {
        "view_count": 2,
        "step": lambda iteration: StepLoss(terms_of(state), CAMERA, 10.0 ** -(iteration + 1)),
        "rates": lambda iteration: {},
    }
    return FitLoop(state, iterations, **given | more)


def test_the_sum_of_the_terms_falls_and_each_is_reported():
    state, reports = parabola_state(), []
    before = {name: float(term.detach()) for name, term in terms_of(state).items()}
    run_fit(loop(state, 40), reports.append)
    assert [r.iteration for r in reports] == list(range(1, 41)) and {r.iterations for r in reports} == {40}
    assert reports[0].terms == pytest.approx(before) and reports[0].elements == 2
    assert reports[-1].terms["near"] < 0.5 * before["near"] and reports[-1].terms["far"] < 0.5 * before["far"]


def test_the_psnr_is_that_of_the_mean_error_over_the_last_views():
    reports: list[FitReport] = []
    run_fit(loop(parabola_state(), 3), reports.append)
    means = [1e-1, (1e-1 + 1e-2) / 2, (1e-2 + 1e-3) / 2]
    assert [r.psnr for r in reports] == pytest.approx([-10 * math.log10(mean) for mean in means])


def test_a_step_that_compares_nothing_counts_nothing_and_is_told_of_only_after_one_that_did():
    state, reports = parabola_state(), []
    errors = [None, 0.01, None]
    run_fit(loop(state, 3, step=lambda iteration: StepLoss(terms_of(state), CAMERA, errors[iteration])), reports.append)
    assert [(r.iteration, r.psnr) for r in reports] == [(2, pytest.approx(20.0)), (3, pytest.approx(20.0))]


def test_it_stops_when_asked_before_a_step_and_goes_on_from_there():
    whole, parts = parabola_state(), parabola_state()
    run_fit(loop(whole, 7))
    run_fit(loop(parts, 7), should_stop=iter([False, False, False, True]).__next__)
    assert parts.iteration == 3
    run_fit(loop(parts, 7))
    assert parts.iteration == 7 and torch.equal(parts.parameters["opacity_logits"], whole.parameters["opacity_logits"])
    run_fit(loop(parts, 7), should_stop=lambda: pytest.fail("a finished fit asks nobody"))


def test_rates_hold_from_the_step_they_are_given_for_and_others_stay():
    state, seen = parabola_state(), []

    def remember(_done: int) -> None:
        seen.append({group["name"]: group["lr"] for group in state.optimizer.param_groups})

    run_fit(loop(state, 3, rates=lambda iteration: {"light": 0.01 * iteration}, after_step=remember))
    assert [rates["light"] for rates in seen] == [0.0, 0.01, 0.02] and {rates["opacity_logits"] for rates in seen} == {0.1}
    assert float(state.parameters["light"].detach()) != 1.0


def test_gradients_are_shown_before_the_step_and_gone_after_it():
    state, calls = parabola_state(), []
    start = state.parameters["opacity_logits"].detach().clone()

    def after_backward(loss: StepLoss) -> None:
        value = state.parameters["opacity_logits"]
        assert loss.camera is CAMERA and torch.equal(value.detach(), start)
        torch.testing.assert_close(value.grad, 2 * start)
        calls.append("backward")

    def after_step(done: int) -> None:
        value = state.parameters["opacity_logits"]
        assert value.grad is None and not torch.equal(value.detach(), start) and done == state.iteration == 1
        calls.append("step")

    run_fit(loop(state, 1, after_backward=after_backward, after_step=after_step))
    assert calls == ["backward", "step"]


def test_cosine_rates_fall_to_a_tenth():
    state = parabola_state()
    rates = [cosine_rates(state.optimizer, iteration, 10)["light"] for iteration in range(11)]
    assert rates[0] == pytest.approx(0.1) and rates[5] == pytest.approx(0.055) and rates[10] == pytest.approx(0.01)
    assert rates == sorted(rates, reverse=True)


def test_a_fit_without_a_finite_error_ends_in_a_sentence_and_keeps_the_state_of_before():
    state = parabola_state()

    def step(iteration: int) -> StepLoss:
        terms = terms_of(state)
        name = next(iter(terms))
        return StepLoss(terms | ({name: terms[name] * float("nan")} if iteration == 2 else {}), CAMERA, 0.0)

    with pytest.raises(ValueError, match=r"step 3 of 5 of a fit has no finite error \(of \w+\).*another --seed"):
        run_fit(loop(state, 5, step=step))
    assert state.iteration == 2
    assert all(bool(torch.isfinite(value).all()) for value in state.parameters.values())
