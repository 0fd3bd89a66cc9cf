"""A cost in parts: the sum and the gradient of the whole, the same bits however many threads there are, and threads that mind their own."""

import threading

import pytest
import torch
from torch import Tensor

from drgs import warp_torch
from drgs.reconstruct.fit.cost_in_slices import cost_in_slices
from drgs.warp_torch import in_thread_pool, thread_pool

PLACES = 1001


def squared_rows(first: int, last: int, leaves: tuple[Tensor, ...], generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Rows (place, 3) times a factor, squared; and the rows."""
    rows, factor = leaves
    some = rows[first:last] * factor
    return (some * some).sum(), torch.tensor(float(last - first))


def drawn_rows(first: int, last: int, leaves: tuple[Tensor, ...], generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Random numbers times the rows."""
    numbers = torch.rand(last - first, generator=generator)
    return (leaves[0][first:last, 0] * numbers).sum(), numbers.sum()


def leaves_of(seed: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(PLACES, 3, generator=generator).requires_grad_(), torch.rand(3, generator=generator).requires_grad_()


@pytest.mark.parametrize("slices", [None, 1, 5])
def test_parts_have_the_sum_and_the_gradient_of_the_whole(slices: int | None):
    rows, factor = leaves_of(1)
    value, count = cost_in_slices(PLACES, (rows, factor), squared_rows, torch.Generator().manual_seed(0), slices)
    (3 * value).backward()
    wanted = leaves_of(1)
    whole = ((wanted[0] * wanted[1]) ** 2).sum()
    (3 * whole).backward()
    assert int(count) == PLACES
    torch.testing.assert_close(value, whole)
    for found, expected in zip((rows, factor), wanted, strict=True):
        torch.testing.assert_close(found.grad, expected.grad)


def test_inputs_without_gradient_get_none():
    rows, factor = leaves_of(2)
    fixed = factor.detach()
    value, _ = cost_in_slices(PLACES, (rows, fixed), squared_rows, torch.Generator())
    value.backward()
    assert rows.grad is not None and fixed.grad is None


@pytest.mark.parametrize("cost", [squared_rows, drawn_rows])
def test_sums_have_the_same_bits_with_one_thread_and_with_many(cost, monkeypatch: pytest.MonkeyPatch):
    found = []
    for threads in ("1", "3"):
        monkeypatch.setenv("DRGS_THREADS", threads)
        rows, factor = leaves_of(3)
        value, other = cost_in_slices(PLACES, (rows, factor), cost, torch.Generator().manual_seed(4))
        value.backward()
        found.append((value.detach(), other, rows.grad))
    for one, many in zip(*found, strict=True):
        assert torch.equal(one, many)


def test_what_a_part_does_runs_as_in_the_pool_on_one_thread_too(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("DRGS_THREADS", "1")
    asked = []

    def asks(first: int, last: int, leaves: tuple[Tensor, ...], generator: torch.Generator) -> tuple[Tensor, Tensor]:
        asked.append((in_thread_pool(), warp_torch.gradient_slices()))
        return leaves[0].sum(), torch.zeros(())

    cost_in_slices(PLACES, leaves_of(5), asks, torch.Generator())
    assert set(asked) == {(True, 1)} and not in_thread_pool()


def test_threads_of_the_pool_take_one_core_each_and_leave_the_others_theirs():
    before = torch.get_num_threads()
    assert set(thread_pool().map(lambda _: torch.get_num_threads(), range(8))) == {1}
    started: list[int] = []
    other = threading.Thread(target=lambda: started.append(torch.get_num_threads()))
    other.start()
    other.join()
    assert started == [before] == [torch.get_num_threads()]


def test_a_fault_in_a_part_is_raised():
    def fails(first: int, last: int, leaves: tuple[Tensor, ...], generator: torch.Generator) -> tuple[Tensor, Tensor]:
        raise ZeroDivisionError("of this part")

    with pytest.raises(ZeroDivisionError, match="of this part"):
        cost_in_slices(PLACES, leaves_of(6), fails, torch.Generator())
