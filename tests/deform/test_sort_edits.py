"""Lists of edits are sorted once; what is added, taken away or put elsewhere is found without looking at all of them."""

from pathlib import Path

import numpy as np
import pytest
from test_pose_scene import material, plate_asset, twist

from drgs.deform.pose_scene import pose_scene
from drgs.deform.sort_edits import EditFiles, SortedEdits, sort_edits
from drgs.scene.edits import Edit, parse_edits, shared_beginning
from tests.count_calls import count_calls

FILES = EditFiles(None, confine=False)


def edits(count: int) -> list[Edit]:
    kinds = (
        lambda k: twist(1e-4 * k),
        lambda k: material({"all": True}, roughness=k / 9999),
        lambda k: {"op": "environment", "rotation": k},
    )
    return parse_edits([kinds[k % 3](k) for k in range(count)])


def digests(found: SortedEdits) -> tuple:
    return found.material.digest(found.material.count), found.shape.digest(found.shape.count), found.light


def test_matter_moves_nothing_and_is_refused_where_a_simulation_would_be() -> None:
    asset = plate_asset()
    around = parse_edits([twist(0.1), material({"all": True}, roughness=0.3)])
    matter = parse_edits([{"op": "matter", "scene": {"matter": {"preset": "clay"}, "pins": [1, 2]}}])
    before, after = pose_scene(asset, around), pose_scene(asset, [around[0], *matter, around[1]])
    assert after.mesh.vertices is before.mesh.vertices and after.mesh.roughness is before.mesh.roughness
    with pytest.raises(ValueError, match=r"simulation scene: matter\.preset"):
        pose_scene(asset, [*around, *parse_edits([{"op": "matter", "scene": {"matter": {"preset": "porridge"}}}])])
    assert pose_scene(asset, around).mesh.vertices is before.mesh.vertices


@pytest.mark.slow
def test_an_edit_more_takes_as_many_steps_behind_two_thousand_as_behind_a_hundred() -> None:
    taken = []
    for count in (100, 2000):
        asset, longer = plate_asset(), tuple(edits(count + 1))
        pose_scene(asset, longer[:-1])
        taken.append(count_calls(lambda asset=asset, longer=longer: pose_scene(asset, longer)))
    assert taken[1] < 1.1 * taken[0]


def test_lists_that_share_a_beginning_are_what_they_are_alone() -> None:
    asset, one, other = plate_asset(), edits(40), edits(40)
    wanted = [one, one[:17], [*one[:17], *other[20:25]], one, [], one[:30], [*one[:5], *one[9:]], other, [*one, *one], one[3:]]
    for found in wanted:
        assert digests(sort_edits(asset, found, FILES)) == digests(sort_edits(plate_asset(), found, FILES))


def test_what_a_list_was_holds_while_others_grow_from_it() -> None:
    asset, one, other = plate_asset(), edits(30), edits(60)
    first = sort_edits(asset, one, FILES)
    before = digests(first)
    sort_edits(asset, [*one[:10], *other], FILES)
    sort_edits(asset, [*one, *other], FILES)
    assert digests(first) == before and first.material.count == 10 and first.shape.edit(1) is one[3]


def test_a_file_that_was_written_anew_makes_another_list(tmp_path: Path) -> None:
    asset, files = plate_asset(), EditFiles(tmp_path, confine=True)
    painted = [*edits(9), *parse_edits([material({"weights_file": "painted.f32"}, roughness=0.1)]), *edits(9)]
    with pytest.raises(ValueError, match="does not exist"):
        sort_edits(asset, painted, files)
    np.zeros(81, "<f4").tofile(tmp_path / "painted.f32")
    before = digests(sort_edits(asset, painted, files))
    np.zeros(82, "<f4").tofile(tmp_path / "painted.f32")
    after = digests(sort_edits(asset, painted, files))
    assert before[0] != after[0] and before[1:] == after[1:]
    assert after == digests(sort_edits(plate_asset(), painted, files))


def test_the_shared_beginning_is_found_wherever_lists_part() -> None:
    one, other = edits(65), parse_edits([material({"all": True}, metallic=1)])
    for place in range(65):
        assert shared_beginning(one, [*one[:place], *other, *one[place + 1 :]]) == place
        assert shared_beginning(one, one[:place]) == place == shared_beginning(one[:place], tuple(one))
