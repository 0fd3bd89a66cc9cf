"""Where the sample capture and the environments lie that come with the service.

In a checkout they are below examples/; a wheel holds copies beside this package (pyproject.toml, force-include).
"""

from pathlib import Path
from typing import Literal

from drgs.installation import checkout


def bundled_folder(name: Literal["sample_capture", "environments"]) -> Path:
    """The folder with what comes along under this name."""
    root = checkout()
    return Path(__file__).resolve().parents[1] / "bundled" / name if root is None else root / "examples" / name
