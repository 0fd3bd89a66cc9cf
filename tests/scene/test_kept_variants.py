"""Variants in a list of edits: kept by name, worn in the place of other material edits, and nothing by themselves."""

import pytest

from drgs.scene.edits import Edit, VariantEdit, parse_edits, plain_edit
from drgs.scene.variants import MOST_VARIANTS, kept_variants, wearing_variant, with_renamed_variant, with_variant, without_variant

LIGHT = {"op": "environment", "rotation": 30.0}


def rough(value: float) -> dict:
    return {"op": "material", "select": {"all": True}, "set": {"roughness": value}}


def variant(name: str, *edits: dict) -> VariantEdit:
    (made,) = parse_edits([{"op": "variant", "name": name, "edits": list(edits)}])
    assert isinstance(made, VariantEdit)
    return made


def values(edits: list[Edit]) -> list:
    """Of each material edit its roughness, of each variant its name, of others their kind."""
    return [edit.set.roughness if edit.op == "material" else edit.name if edit.op == "variant" else edit.op for edit in edits]


def test_a_variant_is_worn_in_the_place_of_all_material_edits_and_light_stays() -> None:
    edits = [*parse_edits([rough(0.1), LIGHT]), variant("Matt", rough(0.9), rough(0.8)), *parse_edits([rough(0.2)])]
    assert values(wearing_variant(edits, "Matt")) == ["environment", "Matt", 0.9, 0.8]
    with pytest.raises(KeyError, match="Gold"):
        wearing_variant(edits, "Gold")


def test_a_name_is_kept_once_and_a_renamed_variant_keeps_its_place() -> None:
    edits = with_variant(with_variant([], variant("One", rough(0.1))), variant("Two", rough(0.2)))
    again = with_variant(edits, variant("One", rough(0.3)))
    assert values(again) == ["One", "Two"] and values(list(kept_variants(again)["One"])) == [0.3]
    renamed = with_renamed_variant(again, "One", "Three")
    assert values(renamed) == ["Three", "Two"] and values(list(kept_variants(renamed)["Three"])) == [0.3]
    assert values(without_variant(renamed, "Three")) == ["Two"]
    with pytest.raises(ValueError, match="'Two' already"):
        with_renamed_variant(renamed, "Three", "Two")
    with pytest.raises(ValueError, match="expected one line"):
        with_renamed_variant(renamed, "Three", "As captured")
    for call in (lambda: without_variant(renamed, "One"), lambda: with_renamed_variant(renamed, "One", "Four")):
        with pytest.raises(KeyError, match="One"):
            call()


def test_there_are_at_most_so_many() -> None:
    edits: list[Edit] = [variant(str(number)) for number in range(MOST_VARIANTS)]
    with pytest.raises(ValueError, match=f"expected at most {MOST_VARIANTS}"):
        with_variant(edits, variant("More"))
    assert len(with_variant(edits, variant("0", rough(0.1)))) == MOST_VARIANTS


@pytest.mark.parametrize("name", ["", " Gold", "a/b", "two\nlines", "As captured", "As shown", "x" * 101])
def test_a_name_that_is_none_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match=r"edits: 0\.variant"):
        variant(name)


def test_a_variant_holds_material_edits_only_and_comes_back_as_it_went() -> None:
    with pytest.raises(ValueError, match="material"):
        variant("Lit", LIGHT)
    made = variant("Matt", rough(0.9))
    assert parse_edits([plain_edit(made)]) == [made]
