"""How far a simulation has come, on disk after every frame: whoever starts it again goes on with the next frame, to the same bits.

frame_00007.safetensors holds what frame 7 shows; state.safetensors the matter behind the newest frame, and is written last, so that a process
that dies in between computes one frame again. The frames with clip.json are a clip that grows: it plays while it is made. A checkpoint that is damaged, or of another asset or scene, is left aside: it would only
have saved time.
"""

import json
import os
from dataclasses import fields, replace
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor

from drgs.deform.clip import ClipFrame, parted_of_arrays, write_manifest
from drgs.deform.matter.mpm import State
from drgs.deform.matter.simulation_progress import SimulationProgress

STATE = "state.safetensors"


def save_progress(folder: Path, progress: SimulationProgress, of: str, fps: float) -> None:
    """Write the newest frame, then the state behind it.

    Args:
        of: what is simulated; only the same goes on from here.
    """
    folder.mkdir(parents=True, exist_ok=True)
    newest = len(progress.frames) - 1
    for index in (0, newest) if newest == 1 else (newest,):  # the first, at rest, was there before any was computed
        _write(folder / _name(index), progress.frames[index].arrays, {})
    tensors = {name: value for name, value in vars(progress.state).items() if isinstance(value, Tensor)}
    # JSON keeps every bit of a float64.
    facts = {"of": of, "frames": newest + 1, "time": progress.state.time, "still": progress.still, "totals": progress.totals}
    _write(folder / STATE, tensors, {"facts": json.dumps(facts)})
    write_manifest(folder, progress.frames[0], newest + 1, fps, {})


def read_progress(folder: Path, start: SimulationProgress, of: str) -> SimulationProgress:
    """What save_progress wrote last, or `start` where there is nothing that can be used.

    Args:
        start: before the first frame was computed; frame 0 is taken from it.
    """
    try:
        with safe_open(folder / STATE, framework="pt", device=str(start.state.positions.device)) as file:
            facts = json.loads(file.metadata()["facts"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        if facts["of"] != of:
            return start
        state = State(**tensors, time=float(facts["time"]))
        for entry in fields(State):
            there, made = getattr(start.state, entry.name), getattr(state, entry.name)
            if isinstance(there, Tensor) and (there.shape != made.shape or there.dtype != made.dtype):
                return start
        frames = [start.frames[0], *(_read_frame(folder / _name(k), start.frames[0]) for k in range(1, facts["frames"]))]
        return SimulationProgress(tuple(frames), state, dict(facts["totals"]), int(facts["still"]))
    except (OSError, SafetensorError, KeyError, TypeError, ValueError):
        return start


def _read_frame(path: Path, like: ClipFrame) -> ClipFrame:
    arrays = load_file(path, device=str(like.vertices.device))
    parted = parted_of_arrays(arrays, len(like.vertices), 0 if like.centers is None else len(like.centers))
    frame = ClipFrame(arrays["vertices"], arrays["normals"], arrays.get("centers"), arrays.get("tangents"), parted)
    own, wanted = (replace(one, parted=None).arrays for one in (frame, like))
    if {name: values.shape for name, values in own.items()} != {name: values.shape for name, values in wanted.items()}:
        raise ValueError(f"{path.name} is of another asset")
    return frame


def _write(path: Path, tensors: dict[str, Tensor], facts: dict[str, str]) -> None:
    draft = path.with_suffix(".part")
    save_file({name: value.detach().cpu().contiguous() for name, value in tensors.items()}, draft, facts)
    os.replace(draft, path)


def _name(index: int) -> str:
    return f"frame_{index:05d}.safetensors"
