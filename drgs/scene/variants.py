"""Material variants that a list of edits keeps: what the object may be made of, by name.

In: edits in order. Out: the variants, or edits in which one of them is kept, renamed, removed or worn. Knows nothing of assets.
"""

from collections.abc import Sequence

from drgs.scene.edits import Edit, MaterialEdit, VariantEdit

MOST_VARIANTS = 32
"""Each has textures of its own in a file."""


def kept_variants(edits: Sequence[Edit]) -> dict[str, list[MaterialEdit]]:
    """By name, in the order in which they came."""
    return {edit.name: edit.edits for edit in edits if isinstance(edit, VariantEdit)}


def material_edits(edits: Sequence[Edit]) -> list[MaterialEdit]:
    return [edit for edit in edits if isinstance(edit, MaterialEdit)]


def with_variant(edits: Sequence[Edit], variant: VariantEdit) -> list[Edit]:
    """One more, or another in the place of that of the same name.

    Raises:
        ValueError: there are too many.
    """
    if variant.name not in (kept := kept_variants(edits)):
        if len(kept) >= MOST_VARIANTS:
            raise ValueError(f"found {len(kept)} variants already; expected at most {MOST_VARIANTS}: remove one first")
        return [*edits, variant]
    return [variant if _keeps(edit, variant.name) else edit for edit in edits]


def with_renamed_variant(edits: Sequence[Edit], name: str, to: str) -> list[Edit]:
    """
    Raises:
        KeyError: no variant is called so.
        ValueError: another one is called `to`, or nothing can be.
    """
    kept = kept_variants(edits)
    if to != name and to in kept:
        raise ValueError(f"a variant is called {to!r} already; expected another name, or remove that one first")
    renamed = VariantEdit(op="variant", name=to, edits=kept[name])
    return [renamed if _keeps(edit, name) else edit for edit in edits]


def without_variant(edits: Sequence[Edit], name: str) -> list[Edit]:
    """
    Raises:
        KeyError: no variant is called so.
    """
    kept_variants(edits)[name]
    return [edit for edit in edits if not _keeps(edit, name)]


def wearing_variant(edits: Sequence[Edit], name: str) -> list[Edit]:
    """Its material edits in the place of those in force; light and shape stay.

    Raises:
        KeyError: no variant is called so.
    """
    worn = kept_variants(edits)[name]
    return [*(edit for edit in edits if not isinstance(edit, MaterialEdit)), *worn]


def _keeps(edit: Edit, name: str) -> bool:
    return isinstance(edit, VariantEdit) and edit.name == name
