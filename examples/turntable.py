"""Turn an asset once in front of the camera, as an MP4.

python examples/turntable.py "http://127.0.0.1:8000/#token=..." ASSET_ID OUT.mp4 [--frames 96] [--fps 24] [--environment studio.exr]
"""

import argparse
from pathlib import Path

from drgs_server.client import Client
from drgs_worker.jobs.requests import RenderRequest, Turntable


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("address", help="what `drgs serve` printed")
    parser.add_argument("asset")
    parser.add_argument("out", type=Path)
    parser.add_argument("--frames", type=int, default=96)
    parser.add_argument("--fps", type=int, default=24)
    parser.add_argument("--environment", default="own")
    parser.add_argument("--size", default="800x600")
    parser.add_argument("--spp", type=int, default=128)
    given = parser.parse_args(arguments)
    width, height = (int(number) for number in given.size.split("x"))
    with Client(given.address) as client:
        job = client.wait(
            client.submit(
                RenderRequest(
                    kind="render",
                    asset=given.asset,
                    turntable=Turntable(frames=given.frames),
                    environments=[given.environment],
                    width=width,
                    height=height,
                    spp=given.spp,
                    video_fps=given.fps,
                )
            )
        )
        video = next(file.name for file in client.job_files(job.id) if file.name.endswith(".mp4"))
        client.download_file(job.id, video, given.out)
    print(given.out)


if __name__ == "__main__":
    main()
