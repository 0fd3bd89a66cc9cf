"""What is made of Views once, and forgotten with them."""

import gc
import weakref

from drgs.reconstruct.kept_with_views import kept_with_views
from drgs.scene.views import Views

made: list[int] = []


class Thing:
    """Of Views."""


@kept_with_views
def thing_of(views: Views, number: int) -> Thing:
    """One for each number."""
    made.append(number)
    return Thing()


def empty_views() -> Views:
    return Views((), (), (), None, None, True, "test")


def test_the_same_views_and_numbers_give_the_same_thing_and_others_another() -> None:
    made.clear()
    first, second = empty_views(), empty_views()
    assert thing_of(first, 1) is thing_of(first, 1) is not thing_of(first, 2)
    assert thing_of(second, 1) is not thing_of(first, 1)
    assert made == [1, 2, 1] and thing_of.__doc__ == "One for each number."


def test_what_was_made_goes_with_the_views() -> None:
    views = empty_views()
    thing = weakref.ref(thing_of(views, 1))
    gc.collect()
    assert thing() is not None
    del views
    gc.collect()
    assert thing() is None
