"""An environment from a file of another program."""

from pathlib import Path

import torch

from drgs.exchange.exr import decode_environment
from drgs.scene.environment import Environment

MAX_BYTES = 2 << 30


def load_environment(path: Path | str) -> Environment:
    """Lat-long light of an OpenEXR or Radiance HDR file; negative values become 0 with a warning.

    Raises:
        ValueError: one sentence: missing, damaged, not 2:1, or not finite.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path}: does not exist; expected an .exr or .hdr environment")
    if path.stat().st_size > MAX_BYTES:
        raise ValueError(f"{path}: has {path.stat().st_size} bytes; the limit is {MAX_BYTES}")
    return Environment(torch.from_numpy(decode_environment(path.read_bytes(), str(path))))
