"""What all tests share: the device, fixed seeds, and shape checks on the records.

`device` is the CPU, and CUDA too where there is one; `--device cpu` or `--device cuda` asks for one of them, and cuda fails where
there is none instead of passing by doing nothing.
"""

import pytest
from jaxtyping import install_import_hook

# Before anything imports them: every tensor that enters a record must have the shape its annotation says.
_hook = install_import_hook(["drgs.scene", "drgs.render.records"], "beartype.beartype")

import torch  # noqa: E402


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--device", choices=["cpu", "cuda"], default=None, help="run tests that take a device on this one only")


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "device" not in metafunc.fixturenames:
        return
    asked = metafunc.config.getoption("--device")
    if asked == "cuda" and not torch.cuda.is_available():
        raise pytest.UsageError("--device cuda was asked for, but torch finds no usable GPU")
    metafunc.parametrize("device", [asked] if asked else ["cpu", *(["cuda"] if torch.cuda.is_available() else [])])


@pytest.fixture(autouse=True)
def _fixed_seeds() -> None:
    torch.manual_seed(0)
