"""What is made of Views again and again while they are fitted, made once.

In: a function of Views and perhaps more. Out: the same function, which remembers what it made for as long as those Views live.
"""

from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

from drgs.scene.views import Views

Made = TypeVar("Made")


def kept_with_views(make: Callable[..., Made]) -> Callable[..., Made]:
    """
    Args:
        make: of Views, its first argument, and others that have hashes. What it returns is nobody's to change.
    """
    kept: WeakKeyDictionary[Views, dict[tuple[Any, ...], Made]] = WeakKeyDictionary()

    @wraps(make)
    def remembered(views: Views, *others: Any) -> Made:
        of_views = kept.setdefault(views, {})
        if others not in of_views:
            of_views[others] = make(views, *others)
        return of_views[others]

    return remembered
