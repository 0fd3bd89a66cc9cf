"""Checkpoints come back bit for bit, are replaced whole or not at all, and are refused when damaged."""

import json
import os
import struct
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from drgs.reconstruct import checkpoints
from drgs.reconstruct.checkpoints import fit_tensors, read_tensors, restore_fit, write_tensors
from drgs.reconstruct.fit.adam import Adam
from drgs.reconstruct.fit.densify import ScreenGradientStats
from drgs.reconstruct.fit.fit_loop import FitState

CPU = torch.device("cpu")


def small_fit(seed: int, size: int = 7) -> FitState:
    generator = torch.Generator().manual_seed(seed)
    parameters = {name: torch.randn(size, 3, generator=generator).requires_grad_(True) for name in ("centers", "sh")}
    optimizer = Adam([{"params": [value], "lr": 0.1, "name": name} for name, value in parameters.items()])
    gradients = ScreenGradientStats(torch.rand(size, generator=generator), torch.ones(size))
    return FitState(parameters, optimizer, generator, screen_gradients=gradients)


def run(fit: FitState, steps: int) -> None:
    """Steps whose loss draws random numbers, as view order and division do."""
    for _ in range(steps):
        noise = torch.randn(3, generator=fit.generator)
        loss = torch.stack([((value - noise) ** 2).sum() for value in fit.parameters.values()]).sum()
        loss.backward()
        fit.optimizer.step()
        fit.optimizer.zero_grad()
        fit.iteration += 1


def test_tensors_and_facts_come_back_bit_for_bit(tmp_path: Path):
    tensors = {"a": torch.randn(3, 4), "b": torch.tensor(7, dtype=torch.int64), "c": torch.randn(4, 4).T, "none": torch.zeros(0, 3)}
    facts = {"preset": "fast", "iteration": 12, "nested": {"häuser": [1, 2.5, None]}}
    write_tensors(tmp_path / "deep" / "x.safetensors", tensors, facts)
    found, found_facts = read_tensors(tmp_path / "deep" / "x.safetensors", CPU)
    assert found_facts == facts and found.keys() == tensors.keys()
    assert all(torch.equal(found[name], value) and found[name].dtype == value.dtype for name, value in tensors.items())
    assert os.listdir(tmp_path / "deep") == ["x.safetensors"]


def test_a_fit_goes_on_from_its_checkpoint_as_if_it_had_never_stopped(tmp_path: Path):
    whole = small_fit(seed=1)
    run(whole, 9)
    stopped = small_fit(seed=1)
    run(stopped, 4)
    write_tensors(tmp_path / "x", fit_tensors(stopped), {})
    resumed = small_fit(seed=99, size=3)  # another start, with another count
    run(resumed, 2)
    restore_fit(read_tensors(tmp_path / "x", CPU)[0], resumed)
    run(resumed, 5)
    assert all(torch.equal(resumed.parameters[name], value) for name, value in whole.parameters.items())
    assert all(group["params"][0] is resumed.parameters[group["name"]] for group in resumed.optimizer.param_groups)
    assert resumed.iteration == whole.iteration == 9
    assert resumed.screen_gradients is not None and stopped.screen_gradients is not None
    assert torch.equal(resumed.screen_gradients.total, stopped.screen_gradients.total)


def test_a_checkpoint_before_the_first_step_can_be_resumed(tmp_path: Path):
    whole, stopped, resumed = small_fit(seed=1), small_fit(seed=1), small_fit(seed=2)
    run(whole, 3)
    write_tensors(tmp_path / "x", fit_tensors(stopped), {})
    restore_fit(read_tensors(tmp_path / "x", CPU)[0], resumed)
    run(resumed, 3)
    assert all(torch.equal(resumed.parameters[name], value) for name, value in whole.parameters.items())


def test_a_write_that_is_cut_short_leaves_the_old_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = tmp_path / "x.safetensors"
    write_tensors(path, {"a": torch.ones(3)}, {"iteration": 1})

    def killed(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(checkpoints.os, "replace", killed)
    with pytest.raises(KeyboardInterrupt):
        write_tensors(path, {"a": torch.zeros(3)}, {"iteration": 2})
    tensors, facts = read_tensors(path, CPU)
    assert facts == {"iteration": 1} and torch.equal(tensors["a"], torch.ones(3))


def damage(path: Path, how: str) -> None:
    whole = path.read_bytes()
    if how == "empty":
        path.write_bytes(b"")
    elif how == "cut short":
        path.write_bytes(whole[:-5])
    elif how == "not a checkpoint":
        path.write_bytes(b"PNG" * 400)
    elif how == "header of zeros":
        path.write_bytes(struct.pack("<Q", 64) + bytes(64) + whole[72:])
    elif how == "without facts":
        save_file({"a": torch.ones(3)}, path)
    elif how == "facts are not JSON":
        save_file({"a": torch.ones(3)}, path, {"facts": "{iteration"})


@pytest.mark.parametrize("how", ["empty", "cut short", "not a checkpoint", "header of zeros", "without facts", "facts are not JSON"])
def test_a_damaged_checkpoint_is_refused_with_a_sentence(tmp_path: Path, how: str):
    path = tmp_path / "stage1.safetensors"
    write_tensors(path, {"a": torch.randn(100)}, {"iteration": 3})
    damage(path, how)
    with pytest.raises(ValueError, match=r"checkpoint stage1\.safetensors is damaged .* build without --resume"):
        read_tensors(path, CPU)


def test_facts_are_plain_json_in_the_file(tmp_path: Path):
    write_tensors(tmp_path / "x", {"a": torch.ones(1)}, {"seed": 4})
    length = struct.unpack("<Q", (tmp_path / "x").read_bytes()[:8])[0]
    header = json.loads((tmp_path / "x").read_bytes()[8 : 8 + length])
    assert json.loads(header["__metadata__"]["facts"]) == {"seed": 4}


@pytest.mark.parametrize("name", ["parameter.sh", "screen_gradients.seen", "iteration"])
def test_a_checkpoint_that_lacks_something_is_refused_and_leaves_the_fit_as_it_is(name: str):
    tensors, fit = fit_tensors(small_fit(seed=1)), small_fit(seed=2)
    before = {name: value.detach().clone() for name, value in fit.parameters.items()}
    del tensors[name]
    with pytest.raises(ValueError, match=rf"lacks {name}: another version wrote it; build without --resume"):
        restore_fit(tensors, fit)
    assert all(torch.equal(fit.parameters[name], value) for name, value in before.items())


@pytest.mark.parametrize("header", [{}, {"version": "1"}, {"version": "999"}])
def test_a_checkpoint_of_another_version_is_refused_with_a_sentence(tmp_path: Path, header: dict[str, str]):
    path = tmp_path / "stage2.safetensors"
    save_file({"a": torch.ones(3)}, path, {"facts": "{}"} | header)
    with pytest.raises(
        ValueError, match=r"checkpoint stage2\.safetensors was written by another version of drgs .* build without --resume"
    ):
        read_tensors(path, CPU)


def test_what_is_not_learnt_is_not_learnt_after_resuming():
    fit, resumed = small_fit(seed=1), small_fit(seed=2)
    for state in (fit, resumed):
        state.parameters["sh"].requires_grad_(False)
    restore_fit(fit_tensors(fit), resumed)
    assert resumed.parameters["centers"].requires_grad and not resumed.parameters["sh"].requires_grad
