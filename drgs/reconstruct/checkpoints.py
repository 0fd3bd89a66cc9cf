"""What a build leaves to go on from, as safetensors beside the asset; of a fit: parameters, Adam's moments, iteration and random state.

A checkpoint is written whole or not at all; a damaged one, and one of another version, is refused with a sentence, never half read.
"""

import json
import os
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from drgs.reconstruct.fit.densify import ScreenGradientStats
from drgs.reconstruct.fit.fit_loop import FitState
from drgs.reconstruct.fit.surfels.surfel_shadows import SurfelShadows

CHECKPOINT_VERSION = "39"
"""Of names and meaning of what is kept: raise it with every change after which older checkpoints would go on otherwise than they began."""


def write_tensors(path: Path, tensors: dict[str, Tensor], facts: dict) -> None:
    """Write tensors and plain-JSON facts; replaces `path` atomically."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part")
    header = {"facts": json.dumps(facts), "version": CHECKPOINT_VERSION}
    save_file({name: value.detach().cpu().contiguous() for name, value in tensors.items()}, part, header)
    os.replace(part, path)


def read_tensors(path: Path, device: torch.device) -> tuple[dict[str, Tensor], dict]:
    """What write_tensors wrote.

    Raises:
        ValueError: the file is damaged, or of another version.
    """
    try:
        with safe_open(path, framework="pt", device=str(device)) as file:
            header = file.metadata()
            facts = json.loads(header["facts"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, KeyError, TypeError, json.JSONDecodeError) as error:
        raise ValueError(f"the checkpoint {path.name} is damaged ({error}); delete its folder or build without --resume") from error
    if header.get("version") != CHECKPOINT_VERSION:
        raise ValueError(
            f"the checkpoint {path.name} was written by another version of drgs (its format is {header.get('version', '1')}, "
            f"expected {CHECKPOINT_VERSION}); delete its folder or build without --resume"
        )
    return tensors, facts


def fit_tensors(state: FitState) -> dict[str, Tensor]:
    """A fit as tensors by name."""
    tensors = {f"parameter.{name}": value for name, value in state.parameters.items()}
    tensors |= {"generator": state.generator.get_state(), "iteration": torch.tensor(state.iteration)}
    if state.screen_gradients is not None:
        tensors |= {"screen_gradients.total": state.screen_gradients.total, "screen_gradients.seen": state.screen_gradients.seen}
    if state.exposures is not None:
        tensors["exposures"] = state.exposures
    if state.shadows is not None:
        tensors |= {f"shadows.{name}": value for name, value in state.shadows.columns.items()}
    for group in state.optimizer.param_groups:
        moments = state.optimizer.state.get(group["params"][0])
        if moments:
            tensors |= {f"adam.{group['name']}.{key}": torch.as_tensor(value) for key, value in moments.items()}
    return tensors


def restore_fit(tensors: dict[str, Tensor], state: FitState) -> None:
    """Put fit_tensors back, in place of what a fresh start made (surfel counts may differ).

    Raises:
        ValueError: the checkpoint lacks what this fit consists of.
    """
    missing = {name for name in fit_tensors(state) if not name.startswith("adam.")} - tensors.keys()
    if missing:
        raise ValueError(f"the checkpoint lacks {', '.join(sorted(missing))}: another version wrote it; build without --resume")
    for group in state.optimizer.param_groups:
        name = group["name"]
        fresh = group["params"][0]
        state.optimizer.state.pop(fresh, None)
        value = tensors[f"parameter.{name}"].clone().requires_grad_(fresh.requires_grad)
        state.parameters[name] = value
        group["params"][0] = value
        prefix = f"adam.{name}."
        moments = {key[len(prefix) :]: tensor.clone() for key, tensor in tensors.items() if key.startswith(prefix)}
        if moments:
            state.optimizer.state[value] = moments
    state.generator.set_state(tensors["generator"].cpu())
    state.iteration = int(tensors["iteration"])
    state.exposures = tensors["exposures"].cpu() if "exposures" in tensors else None
    shadows = {name.removeprefix("shadows."): value for name, value in tensors.items() if name.startswith("shadows.")}
    state.shadows = SurfelShadows(**shadows) if shadows else None
    if state.screen_gradients is not None:
        state.screen_gradients = ScreenGradientStats(tensors["screen_gradients.total"].clone(), tensors["screen_gradients.seen"].clone())
