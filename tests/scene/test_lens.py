"""COLMAP's camera models, held against COLMAP itself by numbers it gave."""

import numpy as np
import pytest

from drgs.scene.lens import PARAMETER_NAMES, Lens, pixels_from_plane

PLANE = ((0.1, -0.05), (-0.6, 0.4), (0.9, 0.8), (-0.7, -1.1))
REFERENCE = {
    "SIMPLE_PINHOLE": ((500, 310, 250), ((360.000000000, 225.000000000), (10.000000000, 450.000000000), (760.000000000, 650.000000000), (-40.000000000, -300.000000000))),
    "PINHOLE": ((500, 480, 310, 250), ((360.000000000, 226.000000000), (10.000000000, 442.000000000), (760.000000000, 634.000000000), (-40.000000000, -278.000000000))),
    "SIMPLE_RADIAL": ((500, 310, 250, -0.12), ((359.925000000, 225.037500000), (28.720000000, 437.520000000), (681.700000000, 580.400000000), (31.400000000, -187.800000000))),
    "RADIAL": ((500, 310, 250, -0.12, 0.03), ((359.925234375, 225.037382812), (26.286400000, 439.142400000), (710.083750000, 605.630000000), (1.055000000, -235.485000000))),
    "OPENCV": ((500, 480, 310, 250, -0.12, 0.03, 0.004, -0.003), ((359.856484375, 226.083887500), (23.466400000, 433.880704000), (708.358750000, 594.572800000), (0.115000000, -210.372800000))),
    "OPENCV_FISHEYE": ((500, 480, 310, 250, -0.05, 0.02, -0.006, 0.001), ((359.762503948, 226.113998105), (54.453870841, 413.549522662), (628.496092874, 521.783332586), (71.583757558, -109.667931455))),
    "FULL_OPENCV": ((500, 480, 310, 250, 0.3, -0.1, 0.004, -0.003, 0.02, 0.25, -0.04, 0.01), ((359.961936522, 226.033270469), (4.186377212, 446.219918585), (750.311215905, 630.372237572), (-30.822814513, -257.044703036))),
    "FOV": ((500, 480, 310, 250, 0.9), ((363.465498778, 224.336560586), (28.725924158, 430.015408539), (667.412515109, 554.992012893), (41.620436577, -154.869741393))),
    "SIMPLE_RADIAL_FISHEYE": ((500, 310, 250, -0.06), ((359.756178694, 225.121910653), (56.173601231, 419.217599180), (622.858997485, 528.096886654), (76.370099557, -117.132700696))),
    "RADIAL_FISHEYE": ((500, 310, 250, -0.06, 0.01), ((359.756255217, 225.121872392), (55.777629343, 419.481580438), (624.806175348, 529.827711420), (74.634030798, -119.860808746))),
    "THIN_PRISM_FISHEYE": ((500, 480, 310, 250, -0.05, 0.02, 0.004, -0.003, -0.006, 0.001, 0.005, -0.002), ((359.725313483, 226.149700951), (53.312943067, 414.904224272), (629.505662888, 522.727014873), (73.219324816, -107.661372084))),
    "RAD_TAN_THIN_PRISM_FISHEYE": ((500, 480, 310, 250, 0.1, -0.05, 0.02, -0.01, 0.003, -0.0005, 0.004, -0.003, 0.002, -0.001, 0.003, -0.0007), ((359.946447825, 226.043511524), (44.555870039, 420.569462133), (658.474717395, 545.241540682), (52.206941011, -142.776090530))),
    "SIMPLE_DIVISION": ((500, 310, 250, -0.15), ((359.906599923, 225.046700038), (30.335221034, 436.443185977), (690.151137708, 587.912122407), (20.895168384, -204.307592540))),
    "DIVISION": ((500, 480, 310, 250, 0.1), ((360.062656740, 225.969924765), (-7.469754467, 453.180642859), (856.091960592, 715.998473038), (-137.088533140, -424.464987138))),
    "SIMPLE_FISHEYE": ((500, 310, 250), ((359.793215350, 225.103392325), (50.086679803, 423.275546798), (638.022727015, 541.575757346), (63.969895354, -136.618735873))),
    "FISHEYE": ((500, 480, 310, 250), ((359.793215350, 226.099256632), (50.086679803, 416.344524926), (638.022727015, 529.912727053), (63.969895354, -121.153986438))),
    "EUCM": ((500, 480, 310, 250, 0.6, 1.1), ((359.795295674, 226.098258076), (49.645833000, 416.626666880), (639.298759658, 531.001608241), (62.905907847, -122.759087591))),
}  # fmt: skip
"""Parameters, and where PLANE's points (x, y, 1) fall on a picture of 640x480, by pycolmap 4.2.1:

python -c "import pycolmap; print(pycolmap.Camera(model=MODEL, width=640, height=480, params=PARAMETERS).img_from_cam(POINTS))"
"""


def test_every_model_is_compared():
    assert set(REFERENCE) == set(PARAMETER_NAMES)


@pytest.mark.parametrize("model", REFERENCE)
def test_a_model_projects_as_colmap_does(model: str):
    parameters, pixels = REFERENCE[model]
    lens = Lens(model, tuple(map(float, parameters)), 640, 480)
    assert len(parameters) == len(PARAMETER_NAMES[model])
    np.testing.assert_allclose(pixels_from_plane(lens, np.array(PLANE)), np.array(pixels), rtol=0, atol=1e-8)


@pytest.mark.parametrize("model", REFERENCE)
def test_the_middle_of_a_lens_is_its_principal_point(model: str):
    lens = Lens(model, tuple(map(float, REFERENCE[model][0])), 640, 480)
    np.testing.assert_array_equal(pixels_from_plane(lens, np.zeros((3, 2, 2))), np.broadcast_to([310.0, 250.0], (3, 2, 2)))


@pytest.mark.parametrize("model", REFERENCE)
def test_without_coefficients_only_fisheyes_bend(model: str):
    bending = len(Lens(model, REFERENCE[model][0], 640, 480).coefficients)
    straight = Lens(model, (*REFERENCE[model][0][: len(PARAMETER_NAMES[model]) - bending], *[0.0] * bending), 640, 480)
    assert straight.is_pinhole == ("FISHEYE" not in model)
    if straight.is_pinhole:
        (fx, fy), (cx, cy) = straight.focal_lengths, straight.principal_point
        expected = np.array(PLANE) * (fx, fy) + (cx, cy)
        np.testing.assert_allclose(pixels_from_plane(straight, np.array(PLANE)), expected, atol=1e-9)
