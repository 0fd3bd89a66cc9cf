"""Material variants of an asset, to be exported beside it: lists of material edits by name.

A file of variants is a JSON object: {"Gold": [{"op": "material", ...}], "Matt": [...]}. Each list applies to the asset as it is, not to another variant.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from jaxtyping import Int
from torch import Tensor

from drgs.deform.pose_scene import pose_scene
from drgs.scene.asset import Asset
from drgs.scene.edits import AS_CAPTURED, AS_SHOWN, LONGEST_VARIANT_NAME, Edit, MaterialEdit, parse_edits
from drgs.scene.mesh import TriangleMesh
from drgs.scene.variants import MOST_VARIANTS

Variants = Mapping[str, Sequence[Edit] | TriangleMesh]
"""Material edits by name, or what they make of the mesh."""


def load_variants(path: Path) -> dict[str, list[Edit]]:
    """Read a file of variants.

    Raises:
        ValueError: a sentence: no such object, an edit that cannot be read, or one that is not of material.
    """
    try:
        found = json.loads(path.read_text())
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: is not JSON ({error}); expected an object of lists of material edits by name") from error
    if not isinstance(found, dict) or not all(isinstance(edits, list) for edits in found.values()):
        raise ValueError(f'{path}: expected an object of lists of material edits by name, such as {{"Gold": [...]}}')
    try:
        variants = {name: parse_edits(edits) for name, edits in found.items()}
        refuse_variants(variants)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return variants


def refuse_variants(variants: Variants) -> None:
    """
    Raises:
        ValueError: there are none or too many, a name that is none, or an edit that is not of material.
    """
    if not 1 <= len(variants) <= MOST_VARIANTS:
        raise ValueError(f"found {len(variants)} variants; expected 1 to {MOST_VARIANTS}")
    for name, edits in variants.items():
        if not name.strip() or len(name) > LONGEST_VARIANT_NAME or name in (AS_CAPTURED, AS_SHOWN):
            raise ValueError(
                f"a variant is called {name[:LONGEST_VARIANT_NAME]!r}; expected 1 to {LONGEST_VARIANT_NAME} characters, other than {AS_CAPTURED!r} and {AS_SHOWN!r}"
            )
        if isinstance(edits, TriangleMesh):
            continue
        other = next((edit.op for edit in edits if not isinstance(edit, MaterialEdit)), None)
        if other is not None:
            raise ValueError(
                f"the variant {name!r} has an edit of the kind {other!r}; expected material edits only, for all share one shape"
            )


def variant_meshes(asset: Asset, variants: Variants) -> list[TriangleMesh]:
    """The asset's mesh in the materials of each variant.

    Raises:
        ValueError: an edit that does not fit this asset.
    """
    return [worn if isinstance(worn, TriangleMesh) else pose_scene(asset, worn).mesh for worn in variants.values()]


def worn_meshes(
    asset: Asset,
    shape: TriangleMesh,
    variants: Mapping[str, Sequence[Edit]],
    files: Path,
    source: Int[Tensor, "vertex"] | None = None,
) -> dict[str, TriangleMesh]:
    """A mesh in the materials of each variant.

    Args:
        asset: what the variants are of.
        shape: its mesh, perhaps moved by other edits.
        files: the folder that edits name files in, and lead out of nowhere.
        source: the posed scene's `vertex_source`, where other edits have made grains of it.

    Raises:
        ValueError: an edit that does not fit this asset, or a file that is missing or damaged.
    """

    def worn(edits: Sequence[Edit]) -> TriangleMesh:
        mesh = pose_scene(asset, edits, files, confine=True).mesh
        of = slice(None) if source is None else source
        return replace(shape, albedo=mesh.albedo[of], roughness=mesh.roughness[of], metallic=mesh.metallic[of])

    return {name: worn(edits) for name, edits in variants.items()}
