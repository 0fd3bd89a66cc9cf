"""Relight assets under every environment that a running server stores: a picture of each, in a folder.

python examples/relight_folder.py "http://127.0.0.1:8000/#token=..." OUT [--search NAME] [--size 800x600] [--spp 256]
"""

import argparse
from pathlib import Path

from drgs_server.client import Client
from drgs_worker.jobs.requests import RenderRequest


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("address", help="what `drgs serve` printed")
    parser.add_argument("out", type=Path)
    parser.add_argument("--search", help="only assets whose names hold this")
    parser.add_argument("--size", default="800x600")
    parser.add_argument("--spp", type=int, default=256)
    given = parser.parse_args(arguments)
    width, height = (int(number) for number in given.size.split("x"))
    with Client(given.address) as client:
        environments = ["own", *(environment.name for environment in client.environments())]
        # All are queued before the first is waited for, so that several workers share them.
        jobs = [
            client.submit(
                RenderRequest(
                    kind="render", asset=asset.id, name=asset.name, environments=environments, width=width, height=height, spp=given.spp
                )
            )
            for asset in client.assets(limit=500, search=given.search).assets
        ]
        for job in jobs:
            client.wait(job)
            folder = given.out / f"{job.name}-{job.id[:8]}"
            folder.mkdir(parents=True, exist_ok=True)
            for file in client.job_files(job.id):
                client.download_file(job.id, file.name, folder / file.name)
            print(folder)


if __name__ == "__main__":
    main()
