"""For modules whose pictures are small: `from tests.one_torch_thread import one_torch_thread`, which is used by being there."""

from collections.abc import Generator

import pytest
import torch


@pytest.fixture(scope="module", autouse=True)
def one_torch_thread() -> Generator[None]:
    """Two threads are no faster on pictures this small, far slower on a busy machine, and may split torch's own sums."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)
