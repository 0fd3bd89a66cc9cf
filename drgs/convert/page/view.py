"""An asset in a notebook: the page that `drgs export OUT page.html` writes, in a frame of the cell's output.

It needs no service, no port and no widget of Jupyter's, and what a saved notebook holds of it still turns and relights where no kernel runs. The
frame is a sandbox: what an asset's name or picture may hold reaches nothing of the notebook's.
"""

import html
from dataclasses import dataclass

from drgs.convert.page.encode_page import encode_page
from drgs.scene.asset import Asset

HEIGHT_PX = 480


@dataclass(frozen=True)
class AssetView:
    """What a notebook shows of an asset. Final."""

    page: str
    """HTML, all in one."""
    height_px: int

    def _repr_html_(self) -> str:
        attributes = f'sandbox="allow-scripts" allow="fullscreen" style="width: 100%; height: {self.height_px}px; border: 0"'
        return f'<iframe srcdoc="{html.escape(self.page)}" {attributes}></iframe>'

    def __repr__(self) -> str:
        return f"AssetView of {len(self.page) / 1e6:.1f} MB; a notebook shows it"


def view(asset: Asset, height_px: int = HEIGHT_PX) -> AssetView:
    """The object to turn, relight and recolour, as the last value of a notebook's cell; a saved notebook keeps up to 5 MB of it.

    Raises:
        ValueError: no page can be made of the asset; drgs.convert.page.encode_page says when.
    """
    if height_px <= 0:
        raise ValueError(f"height_px is {height_px}; expected pixels, such as {HEIGHT_PX}")
    return AssetView(encode_page(asset).html.decode(), height_px)
