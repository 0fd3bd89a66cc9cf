"""One sentence for each way in which pictures cannot be posed."""

from pathlib import Path

import numpy as np
import pytest

from drgs.reconstruct.pose.explain_failure import check_baseline, check_depth, check_features, check_placed, reasons_left_out
from drgs.reconstruct.pose.prepare_photos import PreparedPhoto

PHOTOS = Path("photos")


def prepared(count: int, has_mask: bool = False) -> list[PreparedPhoto]:
    return [PreparedPhoto(str(number), f"{number}.png", has_mask, 80, 60, None, 100.0, "") for number in range(count)]


def test_each_left_out_picture_has_a_reason():
    features = {f"{number}.png": 1000 for number in range(10)} | {"7.png": 12}
    partners = {f"{number}.png": 5 for number in range(10)} | {"8.png": 0}
    reasons = reasons_left_out(prepared(10), {f"{number}.png" for number in range(7)}, features, partners, ["7", "1"])
    assert reasons == {
        "7": "no features, 12 where 60 are needed, and it is blurred",
        "8": "no matches, no other picture shows the same",
        "9": "not registered, 5 other pictures match it but its place does not follow from them",
    }


def test_too_few_placed_pictures_say_why_and_what_helps():
    reasons = {str(number): "no matches, no other picture shows the same" for number in range(9)}
    check_placed(PHOTOS, 12, 20, reasons, [], 0.6)
    with pytest.raises(ValueError) as raised:
        check_placed(PHOTOS, 11, 20, reasons, ["3"], 0.6)
    assert str(raised.value).startswith(
        "photos: 11 of 20 pictures could be placed, expected at least 12 (no matches: 0, 1, 2, 3, 4, 5 and 3 more). 1 are blurred (3). Take more"
    )


def test_masked_pictures_with_few_features_are_advised_to_show_their_surroundings():
    check_features(PHOTOS, prepared(10, True), {f"{number}.png": 100 for number in range(6)}, 0.6)
    with pytest.raises(
        ValueError, match=r"5 of 10 pictures have fewer than 60 features inside their masks \(5, 6, 7, 8, 9\).*without masks"
    ):
        check_features(PHOTOS, prepared(10, True), {f"{number}.png": 100 for number in range(5)}, 0.6)


def test_pictures_from_one_place_are_told_to_be_so():
    check_baseline(PHOTOS, None)
    check_baseline(PHOTOS, 0.02)
    with pytest.raises(ValueError, match=r"moves by 0\.10 % of their width"):
        check_baseline(PHOTOS, 0.001)
    poses = np.tile(np.eye(4), (8, 1, 1))
    poses[:, 0, 3] = np.linspace(0, 0.05, 8)
    points = np.tile([0.0, 0.0, 5.0], (10, 1))
    with pytest.raises(ValueError, match=r"within 0\.33 % of their distance from what they see, expected more than 2 %"):
        check_depth(PHOTOS, poses, points)
    poses[:, 0, 3] *= 30
    check_depth(PHOTOS, poses, points)
