"""Material variants of an asset on one sheet: roughness across, metal down.

python examples/variants_sheet.py "http://127.0.0.1:8000/#token=..." ASSET_ID OUT.png [--side 256] [--steps 4]
"""

import argparse
import io
from pathlib import Path

from PIL import Image

from drgs_server.client import Client


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("address", help="what `drgs serve` printed")
    parser.add_argument("asset")
    parser.add_argument("out", type=Path)
    parser.add_argument("--side", type=int, default=256, help="of one picture [pixels]")
    parser.add_argument("--steps", type=int, default=4, help="pictures across")
    parser.add_argument("--spp", type=int, default=128)
    given = parser.parse_args(arguments)
    sheet = Image.new("RGB", (given.side * given.steps, given.side * 2))
    with Client(given.address) as client:
        session = client.open_session(given.asset)
        for row, metallic in enumerate((0.0, 1.0)):
            for column in range(given.steps):
                roughness = 0.1 + 0.9 * column / max(given.steps - 1, 1)
                session.edit({"op": "material", "select": {"all": True}, "set": {"roughness": roughness, "metallic": metallic}})
                picture = session.frame(given.side, given.side, given.spp, denoise=True)
                sheet.paste(Image.open(io.BytesIO(picture)).convert("RGB"), (column * given.side, row * given.side))
                session.undo()
        session.delete()
    sheet.save(given.out)
    print(given.out)


if __name__ == "__main__":
    main()
