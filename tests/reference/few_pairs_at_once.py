"""For modules that trace rays by the reference: `from tests.reference.few_pairs_at_once import few_pairs_at_once`, which is used by being there."""

from collections.abc import Generator

import pytest

from drgs.reference import path_integrator


@pytest.fixture(scope="module", autouse=True)
def few_pairs_at_once() -> Generator[None]:
    """The same hits, found in less than half the time: what is held against each other stays in the processor's cache."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(path_integrator, "PAIRS_AT_ONCE", 1 << 15)
        yield
