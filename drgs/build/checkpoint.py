"""Checkpoints of a running fit, as safetensors beside the asset: parameters, Adam's moments, iteration and random state.

A checkpoint is written whole or not at all; a damaged one is refused with a sentence, never half read.
"""

import json
import os
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor


def write_tensors(path: Path, tensors: dict[str, Tensor], facts: dict) -> None:
    """Write tensors and plain-JSON facts; replaces `path` atomically."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part")
    save_file({name: value.detach().cpu().contiguous() for name, value in tensors.items()}, part, {"facts": json.dumps(facts)})
    os.replace(part, path)


def read_tensors(path: Path, device: torch.device) -> tuple[dict[str, Tensor], dict]:
    """What write_tensors wrote.

    Raises:
        ValueError: the file is damaged.
    """
    try:
        with safe_open(path, framework="pt", device=str(device)) as file:
            facts = json.loads(file.metadata()["facts"])
            return {name: file.get_tensor(name) for name in file.keys()}, facts  # noqa: SIM118
    except (SafetensorError, KeyError, TypeError, json.JSONDecodeError) as error:
        raise ValueError(f"the checkpoint {path.name} is damaged ({error}); delete its folder or build without --resume") from error


def fit_tensors(parameters: dict[str, Tensor], optimizer: torch.optim.Adam, generator: torch.Generator) -> dict[str, Tensor]:
    """Everything of a fit that is a tensor, by name."""
    tensors = {f"parameter.{name}": value for name, value in parameters.items()} | {"generator": generator.get_state()}
    for group in optimizer.param_groups:
        state = optimizer.state.get(group["params"][0])
        if state:
            tensors |= {f"adam.{group['name']}.{key}": torch.as_tensor(value) for key, value in state.items()}
    return tensors


def restore_fit(tensors: dict[str, Tensor], parameters: dict[str, Tensor], optimizer: torch.optim.Adam, generator: torch.Generator) -> None:
    """Put fit_tensors back, in place of what a fresh start made (surfel counts may differ).

    Raises:
        ValueError: the checkpoint lacks what this version of the program fits.
    """
    missing = {"generator", *(f"parameter.{group['name']}" for group in optimizer.param_groups)} - tensors.keys()
    if missing:
        raise ValueError(f"the checkpoint lacks {', '.join(sorted(missing))}: another version wrote it; build without --resume")
    for group in optimizer.param_groups:
        name = group["name"]
        optimizer.state.pop(group["params"][0], None)
        value = tensors[f"parameter.{name}"].clone().requires_grad_(True)
        parameters[name] = value
        group["params"][0] = value
        prefix = f"adam.{name}."
        state = {key[len(prefix) :]: tensor.clone() for key, tensor in tensors.items() if key.startswith(prefix)}
        if state:
            optimizer.state[value] = state
    generator.set_state(tensors["generator"].cpu())
