"""Material variants of an asset, to be exported beside it: lists of material edits by name.

A file of variants is a JSON object: {"Gold": [{"op": "material", ...}], "Matt": [...]}. Each list applies to the asset as it is, not to another variant.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from drgs.deform.pose_scene import pose_scene
from drgs.scene.asset import Asset
from drgs.scene.edits import Edit, MaterialEdit, parse_edits
from drgs.scene.mesh import TriangleMesh

Variants = Mapping[str, Sequence[Edit]]
MOST_VARIANTS = 32
"""Each has textures of its own."""
LONGEST_NAME = 100
AS_CAPTURED = "As captured"
"""What a file calls the asset without any of them."""


def load_variants(path: Path) -> Variants:
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
        if not name.strip() or len(name) > LONGEST_NAME or name == AS_CAPTURED:
            raise ValueError(
                f"a variant is called {name[:LONGEST_NAME]!r}; expected 1 to {LONGEST_NAME} characters, other than {AS_CAPTURED!r}"
            )
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
    return [pose_scene(asset, edits).mesh for edits in variants.values()]
