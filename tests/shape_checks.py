"""The run-time checks of annotations that the suite runs with: shapes by jaxtyping, everything else by beartype.

An int passes for a float. Three things are left to others: words (Literal), which mypy checks and doors refuse by a sentence that tests want to
see; Warp's structs, which are no types at run time; and Warp's kernels, whose source it reads, which a wrapper would hide.
"""

import ast
from collections.abc import Callable
from typing import Any

from beartype import BeartypeConf, beartype
from jaxtyping import _import_hook, install_import_hook

_checked = beartype(conf=BeartypeConf(is_pep484_tower=True))


def check(function: Callable) -> Callable:
    """The function with every call checked against its annotations."""
    hints = getattr(function, "__annotations__", {})
    if any(map(_is_left_out, hints.values())):
        function.__annotations__ = {name: Any if _is_left_out(hint) else hint for name, hint in hints.items()}
    return _checked(function)


def _is_left_out(hint: object) -> bool:
    return "Literal[" in repr(hint) or type(hint).__module__.startswith("warp.")


def check_imports_of(modules: list[str]) -> None:
    """Check what functions and records of these modules, and of those below them, are given and return; call it before they are imported."""
    told = _import_hook._is_no_type_check  # jaxtyping asks this of every decorator
    _import_hook._is_no_type_check = lambda decorator: told(decorator) or ast.unparse(decorator).startswith("wp.")
    install_import_hook(modules, "tests.shape_checks.check")
