"""Stills denoised by Intel's Open Image Denoise, through the optional package pyoidn.

In: a frame's radiance and G-buffer. Out: the same with both parts filtered, albedo and normal as guides. Pictures go in multiplied by
coverage, as guides do, so that outlines are filtered as the antialiased edges they are. Trained on finished pictures, it knows nothing of
what came before and is slower than SVGF: for stills. On the CPU whatever the frame's device.
Source: Open Image Denoise 2 (openimagedenoise.org); the network's weights come with the package.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from drgs.installation import missing_package
from drgs.render.records import GBuffer, Radiance


def denoise_oidn(radiance: Radiance, gbuffer: GBuffer) -> Radiance:
    """Radiance as shown; variances are those of the samples, since the filter tells none.

    Raises:
        ValueError: pyoidn is not installed or does not work here.
    """
    filter_picture = oidn_filter()
    coverage = gbuffer.coverage[..., None]
    guides = {name: _picture(values * coverage) for name, values in (("albedo", gbuffer.albedo), ("normal", gbuffer.normal_world))}

    def filtered(part: Tensor) -> Tensor:
        if not bool((part > 0).any()):
            return part
        try:
            found = filter_picture(_picture(part * coverage), hdr=True, **guides)
        except RuntimeError as error:
            raise ValueError(f"the denoiser oidn failed: {error}") from error
        premultiplied = torch.from_numpy(found).to(part.device)
        return torch.where(coverage > 0, premultiplied / coverage.clamp(min=1e-6), 0.0)

    return replace(radiance, diffuse=filtered(radiance.diffuse), specular=filtered(radiance.specular))


def _picture(values: Tensor) -> np.ndarray:
    return np.ascontiguousarray(values.detach().float().cpu().numpy())


def oidn_filter() -> Any:
    """pyoidn.denoise.

    Raises:
        ValueError: pyoidn is not installed or its library does not load.
    """
    try:
        from pyoidn import denoise
    except (ImportError, OSError) as error:  # OSError: its library does not load here
        raise ValueError(f"{missing_package('the denoiser oidn', 'pyoidn', 'oidn')} ({error})") from error
    return denoise
