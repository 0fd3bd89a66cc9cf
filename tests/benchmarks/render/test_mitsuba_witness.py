"""Mitsuba's pictures beside ours: the same mesh, camera and turned light, where Mitsuba is at hand."""

import numpy as np
import pytest
import torch

from benchmarks.measures.swap_parts import swapped_picture
from benchmarks.render._mitsuba import mitsuba_picture
from drgs.evaluate.metrics import on_white
from drgs.render.intersect.trace_rays import build_tracer
from drgs.scene.environment import Environment, rotate_environment
from tests.render.closed_form_scenes import front_camera, sphere_mesh

SIZE, TURN = 48, 90.0


def test_a_witness_sees_what_we_see_under_a_turned_light():
    pytest.importorskip("mitsuba", reason="needs the package mitsuba (docs/performance.md)")
    mesh, camera = sphere_mesh(subdivisions=4), front_camera(SIZE)
    radiance = torch.full((16, 32, 3), 0.1)
    radiance[4:8, 2:10] = torch.tensor([4.0, 2.0, 1.0])
    light = Environment(radiance)
    try:
        theirs = mitsuba_picture(mesh, light.radiance.numpy(), camera, 64, 1, TURN)
    except ValueError as error:
        pytest.skip(str(error))
    pictures = {}
    for degrees in (TURN, -TURN):
        tracer = build_tracer(mesh)
        pictures[degrees] = swapped_picture(tracer, tracer, rotate_environment(light, degrees), camera, 128, 1)
    error = {degrees: np.abs(on_white(ours) - on_white(theirs)).mean() for degrees, ours in pictures.items()}
    assert error[TURN] < 0.02 < 0.1 < error[-TURN], "turned the other way it is another picture"
    assert np.abs(pictures[TURN][..., 3] - theirs[..., 3]).mean() < 0.02
