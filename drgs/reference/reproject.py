"""Slow torch twin of drgs/render/progressive/reproject.py's kernel: one pixel after another, float64; the specification."""

import math

import torch

from drgs.maths.constants import MIN_ROUGHNESS
from drgs.render.progressive.reproject import FACING, GRAZING, LOBE, MOST_SAMPLES, PLANE, SPREAD
from drgs.render.records import DemodulatedLight, GBuffer, History, Reprojected
from drgs.scene.camera import Camera


def reproject(history: History, gbuffer: GBuffer, camera: Camera) -> Reprojected:
    """History in the pixels of the present view, in float64."""
    height, width = gbuffer.coverage.shape
    old_height, old_width = history.gbuffer.coverage.shape
    old = history.gbuffer
    from_world, intrinsics = history.camera.camera_from_world.double(), history.camera.intrinsics.double()
    center = history.camera.center_world.double()
    diffuse, specular = (torch.zeros(height, width, 3, dtype=torch.float64) for _ in range(2))
    variance, samples = (torch.zeros(height, width, 2, dtype=torch.float64) for _ in range(2))
    for row in range(height):
        for column in range(width):
            if gbuffer.coverage[row, column] <= 0:
                continue
            x, n = gbuffer.position_world[row, column].double(), gbuffer.normal_world[row, column].double()
            place = from_world[:3, :3] @ x + from_world[:3, 3]
            on_screen = intrinsics @ place
            u, v = float(on_screen[0] / on_screen[2]) - 0.5, float(on_screen[1] / on_screen[2]) - 0.5
            footprint = float(place[2]) / float(intrinsics[0, 0])
            reach = float(PLANE) * footprint
            towards_old = float(n @ torch.nn.functional.normalize(center - x, dim=0))
            if towards_old <= float(GRAZING):
                continue
            spread = float(SPREAD) * footprint / max(towards_old, 0.25)
            weights = 0.0
            for qy in (math.floor(v), math.floor(v) + 1):
                for qx in (math.floor(u), math.floor(u) + 1):
                    if not (0 <= qx < old_width and 0 <= qy < old_height and old.coverage[qy, qx] > 0):
                        continue
                    if float(n @ old.normal_world[qy, qx].double()) < float(FACING):
                        continue
                    apart = old.position_world[qy, qx].double() - x
                    if abs(float(n @ apart)) > reach or float(torch.linalg.norm(apart)) > spread:
                        continue
                    w = (1 - abs(u - qx)) * (1 - abs(v - qy))
                    diffuse[row, column] += w * history.light.diffuse[qy, qx]
                    specular[row, column] += w * history.light.specular[qy, qx]
                    variance[row, column] += w * history.light.variance[qy, qx]
                    samples[row, column] += w * history.samples[qy, qx]
                    weights += w
            if weights < 0.05:
                for values in (diffuse, specular, variance, samples):
                    values[row, column] = 0
                continue
            for values in (diffuse, specular, variance, samples):
                values[row, column] /= weights
            alpha = max(float(gbuffer.roughness[row, column]), MIN_ROUGHNESS) ** 2
            turned = float(torch.linalg.norm(gbuffer.wo_world[row, column].double() - torch.nn.functional.normalize(center - x, dim=0)))
            samples[row, column] = samples[row, column].clamp(max=MOST_SAMPLES)
            samples[row, column, 1] *= math.exp(-min((float(LOBE) * turned / alpha) ** 2, 80.0))
    return Reprojected(DemodulatedLight(diffuse, specular, variance), samples)
