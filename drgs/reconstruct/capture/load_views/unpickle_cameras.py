"""Print the cameras of a NeRO folder as JSON. Run as a program of its own, never imported: NeRO keeps its cameras as pickles.

An unpickler may call whatever a file names. This one may only build numpy arrays, has little memory and time, and runs in a
process that holds nothing. Usage: python unpickle_cameras.py FOLDER → {"0": [[w2c 3x4], [K 3x3]], ...}.
"""

import json
import pickle
import resource
import sys
from pathlib import Path

ALLOWED = {
    *((f"numpy.{core}.multiarray", name) for core in ("core", "_core") for name in ("_reconstruct", "scalar")),
    *((f"numpy.{core}.numeric", "_frombuffer") for core in ("core", "_core")),
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("_codecs", "encode"),
}
MOST_BYTES = 100_000
"""A camera is under 1 kB; anything much longer is not one."""


class _CameraUnpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> object:
        if (module, name) not in ALLOWED:
            raise pickle.UnpicklingError(f"refused to load {module}.{name}")
        return super().find_class(module, name)


def _read_camera(path: Path) -> list[list[list[float]]]:
    if path.stat().st_size > MOST_BYTES:
        raise ValueError(f"{path.stat().st_size} bytes, expected a camera of at most {MOST_BYTES}")
    with path.open("rb") as file:
        pose, intrinsics = _CameraUnpickler(file).load()
    return [[[float(number) for number in row] for row in pose], [[float(number) for number in row] for row in intrinsics]]


def main() -> int:
    resource.setrlimit(resource.RLIMIT_CPU, (60, 60))
    cameras = {}
    for path in sorted(Path(sys.argv[1]).glob("*-camera.pkl")):
        try:
            cameras[path.name.removesuffix("-camera.pkl")] = _read_camera(path)
        except Exception as error:
            print(f"{path}: not a NeRO camera ({type(error).__name__}: {error}).", file=sys.stderr)
            return 2
    json.dump(cameras, sys.stdout)
    return 0


if __name__ == "__main__":
    sys.exit(main())
