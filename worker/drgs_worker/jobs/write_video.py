"""Rendered pictures as a film: H.264 in MP4."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from drgs_worker.jobs.progress import JobStopped

GREY_SRGB = 110
"""Of 255: what stands behind an object where a format has no alpha."""


def over_grey(rgba: np.ndarray) -> np.ndarray:
    """(height, width, 3) uint8 sRGB of (height, width, 4) with straight alpha, over mid grey: for JPEG and video."""
    alpha = rgba[..., 3:].astype(np.float32) / 255
    return (rgba[..., :3] * alpha + GREY_SRGB * (1 - alpha) + 0.5).astype(np.uint8)


def write_video(pictures: list[Path], out: Path, fps: int, should_stop: Callable[[], bool] = lambda: False) -> None:
    """One frame a picture, all of one size. An odd last row or column is left out, as the format wants.

    Raises:
        JobStopped: should_stop() was true; `out` is not written.
    """
    import av
    from PIL import Image

    draft = out.with_suffix(".part")
    with Image.open(pictures[0]) as first:
        width, height = first.size

    def frames() -> Iterator[np.ndarray]:
        for path in pictures:
            if should_stop():
                raise JobStopped
            with Image.open(path) as image:
                pixels = over_grey(np.asarray(image.convert("RGBA")))
            yield np.ascontiguousarray(pixels[: height // 2 * 2, : width // 2 * 2])

    with av.open(str(draft), "w", format="mp4", options={"movflags": "faststart"}) as container:
        stream = container.add_stream("libx264", rate=fps, options={"crf": "18", "preset": "medium"})
        stream.pix_fmt, stream.width, stream.height = "yuv420p", width // 2 * 2, height // 2 * 2
        for pixels in frames():
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        container.mux(stream.encode())
    os.replace(draft, out)
