"""Build Blender's extension: `python blender/build.py [FOLDER]` writes drgs-blender-VERSION.zip (default: into dist/).

In Blender, Edit > Preferences > Get Extensions > Install from Disk takes it; docs/formats.md says what it brings. The zip holds
blender/drgs_import, the readers of assets that Blender can run as they are (numpy alone), and what the library computes with torch, as tables.
"""

import io
import re
import sys
import zipfile
from pathlib import Path

import numpy as np
import torch

from drgs import __version__
from drgs.convert.gltf_reflectance import gltf_base_color
from drgs.maths.sampling import sphere_lattice
from drgs.maths.spherical_harmonics import sh_basis

ROOT = Path(__file__).resolve().parent.parent
SOURCE = ROOT / "blender" / "drgs_import"
READERS = ("__init__.py", "package.py", "zip_entries.py", "glb.py", "ply.py", "gaussian_ply.py")
"""Of drgs/exchange: what read_asset.py needs."""
TABLE_SIZES = (33, 17, 65)
"""Entries of the table of base colours: roughness, metallic, albedo. Linear between them it is right to 0.004 (tests/blender)."""

NORMALS, VIEWS = 512, 2048
"""Directions of the table of lobes: normals, five degrees apart, and those that each is seen from."""


def build_extension(folder: Path) -> Path:
    """The zip that was written into the folder; the same sources give the same bytes."""
    manifest = (SOURCE / "blender_manifest.toml").read_text()
    files: dict[str, bytes] = {path.name: path.read_bytes() for path in sorted(SOURCE.glob("*.py"))}
    files["blender_manifest.toml"] = manifest.replace('"VERSION"', f'"{__version__}"').encode()
    files["LICENSE"] = (ROOT / "LICENSE").read_bytes()
    files["base_colors.npy"] = _npy(base_color_table())
    files["lobes.npy"] = _npy(lobe_table())
    for name in READERS:
        text = (ROOT / "drgs" / "exchange" / name).read_text()
        # Extensions must not put names of their own beside Blender's modules, so theirs are relative.
        files[f"exchange/{name}"] = re.sub(r"^from drgs\.exchange\.", "from .", text, flags=re.MULTILINE).encode()
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"drgs-blender-{__version__}.zip"
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in sorted(files.items()):
            archive.writestr(zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), data, zipfile.ZIP_DEFLATED)
    return path


def base_color_table() -> torch.Tensor:
    """TABLE_SIZES: the base colour of a Principled BSDF for an albedo of ours."""
    axes = (torch.linspace(0, 1, size) for size in TABLE_SIZES)
    roughness, metallic, albedo = (axis.flatten() for axis in torch.meshgrid(*axes, indexing="ij"))
    return gltf_base_color(albedo[:, None].expand(-1, 3), roughness, metallic)[:, 0].reshape(TABLE_SIZES)


def lobe_table() -> torch.Tensor:
    """(NORMALS, 3 + 16): a unit normal, and the mean of each harmonic over the views of a disc with it, weighted by how large these see the disc."""
    normals, towards = sphere_lattice(NORMALS), sphere_lattice(VIEWS)  # harmonics take directions from the camera to the disc
    sizes = (-normals @ towards.T).clamp(min=0)
    return torch.cat([normals, sizes @ sh_basis(towards) / sizes.sum(-1, keepdim=True)], -1)


def _npy(values: torch.Tensor) -> bytes:
    stream = io.BytesIO()
    np.save(stream, values.float().numpy(), allow_pickle=False)
    return stream.getvalue()


if __name__ == "__main__":
    print(build_extension(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "dist"))
