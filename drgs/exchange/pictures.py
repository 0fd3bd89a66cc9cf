"""Pictures of more than 8 bits a channel, made 8-bit. In and out: Pillow images.

Pillow's own `convert` cuts 16-bit grey off at 255, so that all but the darkest shades become white: whoever reads pictures of strangers calls
`as_eight_bits` before it. Colour of 16 bits needs nothing, since Pillow keeps the high byte of each channel as it reads.
"""

import numpy as np
from PIL import Image

_MOST = 65535
"""Of a 16-bit channel."""


def as_eight_bits(image: Image.Image) -> Image.Image:
    """The picture itself, or one of mode L (LA where one shade of it is transparent) in place of 16-bit grey.

    Raises:
        ValueError: whole numbers beyond 16 bits.
        OSError, SyntaxError: the picture is damaged.
    """
    if not image.mode.startswith("I"):
        return image
    values = np.asarray(image).astype(np.int64)
    if values.min() < 0 or values.max() > _MOST:
        raise ValueError(f"its values span {values.min()} to {values.max()}, expected 0 to {_MOST}")
    grey = Image.fromarray(((values + 128) // 257).astype(np.uint8))
    transparent = image.info.get("transparency")
    if isinstance(transparent, int):
        grey.putalpha(Image.fromarray(np.where(values == transparent, 0, 255).astype(np.uint8)))
    return grey
