"""Puts an up-to-date viewer into wheels: called by hatchling (pyproject.toml). An editable install gets its viewer from `./run`."""

import subprocess
import sys
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class BuildViewer(BuildHookInterface):
    """Final."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Build the viewer where its sources have changed since it was last built.

        Raises:
            RuntimeError: it cannot be built; what is wrong has been printed.
        """
        if version == "editable":
            return
        if subprocess.run([sys.executable, str(Path(self.root) / "web" / "build.py")], check=False).returncode != 0:
            raise RuntimeError(
                "the wheel needs the viewer, which could not be built; the reason is above. `./run wheel` brings what that needs."
            )
