"""The doctor on cameras: intrinsics, how large the world is, and from where the object is seen."""

import math
from collections.abc import Sequence

import numpy as np
import torch

from drgs.evaluate.doctor.findings import Finding, Section, few
from drgs.reconstruct.capture.initial_points import InitialPoints, project_points
from drgs.reconstruct.capture.load_views.capture import Capture
from drgs.scene.views import Views

WIDE_GAP = 50.0
"""[degrees] a direction this far from every camera is not reconstructed, but guessed."""
ONE_SIDE = 60.0
"""[degrees] between the mean direction of all cameras, as seen from the object, and the farthest: within lies a quarter of all directions."""
TILTED_UP = 30.0
"""[degrees]"""
MOST_ZOOM = 3.0
"""Factor between a picture's focal length (over its longer side) and the capture's median: a zoom lens has 24 to 70 mm, a factor of 2.9."""


def looking_away(views: Views, points: InitialPoints) -> list[str]:
    """Names of pictures in which no point of the object's hull, or of its bounding sphere, can be."""
    if points.hull_vertices is not None:
        vertices = points.hull_vertices.numpy()[:: 1 + len(points.hull_vertices) // 2000]
        return [camera.name for camera in views.cameras if not project_points(camera, vertices)[2].any()]
    away = []
    for camera in views.cameras:
        offset = points.bounds_center - camera.center_world
        distance = float(offset.norm().clamp(min=torch.finfo(torch.float32).tiny))
        towards = math.acos(max(-1.0, min(1.0, float(camera.camera_from_world[2, :3] @ offset) / distance)))
        reach = math.asin(min(1.0, points.bounds_radius / distance))
        half_diagonal = math.atan(
            math.hypot(camera.width / float(camera.intrinsics[0, 0]), camera.height / float(camera.intrinsics[1, 1])) / 2
        )
        if towards - reach > half_diagonal:
            away.append(camera.name)
    return away


def intrinsics(capture: Capture, away: Sequence[str]) -> Section:
    """Focal lengths, principal points and lenses; `away`: pictures that cannot show the object."""
    pinholes = [photograph.pinhole for photograph in capture.photographs]
    focal = np.array([[pinhole.fx, pinhole.fy] for pinhole in pinholes])
    offset = np.array([[pinhole.cx - pinhole.width / 2, pinhole.cy - pinhole.height / 2] for pinhole in pinholes])
    size = np.array([[pinhole.width, pinhole.height] for pinhole in pinholes])
    angle = float(np.degrees(2 * np.arctan(0.5 * size[:, 0] / focal[:, 0])).mean())
    findings = []
    relative = focal[:, 0] / size.max(1)
    spread = float(relative.max() / relative.min())
    factor = relative / np.median(relative)
    odd = [photo.name for photo, times in zip(capture.photographs, factor, strict=True) if max(times, 1 / times) > MOST_ZOOM]
    if odd:
        findings.append(
            Finding(
                "warning",
                f"Focal lengths of {len(odd)} of {len(pinholes)} pictures ({few(odd)}) are more than {MOST_ZOOM:.0f} times longer or shorter than "
                "those of the others.",
                "Check their fl_x, or camera_angle_x, in the camera file.",
                tuple(odd),
                "focal length",
            )
        )
    elif spread > 1.05:
        findings.append(
            Finding("info", f"Focal lengths differ by {100 * (spread - 1):.0f} % between views (zoom, or a calibration per picture).")
        )
    aspect = float(np.abs(focal[:, 0] / focal[:, 1] - 1).max())
    if aspect > 0.05:
        findings.append(
            Finding(
                "warning",
                f"Pixels are {100 * aspect:.0f} % off square, which real cameras' are not.",
                "Check fl_x and fl_y of the camera file.",
            )
        )
    shift = float((np.abs(offset) / size).max())
    if shift > 0.2:
        findings.append(
            Finding(
                "warning",
                f"The principal point is {100 * shift:.0f} % of the picture off its middle.",
                "Check cx and cy, unless pictures were cropped.",
            )
        )
    if away:
        findings.append(
            Finding(
                "warning",
                f"{len(away)} of {len(pinholes)} cameras look away from the object ({few(away)}).",
                "Check their poses, or leave these pictures out.",
                tuple(away),
                "looks away",
            )
        )
    bent = [photograph.lens.model for photograph in capture.photographs if photograph.lens is not None]
    if bent:
        models = ", ".join(sorted(set(bent)))
        findings.append(Finding("info", f"{len(bent)} pictures are undistorted before anything else ({models})."))
    summary = {
        "model": "pinhole",
        "undistorted_pictures": len(bent),
        "focal_pixels": [round(float(focal.min()), 2), round(float(focal.max()), 2)],
        "field_of_view_degrees": round(angle, 2),
        "principal_point_offset_pixels": [round(float(value), 2) for value in offset.mean(0)],
    }
    return summary, findings


def scale(views: Views, points: InitialPoints) -> Section:
    """How far the cameras are, and which way is up."""
    centers = torch.stack([camera.center_world for camera in views.cameras])
    distance = (centers - points.bounds_center).norm(dim=1)
    findings = []
    if float(distance.min()) < points.bounds_radius:
        findings.append(
            Finding(
                "warning",
                "A camera lies inside the object's bounding sphere.",
                "Check the poses' scale against the points, or mask the background.",
            )
        )
    up = torch.stack([-camera.camera_from_world[1, :3] for camera in views.cameras]).mean(0)
    x, y, z = (up / up.norm().clamp(min=1e-6)).tolist()
    tilt = float(torch.rad2deg(torch.acos((up[2] / up.norm().clamp(min=1e-6)).clamp(-1, 1))))
    if tilt > TILTED_UP:
        findings.append(
            Finding(
                "warning",
                f"The cameras' mean upward direction is {tilt:.0f} degrees off the world's z axis.",
                f"Environments have z up: turn the world upright by --up {x:.3f} {y:.3f} {z:.3f} (in the viewer: up as held).",
            )
        )
    decimals = max(5, 4 - math.floor(math.log10(points.bounds_radius)))  # whatever the capture's unit
    summary = {
        "bounds_center": [round(float(value), decimals) for value in points.bounds_center],
        "bounds_radius": round(points.bounds_radius, decimals),
        "camera_distance": [round(float(distance.min()), decimals), round(float(distance.max()), decimals)],
        "up_tilt_degrees": round(tilt, 1),
    }
    return summary, findings


def directions(views: Views, points: InitialPoints) -> Section:
    """From where the object is seen, and from where it is not."""
    centers = torch.stack([camera.center_world for camera in views.cameras]).double().numpy()
    toward = centers - points.bounds_center.double().numpy()
    toward /= np.maximum(np.linalg.norm(toward, axis=1, keepdims=True), 1e-12)
    elevation = np.degrees(np.arcsin(np.clip(toward[:, 2], -1, 1)))
    azimuth = np.sort(np.degrees(np.arctan2(toward[:, 1], toward[:, 0])))
    gaps = np.diff(np.append(azimuth, azimuth[0] + 360))
    widest = int(gaps.argmax())
    middle = (azimuth[widest] + gaps[widest] / 2 + 180) % 360 - 180
    k = np.arange(2000) + 0.5
    z, around = 1 - 2 * k / 2000, np.pi * (1 + 5**0.5) * k
    probes = np.stack([np.sqrt(1 - z * z) * np.cos(around), np.sqrt(1 - z * z) * np.sin(around), z], -1)
    nearest = np.degrees(np.arccos(np.clip(probes @ toward.T, -1, 1))).min(1)
    middle_direction = toward.mean(0) / max(float(np.linalg.norm(toward.mean(0))), 1e-12)
    within = float(np.degrees(np.arccos(np.clip(toward @ middle_direction, -1, 1))).max())
    one_sided = within < ONE_SIDE
    findings = []
    if one_sided:
        findings.append(
            Finding(
                "warning",
                f"All pictures are taken from one side, within {within:.0f} degrees of the direction between them.",
                "Take pictures from all around: the other side's shape and material will be guessed.",
            )
        )
    elif gaps[widest] > WIDE_GAP:
        findings.append(
            Finding(
                "warning",
                f"No view from azimuths within {gaps[widest] / 2:.0f} degrees of {middle:.0f}.",
                "Add pictures from there: that side's shape and material will be guessed.",
            )
        )
    for name, pole, sentence in (("above", 1.0, "the top"), ("below", -1.0, "the underside")):
        if not one_sided and np.degrees(np.arccos(np.clip(pole * toward[:, 2], -1, 1))).min() > 90 - 15:
            findings.append(
                Finding(
                    "info",
                    f"No view from {name} (nearest elevation {elevation.max() if pole > 0 else elevation.min():.0f} degrees): {sentence} is guessed.",
                )
            )
    summary = {
        "elevation_degrees": [round(float(elevation.min()), 1), round(float(elevation.max()), 1)],
        "widest_azimuth_gap_degrees": round(float(gaps[widest]), 1),
        "widest_azimuth_gap_at_degrees": round(float(middle), 1),
        "sphere_within_30_degrees_of_a_view": round(float((nearest < 30).mean()), 4),
    }
    return summary, findings
