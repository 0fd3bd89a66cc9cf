"""A CUDA device that is none: tensors that say they are on it lie on the CPU, and what a GPU would refuse is refused.

For machines without a GPU: what runs here with device "cuda" makes no tensor on the wrong device, mixes none of two and reads none that it has not copied, and
goes the ways that only CUDA goes (a thread a pixel, Warp's tree of triangles). Whether kernels are right on a GPU is not asked: they run on the CPU,
one index after another, so what races there does not race here.

`enter` changes torch and Warp for the whole process, so it is only called in processes that are started for this (run_on_pretended_cuda.py).
"""

import threading
from collections.abc import Callable
from typing import Any

import torch
import warp as wp
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map
from warp._src.context import Module

CPU, CUDA = torch.device("cpu"), torch.device("cuda", 0)
BY_INDEX = ("aten::index", "aten::index_put", "aten::index_put_", "aten::_index_put_impl_")
"""Take indices from the CPU, too."""

_now = threading.local()
"""in_backward: autograd works on pretended tensors. called: torch was called with some; what it makes of its own then is theirs."""


class PretendedTensor(torch.Tensor):
    """Says that it is on CUDA; its values are those of `inner`, which is on the CPU.

    torch's C++ takes it for a tensor of the CPU: so autograd works, and what C++ makes without being told where is sorted out in `_run`.
    """

    inner: torch.Tensor
    __torch_function__ = torch._C._disabled_torch_function_impl

    @staticmethod
    def __new__(cls, inner: torch.Tensor) -> "PretendedTensor":
        layout = {"strides": inner.stride(), "storage_offset": inner.storage_offset(), "dtype": inner.dtype}
        made = torch.Tensor._make_wrapper_subclass(cls, inner.shape, **layout, device=CPU, requires_grad=False)
        made.inner = inner
        return made

    device = property(lambda self: CUDA)  # type: ignore[assignment]
    is_cuda = property(lambda self: True)  # type: ignore[assignment]

    def numpy(self, *, force: bool = False) -> Any:
        raise TypeError("can't convert cuda:0 device type tensor to numpy. Use Tensor.cpu() to copy the tensor to host memory first.")

    __array__ = numpy  # type: ignore[assignment]

    def data_ptr(self) -> int:
        return self.inner.data_ptr()

    def tolist(self) -> Any:
        return self.inner.detach().tolist()

    def new_tensor(self, data: Any, dtype: torch.dtype | None = None, **options: Any) -> torch.Tensor:
        return _moved(torch.tensor(data, dtype=dtype or self.dtype), "cuda")

    def __repr__(self, **_: Any) -> str:  # type: ignore[override]
        return f"PretendedTensor({self.inner})"

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})


def _pretended(values: Any) -> list[PretendedTensor]:
    return [x for x in tree_flatten(values)[0] if isinstance(x, PretendedTensor)]


def _kind(device: Any) -> str | None:
    return None if device is None else "cuda" if isinstance(device, int) else torch.device(device).type


def _refuse(func: Any) -> None:
    raise RuntimeError(f"Expected all tensors to be on the same device, but found at least two devices, cuda:0 and cpu! ({func})")


def _check_devices(func: Any, args: Any, plain: list[torch.Tensor]) -> None:
    """Of an operation on pretended tensors and plain ones: numbers may come from the CPU, and indices."""
    first = args[0]
    if func._schema.name in BY_INDEX:
        is_wrong = not isinstance(first, PretendedTensor) or ("put" in func._schema.name and args[2].dim() > 0 and not _pretended(args[2]))
    else:
        writes_plain = func._schema.is_mutable and isinstance(first, torch.Tensor) and not isinstance(first, PretendedTensor)
        is_wrong = writes_plain or any(x.dim() > 0 for x in plain)
    if is_wrong:
        _refuse(func)


def _run(func: Any, args: Any, kwargs: Any) -> Any:
    """One of torch's operations, on the CPU; what comes out is pretended where it would be on CUDA."""
    tensors = [x for x in tree_flatten((args, kwargs))[0] if isinstance(x, torch.Tensor)]
    pretended = _pretended(tensors)
    name, kind, in_backward = func._schema.name, _kind(kwargs.get("device")), getattr(_now, "in_backward", False)
    if len(pretended) not in (0, len(tensors)) and name != "aten::copy_" and not in_backward:
        _check_devices(func, args, [x for x in tensors if not isinstance(x, PretendedTensor)])
    generator = kwargs.get("generator")
    if generator is not None and getattr(generator, "pretends", False) != (kind == "cuda" or (kind is None and bool(pretended))):
        raise RuntimeError(f"Expected a generator of the device of the result ({func})")
    args_here, kwargs_here = tree_map(lambda x: x.inner if isinstance(x, PretendedTensor) else x, (args, kwargs))
    if kind is not None:
        kwargs_here["device"] = CPU
    result = func(*args_here, **kwargs_here)
    if func._schema.is_mutable and name.endswith("_") and isinstance(args[0], torch.Tensor):
        return args[0]
    # C++ names the CPU for what it makes beside a pretended tensor, or in an operation on some; who asks for the CPU in Python gets there by _moved.
    is_on_cuda = kind == "cuda" or bool(pretended) or (not tensors and (in_backward or getattr(_now, "called", False)))
    if not is_on_cuda or name in ("aten::_local_scalar_dense", "aten::equal"):
        return result
    known = {id(x.inner): x for x in pretended}

    def pretended_of(value: Any) -> Any:
        if not isinstance(value, torch.Tensor):
            return value
        return known[id(value)] if id(value) in known else PretendedTensor(value)

    return tree_map(pretended_of, result)


class _Dispatch(TorchDispatchMode):
    """Operations without a pretended tensor, too."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})


class _Calls(TorchFunctionMode):
    """Keeps `_now.called`."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        before, _now.called = getattr(_now, "called", False), bool(_pretended((args, kwargs)))
        try:
            return func(*args, **(kwargs or {}))
        finally:
            _now.called = before


class _Move(torch.autograd.Function):
    """A copy on the other device."""

    @staticmethod
    def forward(ctx: Any, values: torch.Tensor, dtype: torch.dtype) -> torch.Tensor:
        ctx.was_pretended, ctx.dtype = isinstance(values, PretendedTensor), values.dtype
        if isinstance(values, PretendedTensor):
            return values.inner.to(dtype, copy=True)
        return PretendedTensor(values.to(dtype, copy=True))

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> Any:
        values = gradients[0].inner if isinstance(gradients[0], PretendedTensor) else gradients[0]
        values = values.to(ctx.dtype)
        return PretendedTensor(values) if ctx.was_pretended else values, None


_to = torch.Tensor.to


def _moved(self: torch.Tensor, *args: Any, **kwargs: Any) -> torch.Tensor:
    """Tensor.to."""
    device, dtype = kwargs.get("device"), kwargs.get("dtype")
    for given in args:
        if isinstance(given, torch.Tensor):
            device, dtype = given.device, given.dtype
        elif isinstance(given, torch.dtype):
            dtype = given
        elif isinstance(given, str | torch.device):
            device = given
    here = "cuda" if isinstance(self, PretendedTensor) else "cpu"
    if _kind(device) in (None, here):
        return _to(self, dtype=dtype or self.dtype, copy=kwargs.get("copy", False))
    return _Move.apply(self, dtype or self.dtype)


class _Generator(torch._C.Generator):
    def __new__(cls, device: Any = "cpu") -> "_Generator":
        return super().__new__(cls, device="cpu")

    def __init__(self, device: Any = "cpu") -> None:
        self.pretends = _kind(device) == "cuda"

    @property
    def device(self) -> torch.device:  # type: ignore[override]
        return CUDA if self.pretends else CPU


def _made_there(make: Callable[..., torch.Tensor]) -> Callable[..., torch.Tensor]:
    """torch.tensor and the like, which go to a device by C++."""

    def made(*args: Any, device: Any = None, requires_grad: bool = False, **kwargs: Any) -> torch.Tensor:
        values = make(*args, **kwargs)
        return (values if device is None else _moved(values, device)).requires_grad_(requires_grad)

    return made


class _Device:
    """Warp's, of pretended tensors."""

    is_cuda, is_cpu, alias, ordinal, arch = True, False, "cuda:0", 0, 90

    def __str__(self) -> str:
        return self.alias


def _pretend_in_torch() -> None:
    torch.cuda._lazy_init = lambda: None
    torch.cuda.is_available = lambda: True
    torch.cuda.device_count = lambda: 1
    torch.cuda.synchronize = lambda *_: None
    torch.cuda.manual_seed_all = lambda _: None
    torch.Tensor.to = _moved  # type: ignore[assignment,method-assign]
    torch.Tensor.cpu = lambda self: _moved(self, "cpu")  # type: ignore[assignment,method-assign]
    torch.tensor, torch.as_tensor = _made_there(torch.tensor), _made_there(torch.as_tensor)
    torch.Generator = _Generator  # type: ignore[misc]
    run_backward = torch.autograd.graph._engine_run_backward

    def pretended_backward(outputs: Any, *args: Any, **kwargs: Any) -> Any:
        before = getattr(_now, "in_backward", False)
        _now.in_backward = before or bool(_pretended(outputs))
        try:
            return run_backward(outputs, *args, **kwargs)
        finally:
            _now.in_backward = before

    torch.autograd.graph._engine_run_backward = torch.autograd._engine_run_backward = pretended_backward


def _check_arguments(value: Any, on_cuda: bool, kernel: Any) -> None:
    """Arrays that a kernel is given, also in structs, are of its device."""
    if hasattr(value, "_cls"):
        for name in value._cls.vars:
            _check_arguments(getattr(value, name), on_cuda, kernel)
    elif getattr(value, "pretends", on_cuda) != on_cuda:
        raise RuntimeError(f"kernel {kernel.key} is launched on {'cuda' if on_cuda else 'cpu'}, an array of it is not there")


def _pretend_in_warp() -> None:
    device, cpu = _Device(), wp.get_device("cpu")
    get_device, device_from_torch, from_torch, launch, load = wp.get_device, wp.device_from_torch, wp.from_torch, wp.launch, Module.load

    def is_pretended(asked: Any) -> bool:
        return isinstance(asked, _Device) or str(asked).startswith("cuda")

    def marked_from_torch(tensor: torch.Tensor, *args: Any, **kwargs: Any) -> Any:
        pretends = isinstance(tensor, PretendedTensor)
        array = from_torch(tensor.inner if isinstance(tensor, PretendedTensor) else tensor, *args, **kwargs)
        array.pretends = pretends
        return array

    def launch_here(kernel: Any, dim: Any, inputs: Any = (), outputs: Any = (), *args: Any, device: Any = None, **kwargs: Any) -> Any:
        for value in (*inputs, *outputs):
            _check_arguments(value, is_pretended(device), kernel)
        return launch(kernel, dim, inputs, outputs, *args, device=cpu if is_pretended(device) else device, **kwargs)

    def load_here(self: Any, asked: Any, block_dim: Any = None, *args: Any, **kwargs: Any) -> Any:
        return load(self, cpu, 1, *args, **kwargs) if is_pretended(asked) else load(self, asked, block_dim, *args, **kwargs)

    wp.get_device = lambda asked=None: device if is_pretended(asked) else get_device(asked)
    wp.device_from_torch = lambda asked: device if is_pretended(asked) else device_from_torch(asked)
    wp.from_torch, wp.launch, Module.load = marked_from_torch, launch_here, load_here


def enter() -> None:
    """Pretend from now on, in this thread and in those that are started."""
    _pretend_in_torch()
    _pretend_in_warp()
    run = threading.Thread.run

    def run_pretending(self: threading.Thread) -> None:
        with _Dispatch(), _Calls():
            run(self)

    threading.Thread.run = run_pretending  # type: ignore[method-assign]
    _Dispatch().__enter__()
    _Calls().__enter__()
