"""Fits' Adam takes torch's own steps, bit for bit, and does not load torch's compiler."""

import subprocess
import sys

import torch

from drgs.reconstruct.fit.adam import Adam


def values() -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    return {
        name: torch.randn(shape, generator=generator).requires_grad_() for name, shape in (("a", (40, 3)), ("b", (7,)), ("still", (5,)))
    }


def groups(parameters: dict[str, torch.Tensor]) -> list[dict]:
    return [{"params": [value], "lr": 0.01 * (1 + number), "name": name} for number, (name, value) in enumerate(parameters.items())]


def test_steps_are_those_of_torch_to_the_last_bit() -> None:
    ours, theirs = values(), values()
    adam, torchs = Adam(groups(ours), (0.9, 0.99), 1e-15), torch.optim.Adam(groups(theirs), betas=(0.9, 0.99), eps=1e-15, fused=True)
    for number in range(20):
        for optimizer, parameters in ((adam, ours), (torchs, theirs)):
            optimizer.param_groups[0]["lr"] = 0.02 / (1 + number)
            (parameters["a"].sin().sum() + (parameters["b"] ** 2).sum() * number).backward()
            optimizer.step()
            optimizer.zero_grad()
    assert all(ours[name].equal(theirs[name]) for name in ours)
    for name in ("a", "b"):
        mine, its = adam.state[ours[name]], torchs.state[theirs[name]]
        assert mine.keys() == its.keys() and all(mine[key].equal(its[key]) for key in mine)
    assert ours["still"] not in adam.state and ours["a"].grad is None


def test_a_group_may_have_its_own_running_means_and_floor() -> None:
    ours, theirs = values(), values()
    own = {"betas": (0.8, 0.95), "eps": 0.1}
    ours_groups, theirs_groups = groups(ours), groups(theirs)
    ours_groups[1] |= own
    theirs_groups[1] |= own
    adam, torchs = Adam(ours_groups, eps=1e-15), torch.optim.Adam(theirs_groups, eps=1e-15, fused=True)
    for number in range(5):
        for optimizer, parameters in ((adam, ours), (torchs, theirs)):
            (parameters["a"].sin().sum() + (parameters["b"] ** 2).sum() * number).backward()
            optimizer.step()
            optimizer.zero_grad()
    assert all(ours[name].equal(theirs[name]) for name in ours)


def test_a_step_does_not_load_torch_s_compiler() -> None:
    code = (
        "import sys, torch; from drgs.reconstruct.fit.adam import Adam; value = torch.ones(3, requires_grad=True); "
        "adam = Adam([{'params': [value], 'lr': 0.1}]); value.sum().backward(); adam.step(); adam.zero_grad(); "
        "sys.exit('torch._dynamo' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
