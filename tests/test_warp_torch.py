"""Work that is shared out among threads: each part is done once, answers come in order, faults come through."""

import threading

import pytest
import torch
import warp as wp

from drgs import warp_torch
from drgs.warp_torch import (
    in_thread_pool,
    launch,
    launch_adding,
    share_out,
    thread_count,
    use_threads,
    warp_argument,
    warp_array,
    warp_device,
)


@pytest.fixture
def three_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DRGS_THREADS", "3")
    monkeypatch.setattr(warp_torch, "_pool", None)  # the pool is made once, for the threads asked for then


@pytest.mark.usefixtures("three_threads")
def test_parts_are_done_once_by_several_threads_and_answered_in_order() -> None:
    together, threads = threading.Barrier(3), set()

    def work(first: int, last: int) -> tuple[int, int]:
        assert in_thread_pool()
        if first < 3:
            together.wait(60)  # nobody passes before three threads are here
        threads.add(threading.get_ident())
        return first, last

    edges = [0, 1, 2, 3, 7, 20]
    assert share_out(work, edges) == [(0, 1), (1, 2), (2, 3), (3, 7), (7, 20)]
    assert len(threads) == 3 and threading.get_ident() in threads and not in_thread_pool()


@pytest.mark.usefixtures("three_threads")
def test_a_fault_in_any_part_comes_through_and_the_next_work_is_done() -> None:
    def work(first: int, last: int) -> int:
        if first == 5:
            raise ValueError(f"{first} to {last}")
        return first

    with pytest.raises(ValueError, match="5 to 6"):
        share_out(work, list(range(9)))
    assert not in_thread_pool() and share_out(work, [0, 1, 2]) == [0, 1]


@wp.kernel
def count_up(
    first: int,
    step: int,
    # outputs
    values: wp.array[int],
):
    i = first + wp.tid()
    values[i] = values[i] + step * i


@pytest.mark.usefixtures("three_threads")
@pytest.mark.parametrize("count", [1, 2, 1001])
def test_a_launch_over_threads_reaches_each_index_once(count: int) -> None:
    values = torch.zeros(count, dtype=torch.int32)
    launch(count_up, count, [3], [warp_array(values)], "cpu")
    assert torch.equal(values, 3 * torch.arange(count, dtype=torch.int32))


@pytest.mark.usefixtures("three_threads")
def test_a_thread_that_is_told_so_uses_fewer_and_then_all_again_and_others_all() -> None:
    begun, told = torch.get_num_threads(), list[tuple[int, int]]()

    def tell() -> None:
        told.append((thread_count(), torch.get_num_threads()))

    def others() -> None:
        other = threading.Thread(target=lambda: told.append((thread_count(), 0)))
        other.start()
        other.join()

    def work() -> None:
        torch.get_num_threads()
        torch.set_num_threads(3)
        tell()
        use_threads(1)
        threads = set[int]()
        share_out(lambda first, last: threads.add(threading.get_ident()), [0, 1, 2, 3])
        assert threads == {threading.get_ident()}
        tell()
        others()
        use_threads(None)
        tell()

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    torch.set_num_threads(begun)
    assert told == [(3, 3), (1, 1), (3, 0), (3, 3)]


def test_an_argument_that_would_be_a_copy_is_refused():
    """The copy would be gone before the launch, and the kernel would read what lies there then."""
    with pytest.raises(ValueError, match="gone before the launch"):
        warp_argument(torch.rand(4, 3).T)


@wp.kernel
def scattered(first: int, place: wp.array[int], doubled: wp.array[float], total: wp.array[float]):
    i = first + wp.tid()
    doubled[i] = 2.0 * float(i)
    wp.atomic_add(total, place[i], float(i))


@pytest.mark.parametrize("count", [0, 10, 5000])
def test_what_many_indices_add_to_is_the_same_whoever_adds(device: str, count: int):
    place = (torch.arange(count, dtype=torch.int32) % 7).to(device)
    doubled = torch.zeros(count, device=device)
    (total,) = launch_adding(
        scattered, count, [warp_argument(place)], [warp_argument(doubled)], [(torch.empty(7, device=device), None)], warp_device(place)
    )
    wanted = torch.zeros(7).index_add(0, place.cpu().long(), torch.arange(count).float())
    assert torch.equal(total.cpu(), wanted) and torch.equal(doubled.cpu(), 2 * torch.arange(count).float())
