"""Embree's own C interface: the shared library that the embreex package brings, and scenes built with it.

embreex traces ray by ray through arrays of its own and keeps its scene to itself; kernels that call Embree's functions by address need
neither copies nor Python between them (tracer_embree.py).

Source: Embree 4 API, rtcore.h (version 4.4).
"""

import ctypes
import weakref
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, files
from typing import Any

import numpy as np

_POINTER = ctypes.c_void_p
_SIGNATURES: dict[str, tuple[Any, list[Any]]] = {
    "rtcNewDevice": (_POINTER, [ctypes.c_char_p]),
    "rtcGetDeviceError": (ctypes.c_int, [_POINTER]),
    "rtcNewScene": (_POINTER, [_POINTER]),
    "rtcSetSceneFlags": (None, [_POINTER, ctypes.c_int]),
    "rtcNewGeometry": (_POINTER, [_POINTER, ctypes.c_int]),
    "rtcSetNewGeometryBuffer": (
        _POINTER,
        [_POINTER, ctypes.c_int, ctypes.c_uint, ctypes.c_int, ctypes.c_size_t, ctypes.c_size_t],
    ),
    "rtcCommitGeometry": (None, [_POINTER]),
    "rtcAttachGeometry": (ctypes.c_uint, [_POINTER, _POINTER]),
    "rtcReleaseGeometry": (None, [_POINTER]),
    "rtcCommitScene": (None, [_POINTER]),
    "rtcReleaseScene": (None, [_POINTER]),
}
_TRIANGLES, _INDICES, _VERTICES, _UINT3, _FLOAT3, _ROBUST = 0, 0, 1, 0x5003, 0x9003, 1 << 2
"""RTC_GEOMETRY_TYPE_TRIANGLE, RTC_BUFFER_TYPE_*, RTC_FORMAT_*, RTC_SCENE_FLAG_ROBUST."""


@dataclass(frozen=True)
class _Embree:
    library: ctypes.CDLL
    device: int


@cache
def _embree() -> _Embree:
    """The library with one device, which lives as long as the process.

    Raises:
        RuntimeError: the embreex package holds no Embree 4.
    """
    try:
        held = [file.locate() for file in files("embreex") or [] if "embree4" in file.name and "python" not in file.name]
    except PackageNotFoundError:
        held = []
    if not held:
        raise RuntimeError("the embreex package holds no Embree 4 library; install a wheel of embreex 4.4 or newer")
    library = ctypes.CDLL(str(held[0]))
    for name, (result, arguments) in _SIGNATURES.items():
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    device = library.rtcNewDevice(None)
    if not device:
        raise RuntimeError(f"Embree cannot start on this processor (error {library.rtcGetDeviceError(None)})")
    return _Embree(library, device)


@cache
def function_address(name: str) -> int:
    """Where a function of the library begins; kernels call it."""
    address = ctypes.cast(getattr(_embree().library, name), _POINTER).value
    assert address is not None
    return address


class EmbreeScene:
    """Triangles in a tree. Final; freed with the object."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, watertight: bool = True) -> None:
        """
        Args:
            vertices: (vertex, 3) float32. faces: (face, 3) uint32. Both are copied.
            watertight: no ray passes between triangles with a common edge. Without, first hits take four fifths of the time.

        Raises:
            RuntimeError: Embree refuses them.
        """
        embree = _embree()
        library = embree.library
        self.address: int = library.rtcNewScene(embree.device)
        self.freed = weakref.finalize(self, library.rtcReleaseScene, self.address)
        library.rtcSetSceneFlags(self.address, _ROBUST if watertight else 0)
        geometry = library.rtcNewGeometry(embree.device, _TRIANGLES)
        for kind, kind_format, values in ((_VERTICES, _FLOAT3, vertices), (_INDICES, _UINT3, faces)):
            buffer = library.rtcSetNewGeometryBuffer(geometry, kind, 0, kind_format, 12, len(values))
            if len(values):
                values = np.ascontiguousarray(values, np.float32 if kind == _VERTICES else np.uint32)
                ctypes.memmove(buffer, values.ctypes.data, values.nbytes)
        library.rtcCommitGeometry(geometry)
        library.rtcAttachGeometry(self.address, geometry)
        library.rtcReleaseGeometry(geometry)
        library.rtcCommitScene(self.address)
        error = library.rtcGetDeviceError(embree.device)
        if error:
            raise RuntimeError(f"Embree cannot build a tree of {len(faces)} triangles (error {error})")
