"""The one bridge between torch and Warp: arrays that share memory, and launches that use every CPU thread.

`wp.launch` runs a CPU kernel on one thread and releases the GIL; `launch` cuts the index range into slices and gives
them to a thread pool. Kernels launched this way take `first: int` as their first argument and start with
`i = first + wp.tid()`. Warp's atomics on the CPU are plain adds, so two slices must never add to one address.
"""

import copy
import os
import tempfile
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from itertools import pairwise
from typing import Any

import torch
import warp as wp
from torch import Tensor


def _init_warp() -> None:
    """wp.init without its banner (stdout belongs to --json) and without one line: that there is no NVIDIA driver is no news here.

    Warp's native part writes that line straight to file descriptor 2, whatever the log level; anything else passes.
    """
    wp.config.log_level = wp.LOG_ERROR
    # Products and sums in one instruction, as on CUDA: Warp's code puts them in statements of their own, which no compiler joins unasked.
    wp.config.cpu_compiler_flags = f"{getattr(wp.config, 'cpu_compiler_flags', None) or '-march=native'} -ffp-contract=fast"
    with tempfile.TemporaryFile() as written:
        stderr = os.dup(2)
        os.dup2(written.fileno(), 2)
        try:
            wp.init()
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
            written.seek(0)
            for line in written:
                if b"Could not find or load the NVIDIA CUDA driver" not in line:
                    os.write(2, line)


GRADIENT_SLICES = 4
"""Parts of a launch that add into a copy each of what many threads add to: fixed, so that sums do not depend on how many cores there are. In the
pool's own threads a launch is one part."""
FEWEST_FOR_THREADS = 1024
"""Indices of a launch; with fewer it takes longer to wake threads than to be done."""

_init_warp()

_pool: ThreadPoolExecutor | None = None
_here = threading.local()
_loading = threading.Lock()
"""One thread at a time compiles or loads modules."""


def in_thread_pool() -> bool:
    """Whether the caller is one of the pool's threads: then its launches run where it is, since waiting for the pool could last for ever."""
    return getattr(_here, "pooled", False)


@contextmanager
def as_in_thread_pool() -> Iterator[None]:
    """For work of the caller's that is the pool's: launches inside run where they are, with the pool's sums."""
    pooled, _here.pooled = in_thread_pool(), True
    try:
        yield
    finally:
        _here.pooled = pooled


def gradient_slices() -> int:
    """Parts that launch_adding cuts a launch of the caller's into."""
    return 1 if in_thread_pool() else GRADIENT_SLICES


def _begin_thread(threads: int) -> None:
    """Of the pool: torch gives what is done here to this thread alone, or each would want all cores for itself.

    Args:
        threads: torch's for all others.
    """
    _here.pooled = True
    _use_torch_threads(1, threads)


def _use_torch_threads(count: int, others: int) -> None:
    """Of the calling thread; the others keep theirs."""
    torch.get_num_threads()  # the first question takes over what is set for all, and would undo the next line later
    torch.set_num_threads(count)
    # That number is also what threads begin with that are started from now on; so it is set again, by one that ends.
    restoring = threading.Thread(target=torch.set_num_threads, args=(others,))
    restoring.start()
    restoring.join()


def use_threads(most: int | None) -> None:
    """What the calling thread launches, and torch's operations there, take at most so many threads from now on; None: all that there are."""
    if not hasattr(_here, "torch_threads"):
        _here.torch_threads = torch.get_num_threads()
    _here.most = most
    _use_torch_threads(_here.torch_threads if most is None else min(most, _here.torch_threads), _here.torch_threads)


def thread_count() -> int:
    """Threads that the caller's CPU launches are spread over: DRGS_THREADS, else the cores this process may use; fewer where use_threads says so."""
    threads, most = _all_threads(), getattr(_here, "most", None)
    return threads if most is None else min(most, threads)


def _all_threads() -> int:
    asked = os.environ.get("DRGS_THREADS")
    return max(1, int(asked)) if asked else len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def thread_pool() -> ThreadPoolExecutor:
    """The pool shared by all CPU launches (and by other callers of code that releases the GIL)."""
    global _pool
    if _pool is None:
        threads = (torch.get_num_threads(),)
        _pool = ThreadPoolExecutor(_all_threads(), thread_name_prefix="drgs", initializer=_begin_thread, initargs=threads)
    return _pool


def warp_array(tensor: Tensor, dtype: Any = None) -> wp.array:
    """A Warp array on a tensor's memory; `dtype` (wp.vec3, ...) consumes trailing dimensions. No gradient is tracked."""
    return wp.from_torch(_own_memory(tensor.detach().contiguous()), dtype=dtype, requires_grad=False)


def warp_argument(tensor: Tensor, dtype: Any = None) -> Any:
    """What warp_array gives, for arguments of kernels alone, where launches are many and short: a third of the price, and no check by Warp.

    It does not keep the tensor: the caller must, until the launch is over.

    Raises:
        ValueError: the tensor is not contiguous, so that the kernel would read what lies where a copy was.
    """
    if not tensor.is_contiguous():
        raise ValueError(
            f"an argument of strides {tensor.stride()} would be copied, and the copy gone before the launch; make it contiguous and keep it"
        )
    return wp.from_torch(_own_memory(tensor.detach()), dtype=dtype, requires_grad=False, return_ctype=True)


def _own_memory(tensor: Tensor) -> Tensor:
    """What is expanded and empty counts as contiguous, but not for Warp."""
    return tensor if tensor.numel() else tensor.new_empty(tensor.shape)


def warp_view(tensor: Tensor, dtype: Any = None) -> wp.array:
    """A Warp array on a tensor's memory as it lies there, part of a larger one or not; trailing dimensions as in warp_array must be whole."""
    return wp.from_torch(tensor.detach(), dtype=dtype, requires_grad=False)


def warp_device(tensor: Tensor) -> Any:
    """Warp's device of a tensor."""
    return wp.device_from_torch(tensor.device)


def load_kernel(kernel: Any, device: Any) -> None:
    """Compile a kernel's module before threads race for it; the CPU's launches have blocks of 1, and Warp compiles for a block size."""
    device = wp.get_device(device)
    with _loading:
        kernel.module.load(device, None if device.is_cuda else 1)


def launch(kernel: Any, count: int, inputs: list, outputs: list, device: Any, slices_per_thread: int = 4) -> None:
    """Run `kernel` for `count` indices, on CUDA at once, on the CPU in slices over the thread pool.

    The kernel's first argument must be `first: int` (see module docstring); it is added here.
    """
    if count == 0:
        return
    device = wp.get_device(device)
    if device.is_cuda:
        wp.launch(kernel, dim=count, inputs=[0, *inputs], outputs=outputs, device=device)
        return
    load_kernel(kernel, device)
    threads = thread_count()
    slices = min(count, threads * slices_per_thread) if threads > 1 and not in_thread_pool() else 1
    if slices == 1:
        wp.launch(kernel, dim=count, inputs=[0, *inputs], outputs=outputs, device=device)
        return
    edges = [count * k // slices for k in range(slices + 1)]
    # Python, which one thread runs at a time, puts the arguments together once for all slices.
    whole = wp.launch(kernel, dim=count, inputs=[0, *inputs], outputs=outputs, device=device, record_cmd=True)

    def run(first: int, last: int) -> None:
        part = copy.copy(whole)
        part.params, part.fwd_args = list(whole.params), None
        part.set_dim(last - first)
        part.set_param_at_index(0, first)
        part.launch()

    share_out(run, edges)


def share_out(work: Callable[[int, int], Any], edges: Sequence[int]) -> list:
    """What work(first, last) returns between neighbouring edges, in their order: done by the calling thread and the pool's others.

    Each takes the next part when it is done with one. Inside, launches run where they are.
    """
    left, results = deque(enumerate(pairwise(edges))), [None] * (len(edges) - 1)

    def take() -> None:
        while left:
            try:
                k, (first, last) = left.popleft()
            except IndexError:  # another thread was quicker
                return
            results[k] = work(first, last)

    others = [thread_pool().submit(take) for _ in range(min(thread_count(), len(results)) - 1)]
    try:
        with as_in_thread_pool():
            take()
    finally:
        for other in others:
            if not other.cancel():
                other.result()
    return results


def by_pool(work: Callable[[int, int], Any], edges: Sequence[int], device: torch.device) -> list:
    """What work(first, last) returns between neighbouring edges, in their order, on the CPU each by one thread of the pool.

    For work that is torch's: what it sums in one thread has other bits than in several, and here neither who is free nor how many cores there are
    decides which it is.
    """
    if device.type != "cpu":
        return [work(first, last) for first, last in pairwise(edges)]
    if thread_count() == 1 or in_thread_pool():
        with as_in_thread_pool():
            return [work(first, last) for first, last in pairwise(edges)]
    return [done.result() for done in [thread_pool().submit(work, first, last) for first, last in pairwise(edges)]]


def device_from_name(name: str) -> torch.device:
    """Torch device of auto, cpu or cuda.

    Raises:
        ValueError: cuda was asked for and there is none.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if name == "cuda" and not torch.cuda.is_available():
        raise ValueError("device 'cuda' was asked for, but this machine has no usable NVIDIA GPU; use --device cpu or auto")
    if name not in ("cpu", "cuda"):
        raise ValueError(f"device {name!r} is unknown; expected auto, cpu or cuda")
    return torch.device(name)


def launch_adding(kernel: Any, count: int, inputs: list, outputs: list, added: Sequence[tuple[Tensor, Any]], device: Any) -> list[Tensor]:
    """Run `kernel`, as launch does, for `count` indices that add into the same arrays, its last outputs: what they add, sums that do not depend on
    how many cores there are. Each of gradient_slices() parts of the indices adds into a copy of its own: by the thread pool on the CPU, one after
    another on CUDA and where they are few.

    Args:
        added: for each of those outputs a tensor of its shape, and Warp's type of its entries.
    """
    slices, device = gradient_slices(), wp.get_device(device)
    copies = [torch.zeros(slices, *like.shape, device=like.device) for like, _ in added]

    def run(k: int) -> None:
        first, last = count * k // slices, count * (k + 1) // slices
        own = [warp_argument(copy[k], dtype) for copy, (_, dtype) in zip(copies, added, strict=True)]
        wp.launch(kernel, dim=last - first, inputs=[first, *inputs], outputs=[*outputs, *own], device=device)

    if count:
        load_kernel(kernel, device)
        if device.is_cuda or count < FEWEST_FOR_THREADS or slices == 1:
            for k in range(slices):
                run(k)
        else:
            for done in [thread_pool().submit(run, k) for k in range(slices)]:
                done.result()
    return [copy[0] if slices == 1 else copy.sum(0) for copy in copies]
