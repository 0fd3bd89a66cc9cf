"""An asset as a page: one HTML file with the object, its lights and the program that draws it.

In: an asset. Out: bytes of a file that a browser opens without a server and without a network. What a browser could not do at once is done
here: faces are left out, shadows and inter-reflection baked (bake_transfer), lights filtered (page_lights).
"""

import base64
import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from drgs.convert.bake_transfer import bake_transfer
from drgs.convert.page.pack_arrays import in_order_of_use, pack_arrays, rgbe, steps_from_newest
from drgs.convert.page.page_lights import PageLight, page_lights
from drgs.convert.shrink_mesh import shrink_worn
from drgs.reconstruct.fit.light.split_sum import LEVELS, brdf_table
from drgs.reconstruct.geometry.extract_mesh.clean_mesh import is_watertight
from drgs.scene.asset import Asset
from drgs.scene.edits import AS_CAPTURED
from drgs.scene.mesh import TriangleMesh, on_cpu

PROGRAM = Path(__file__).with_name("page.html")
"""Built by web/build.py, with a place for the title and one for the object."""
TITLE_PLACE, OBJECT_PLACE = "{{title}}", "{{object}}"
MOST_BYTES = 5_000_000
MOST_FACES = 250_000
COARSE_FACES = 12_000
"""Of a second mesh, for machines that cannot draw the first one thirty times a second: they show it while it moves."""
ROOM = 0.95
"""A page that is too large is tried again with as many faces as should fill this share of what it may weigh."""
ATTEMPTS = 4
PLACE_STEPS, NORMAL_STEPS, TRANSFER_STEPS = 1 << 14, 1 << 11, 1 << 10
"""Of positions along the longest side of the box, of normals a side of their octahedron, and of transfer over its range."""


@dataclass(frozen=True)
class Page:
    """The file, and what of the object is in it."""

    html: bytes
    faces: int


def encode_page(asset: Asset, variants: Mapping[str, TriangleMesh] | None = None, shown: str = AS_CAPTURED) -> Page:
    """The asset as a page of at most MOST_BYTES.

    Args:
        variants: the asset's mesh in other materials, by the names of their buttons. Shadows and the light that the object throws onto itself
            stay those of the asset's own.
        shown: what the page calls the asset's own material.

    Raises:
        ValueError: the page's program is not built, the asset has no faces, or they do not shrink far enough.
    """
    program = _program()
    if not len(asset.mesh.faces):
        raise ValueError("the asset's mesh has no faces; a page needs some to show")
    mesh = on_cpu(asset.mesh)
    worn = [mesh, *(on_cpu(variant) for variant in (variants or {}).values())]
    names = [shown, *(variants or ())]
    coarse = shrink_worn(worn, COARSE_FACES)
    lights, factors = page_lights(asset.environment), _brdf_bytes()
    most = MOST_FACES
    for _ in range(ATTEMPTS):
        small = shrink_worn(worn, most)
        kept = len(small[0].faces)
        page = _filled(program, asset, names, (small, coarse) if len(coarse[0].faces) < kept else (small,), lights, factors)
        if len(page) <= MOST_BYTES:
            return Page(page, kept)
        most = int(ROOM * MOST_BYTES / len(page) * kept)
    raise ValueError(
        f"the page would have {len(page) / 1e6:.1f} MB with {kept} of the mesh's {len(mesh.faces)} faces; expected at most "
        f"{MOST_BYTES / 1e6:g}, so simplify the mesh: its faces share too few corners to be joined"
    )


def _program() -> str:
    if not PROGRAM.is_file():
        raise ValueError(f"{PROGRAM.name}: is not there; build it with `./run setup` (python web/build.py)")
    return PROGRAM.read_text(encoding="utf-8")


def _filled(
    program: str,
    asset: Asset,
    names: Sequence[str],
    meshes: Sequence[Sequence[TriangleMesh]],
    lights: Sequence[PageLight],
    factors: ndarray,
) -> bytes:
    """
    Args:
        names: of the materials.
        meshes: the finest first, each in every material.
    """
    title = _title(asset)
    arrays: dict[str, ndarray] = {}
    details = []
    for number, worn in enumerate(meshes):
        found, detail = _mesh_arrays(worn)
        arrays |= {f"mesh{number}.{name}": values for name, values in found.items()}
        details.append(detail)
    for number, light in enumerate(lights):
        arrays |= {f"light{number}.{level}": rgbe(table) for level, table in enumerate(light.tables)}
    about = {
        "title": title,
        "photographs": len(asset.cameras),
        "faces": {"kept": len(meshes[0][0].faces), "all": len(asset.mesh.faces)},
        "materials": list(names),
        "meshes": details,
        "roughness_levels": [roughness for roughness, _ in LEVELS],
        "lights": [{"name": light.name, "harmonics": light.harmonics.round(6).tolist()} for light in lights],
        "factors_side": round(len(factors) ** 0.5),
    }
    packed = base64.b64encode(pack_arrays(arrays | {"factors": factors}, about)).decode()
    # The object first: a title may contain anything, base64 no braces.
    return program.replace(OBJECT_PLACE, packed).replace(TITLE_PLACE, html.escape(title)).encode()


def _mesh_arrays(worn: Sequence[TriangleMesh]) -> tuple[dict[str, ndarray], dict]:
    """One mesh in several materials, quantised, and how to turn its numbers back."""
    mesh = worn[0]
    vertices = mesh.vertices.double().numpy()
    faces, order = in_order_of_use(mesh.faces.long().numpy(), vertices)
    vertices = vertices[order]
    low, extent = vertices.min(0), max(float(np.ptp(vertices, axis=0).max()), 1e-12)
    transfer = bake_transfer(mesh).double().numpy()[order]
    range_ = max(float(np.abs(transfer).max()), 1e-12)
    arrays = {
        "steps": steps_from_newest(faces),
        "places": np.rint((vertices - low) / extent * (PLACE_STEPS - 1)).astype(np.uint16),
        "normals": _octahedral(mesh.normals.double().numpy()[order]),
        "transfer": np.rint((transfer / range_ + 1) / 2 * (TRANSFER_STEPS - 1)).astype(np.uint16),
    }
    for number, material in enumerate(worn):
        # Roots keep the steps of dark colours small, as sRGB does.
        arrays[f"albedo_roots{number}"] = _bytes_of(np.sqrt(material.albedo.clamp(0, 1).numpy()[order]))
        arrays[f"surface{number}"] = _bytes_of(torch.stack([material.roughness, material.metallic], -1).numpy()[order])
    about = {
        "low": low.tolist(),
        "place_step": extent / (PLACE_STEPS - 1),
        "high": vertices.max(0).tolist(),
        "normal_steps": NORMAL_STEPS,
        "transfer_low": -range_,
        "transfer_step": 2 * range_ / (TRANSFER_STEPS - 1),
        "closed": is_watertight(len(vertices), faces),
    }
    return arrays, about


def _octahedral(normals: Float[ndarray, "vertex 3"]) -> ndarray:
    """(vertex, 2) uint16: unit vectors on the unfolded octahedron (Meyer et al. 2010; docs/sources.md: meyer2010)."""
    flat = normals / np.maximum(np.abs(normals).sum(-1, keepdims=True), 1e-12)
    sides = np.where(flat[:, :2] >= 0, 1.0, -1.0)
    below = (1 - np.abs(flat[:, 1::-1])) * sides
    unfolded = np.where(flat[:, 2:] >= 0, flat[:, :2], below)
    return np.rint((unfolded + 1) / 2 * (NORMAL_STEPS - 1)).astype(np.uint16)


def _brdf_bytes() -> ndarray:
    """(roughness * n.v, 2) uint8: the factors of split_sum's brdf_table."""
    return _bytes_of(brdf_table().permute(1, 2, 0).reshape(-1, 2).numpy())


def _bytes_of(values: ndarray) -> ndarray:
    return np.rint(values.clip(0, 1) * 255).astype(np.uint8)


def _title(asset: Asset) -> str:
    """What the asset was made of, in words; names of files are the nearest to a title that an asset has."""
    source = asset.provenance.get("source")
    name = asset.provenance.get("dataset") or (source.get("file") if isinstance(source, dict) else None)
    return Path(str(name)).stem.replace("_", " ") if name else "Object"
