"""The run-time checks of annotations that the suite runs with: shapes by jaxtyping, everything else by beartype.

An int passes for a float. Three things are left to others: words (Literal), which mypy checks and doors refuse by a sentence that tests want to
see; Warp's structs, which are no types at run time; and Warp's kernels, whose source it reads, which a wrapper would hide.

jaxtyping's own decorator makes both checks of a function when it is defined, those within functions at every call of these, and looks at what a
function is given before it and behind it: a fifth of a build's time. Here checks are made at the first call, once for all functions of one
source, and whatever comes and goes is looked at once. Arrays of the right type and shape, which nearly all are, are known for that by a shorter
way than jaxtyping's, which takes ten times as long; whatever else comes is left to jaxtyping's.

Of a function that one test calls often, in the steps of a fit, the first calls are checked and then every sixteenth (FIRST_CALLS, CALLS_A_CHECK).
"""

import ast
import dataclasses
import functools
import inspect
from collections.abc import Callable
from typing import Any

from beartype import BeartypeConf, beartype
from jaxtyping import TypeCheckError, _array_types, _import_hook, install_import_hook
from jaxtyping._decorator import _destring_annotation, _make_fn_with_signature
from jaxtyping._storage import _shape_storage, pop_shape_memo, push_shape_memo

FIRST_CALLS = 48
"""Of each function in each test, all checked."""
CALLS_A_CHECK = 16
"""Of the calls behind those, one of so many is checked: a step of a fit is as the one before it, and checks took a twelfth of the time of such tests."""

_refuse_wrong_types = beartype(conf=BeartypeConf(is_pep484_tower=True, violation_type=TypeCheckError))


@dataclasses.dataclass(frozen=True)
class Checks:
    """What a call goes through, in one memory of what each letter of a shape stands for."""

    arguments: Callable[..., None]
    """Is called as the function is."""
    result: Callable[[Any], None] | None
    """Is given what the function returned; None where that is not annotated."""
    signature: inspect.Signature | None
    """Where shapes name arguments ("{count} 3"), whose values are needed then."""


@dataclasses.dataclass
class _Counting:
    """Of calls, anew in each test."""

    test: int = 0


_counting = _Counting()


def count_calls_anew() -> None:
    """For a test that begins: what the ones before it called does not count."""
    _counting.test += 1


_checks: dict[tuple, Checks] = {}
"""By source and annotations: a function that is defined within another one is a new one each time."""


def checked(thing: Any) -> Any:
    """The function with every call checked against its annotations; of a record, the making of one. Decorates what the import hook finds."""
    if isinstance(thing, type):
        if dataclasses.is_dataclass(thing) and not hasattr(thing.__init__, "is_checked"):
            thing.__init__ = checked(thing.__init__)  # type: ignore[misc]
        return thing
    if isinstance(thing, staticmethod | classmethod):
        return type(thing)(checked(thing.__func__))
    if isinstance(thing, property):
        return property(*(accessor and checked(accessor) for accessor in (thing.fget, thing.fset, thing.fdel)))
    return _checked_function(thing)


def _checked_function(function: Callable) -> Callable:
    checks: Checks | None = None
    calls = counted_test = 0

    @functools.wraps(function)
    def checking(*arguments: Any, **named: Any) -> Any:
        __tracebackhide__ = True
        nonlocal checks, calls, counted_test
        if counted_test != _counting.test:
            calls, counted_test = 0, _counting.test
        calls += 1
        if calls > FIRST_CALLS and calls % CALLS_A_CHECK:
            return function(*arguments, **named)
        if checks is None:
            checks = _checks_of(function)
        push_shape_memo(_bound(checks.signature, arguments, named) if checks.signature else {})
        try:
            checks.arguments(*arguments, **named)
            result = function(*arguments, **named)
            if checks.result is not None:
                checks.result(result)
            return result
        finally:
            pop_shape_memo()

    checking.is_checked = True  # type: ignore[attr-defined]
    return checking


def _bound(signature: inspect.Signature, arguments: tuple, named: dict[str, Any]) -> dict[str, Any]:
    bound = signature.bind(*arguments, **named)
    bound.apply_defaults()
    return bound.arguments


def _checks_of(function: Callable) -> Checks:
    key = (function.__code__, function.__module__, function.__qualname__, *function.__annotations__.items())
    if key not in _checks:
        _checks[key] = _make_checks(function)
    return _checks[key]


def _make_checks(function: Callable) -> Checks:
    signature = inspect.signature(function)
    hints = {name: _checked_hint(parameter.annotation, function) for name, parameter in signature.parameters.items()}
    returned = _checked_hint(signature.return_annotation, function)
    taken = signature.replace(
        parameters=[parameter.replace(annotation=hints[name]) for name, parameter in signature.parameters.items()], return_annotation=Any
    )
    given = inspect.Signature(
        [inspect.Parameter("returned", inspect.Parameter.POSITIONAL_ONLY, annotation=returned)], return_annotation=Any
    )
    return Checks(
        _refused_as(function, taken),
        None if signature.return_annotation is inspect.Signature.empty else _refused_as(function, given),
        taken if any("{" in repr(hint) for hint in (*hints.values(), returned)) else None,
    )


def _refused_as(function: Callable, signature: inspect.Signature) -> Callable[..., None]:
    """A function that does nothing but refuse what is not as the signature says, under the other one's name."""
    name = function.__name__ if function.__name__.isidentifier() else "function"
    return _refuse_wrong_types(_make_fn_with_signature(name, function.__qualname__, function.__module__, signature, output=False))


def _checked_hint(hint: Any, function: Callable) -> Any:
    if hint is inspect.Signature.empty or "Literal[" in repr(hint) or type(hint).__module__.startswith("warp."):
        return Any
    return _destring_annotation(hint, function.__globals__)


is_array_of_jaxtyping = _array_types._MetaAbstractArray.__instancecheck__
"""Whether something is the array that an annotation says, given what its letters stand for."""

Axes = tuple[int | str | None, ...]
"""Sizes, or letters that stand for them; None is any size."""


class KnownArrays:
    """Of one annotation, what is needed to see that an array is right."""

    def __init__(self, hint: Any) -> None:
        self.kinds: set[tuple[type, Any]] = set()
        """Pairs of type and dtype that jaxtyping took."""
        self.leading: Axes | None = None
        """Axes before those that are any number. None where an axis is neither a size nor a letter, which is left to jaxtyping."""
        self.trailing: Axes = ()
        self.rest: str | None = None
        """Letter of those that are any number; "" where they may be anything, None where there are none."""
        axes = [_plain_axis(axis) for axis in hint.dims]
        if hint._skip_instancecheck or any(axis is NotImplemented for axis in axes):
            return
        if hint.index_variadic is None:
            self.leading = tuple(axes)
        else:
            self.leading, self.trailing = tuple(axes[: hint.index_variadic]), tuple(axes[hint.index_variadic + 1 :])
            self.rest = axes[hint.index_variadic] or ""

    def are_fitted_by(self, shape: tuple[int, ...], sizes: dict[str, int], rests: dict[str, tuple[bool, tuple[int, ...]]]) -> bool:
        """If so, letters that stood for nothing stand for what they are here."""
        assert self.leading is not None
        count, first_trailing = len(self.leading), len(shape) - len(self.trailing)
        if count != first_trailing and (self.rest is None or count > first_trailing):
            return False
        axes = self.leading + self.trailing if self.trailing else self.leading
        if self.rest:
            if rests.get(self.rest, known := (False, tuple(shape[count:first_trailing]))) != known:
                return False
            shape = shape[:count] + shape[first_trailing:]
        elif self.rest == "":
            shape = shape[:count] + shape[first_trailing:]
        new = []
        for axis, size in zip(axes, shape, strict=True):
            if type(axis) is str:
                if axis not in sizes:
                    sizes[axis] = size
                    new.append(axis)
                    continue
                axis = sizes[axis]
            if axis != size and axis is not None:
                for letter in new:
                    del sizes[letter]
                return False
        if self.rest:
            rests[self.rest] = known
        return True


def _plain_axis(axis: Any) -> int | str | None:
    """NotImplemented where it is not as plain as that."""
    if axis is _array_types._anonymous_dim or axis is _array_types._anonymous_variadic_dim:
        return None
    if axis.broadcastable:
        return NotImplemented
    if type(axis) is _array_types._FixedDim:
        return axis.size
    return NotImplemented if type(axis) is _array_types._SymbolicDim or axis.treepath else axis.name


_known_arrays: dict[Any, KnownArrays] = {}
"""By annotation."""


def is_array_of(hint: Any, thing: Any) -> bool:
    """What jaxtyping says."""
    stack = getattr(_shape_storage, "memo_stack", None)
    if not stack:
        return is_array_of_jaxtyping(hint, thing)
    known = _known_arrays.get(hint)
    if known is None:
        known = _known_arrays[hint] = KnownArrays(hint)
    kind = type(thing), getattr(thing, "dtype", None)
    if kind in known.kinds:
        sizes, rests, *_ = stack[-1]
        if known.are_fitted_by(thing.shape, sizes, rests):
            return True
    found = is_array_of_jaxtyping(hint, thing)
    if found and known.leading is not None:
        known.kinds.add(kind)
    return found


def check_imports_of(modules: list[str]) -> None:
    """Check what functions and records of these modules, and of those below them, are given and return; call it before they are imported."""
    told = _import_hook._is_no_type_check  # jaxtyping asks this of every decorator
    _import_hook._is_no_type_check = lambda decorator: told(decorator) or ast.unparse(decorator).startswith("wp.")
    _import_hook.Typechecker.get_ast = _decorator
    _array_types._MetaAbstractArray.__instancecheck__ = is_array_of
    install_import_hook(modules, "tests.shape_checks.checked")


def _decorator(checker: _import_hook.Typechecker) -> ast.expr:
    """In place of jaxtyping's own decorator."""
    return ast.parse(f"jaxtyping._import_hook.Typechecker.lookup['{checker.get_hash()}']", mode="eval").body
