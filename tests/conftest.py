"""What all tests share: the device, fixed seeds, and shape checks (tests/shape_checks.py).

`device` is the CPU, and CUDA too where there is one; `--device cpu` or `--device cuda` asks for one of them, and cuda fails where
there is none instead of passing by doing nothing.
"""

import gc
import os
import sys
from collections.abc import Generator
from typing import Any

import pytest


def load_blas_of_one_thread() -> None:
    """NumPy's and SciPy's, which ask for their threads' number when they are loaded; what tests start is not told."""
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    import numpy.linalg
    import scipy.linalg

    assert numpy.linalg and scipy.linalg
    del os.environ["OPENBLAS_NUM_THREADS"]


# For each of the processes that share the tests, of which there are more than cores: after each product of matrices the others of its threads would look
# for more on another core for 20 milliseconds.
if "PYTEST_XDIST_WORKER" in os.environ and "OPENBLAS_NUM_THREADS" not in os.environ:
    load_blas_of_one_thread()

HANDS_OUT = "PYTEST_XDIST_WORKER" not in os.environ and any(word.startswith("--numprocesses") for word in sys.argv)
"""This process runs no test: it hands them out to others, which begin when it has loaded what it needs."""

# Until all is imported and collected: what comes then stays, and looking through it for garbage takes a quarter of the time that it takes.
gc.disable()

if not HANDS_OUT:
    from tests.shape_checks import check_imports_of, count_calls_anew

    # Before anything imports them: what enters and leaves functions and records must be of the shape that the annotation says.
    check_imports_of(["drgs.scene", "drgs.deform", "drgs.render.records", "drgs.reconstruct", "drgs.convert", "drgs.evaluate"])

    import torch


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--device", choices=["cpu", "cuda"], default=None, help="run tests that take a device on this one only")


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "device" not in metafunc.fixturenames:
        return
    asked = metafunc.config.getoption("--device")
    if asked == "cuda" and not torch.cuda.is_available():
        raise pytest.UsageError("--device cuda was asked for, but torch finds no usable GPU")
    metafunc.parametrize("device", [asked] if asked else ["cpu", *(["cuda"] if torch.cuda.is_available() else [])])


LONGEST_IN_BROWSER = "tests/web/test_whole_path"
"""The file of that name waits for builds of a worker, which gives way to everything else on the machine: it begins first, and has a process for itself
and for the one behind it, which takes files of what was built."""


HALF_WAY = "tests/web/test_g"
"""The other files of the browser before and behind this name take about equally long."""


WAITING = ("tests/benchmarks/", "tests/worker/", "tests/server/", "tests/test_wheel.py", "tests/test_cli.py", "tests/test_site.py")
"""Tests that wait for processes that they start about as long as they compute."""


LONG = ("tests/reconstruct/", "tests/reference/", "tests/stress/", "tests/test_public_names.py", "tests/test_pretended_cuda.py")
"""Single files take up to most of a minute of a core: of those that compute they come first, lest one begun late keep the others waiting."""


def is_in_browser(nodeid: str) -> bool:
    return nodeid.startswith("tests/web/")


def browser_lot(nodeid: str) -> int:
    """0, 1, 2: in this order they begin."""
    return 0 if nodeid.startswith(LONGEST_IN_BROWSER) else 1 if nodeid < HALF_WAY else 2


def order(nodeid: str) -> tuple[int, int]:
    if is_in_browser(nodeid):
        return 0, browser_lot(nodeid)
    return 1 if nodeid.startswith(WAITING) else 2 if nodeid.startswith(LONG) else 3, 0


def pytest_configure(config: pytest.Config) -> None:
    """One thread of torch for each of the processes that share the tests, of which there are more than cores: two are far slower then."""
    if hasattr(config, "workerinput"):
        torch.set_num_threads(1)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Whoever looks for garbage among what tests leave passes over what was there before them, half a million objects, and looks more seldom than by
    default, after 700 new ones: trees of syntax and the like that tests keep are looked through each time."""
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.set_threshold(7000)
        gc.enable()


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark the browser's tests as slow; where processes share the tests, those that wait come first, and then the long ones."""
    for item in items:
        if is_in_browser(item.nodeid):
            item.add_marker(pytest.mark.slow)
    if hasattr(config, "workerinput"):
        items.sort(key=lambda item: order(item.nodeid))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """How `./run test` shares the tests out among four processes: file by file, those that use the browser in three lots.

    One server and one Chromium serve a lot. The lots wait more than they compute; the fourth process takes what is left meanwhile, and
    begins with what waits, too, so that at the end there are many small files that keep every core busy.
    """
    from xdist.scheduler import LoadScopeScheduling

    class Shares(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return f"browser, lot {browser_lot(nodeid)}" if is_in_browser(nodeid) else nodeid.split("::")[0]

    return Shares(config, log)


@pytest.fixture(autouse=True)
def _counted_calls() -> None:
    count_calls_anew()


@pytest.fixture(autouse=True)
def _fixed_seeds() -> None:
    # Not torch.manual_seed, which keeps the stack of each caller for GPUs that nobody has opened: milliseconds a test.
    torch.default_generator.manual_seed(0)
    if torch.cuda.is_available():
        torch.cuda.manual_seed_all(0)
