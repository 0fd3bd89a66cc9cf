"""Whether the light stood still with the object or with the camera: on a turntable the object turns, lamps and camera stay where they are.

In the object's frame such light turns with the camera, so no environment fixed to the object explains it. Two signs together say so, and each alone
could be something else: what is around the object looks the same in all pictures though these were taken from all sides (so would plain paper
that somebody walks around), and brightness follows where a place faces in the camera's frame rather than what it mirrors in the object's (so it
seems where the hull is far from the surface). Pictures that were cut out say nothing of what was around; where brightness follows the camera
there, both have to be tried (fit/surfels/try_light_frames).

In: a capture, its views, points with normals. Out: LightFound; `with_light_of_camera` turns the light of Views.
"""

from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from PIL import Image
from scipy.ndimage import binary_erosion

from drgs.exchange.pictures import as_eight_bits
from drgs.maths.color import linear_from_srgb, luminance
from drgs.reconstruct.capture.initial_points import InitialPoints, project_points
from drgs.reconstruct.capture.load_views.capture import Capture
from drgs.reconstruct.capture.load_views.read_pictures import mask_channel
from drgs.scene.asset import LightFrame
from drgs.scene.views import Views

LightChoice = Literal["auto", "object", "camera"]
"""What the light stood still with, as a user says it; auto: it is asked of the pictures."""
LIGHT_CHOICES: tuple[LightChoice, ...] = get_args(LightChoice)
SIDE = 64
"""At which what is around the object is compared [pixels]."""
CLEAR = 3
"""Pixels of these between the mask and what is compared: shadows, and masks that are a little off."""
FEWEST_SEEN = 8
"""Pictures that show a place around the object."""
LEAST_SURROUNDINGS = 0.1
"""Share of the picture."""
ALIKE = 0.03
"""Median difference of what is around the object, of display values 0..1, up to which it is the same: a room differs by 0.1 to 0.3, white
paper on a turntable by 0.016 (tankard)."""
FEWEST_VIEWS = 8
WIDEST_APART = 60.0
"""[degrees] between viewing directions: from less far apart the surroundings look alike anyway."""
FACING = 0.3
DARKEST, BRIGHTEST = 0.02, 0.98
"""Display values that are compared."""
COMPARED_POINTS = 3000
CLEARER = 0.015
"""Share of the differences by which the camera's frame must explain more than the object's."""
REWEIGHTINGS = 5


@dataclass(frozen=True)
class LightFound:
    """What the light stood still with, and why that is thought."""

    frame: LightFrame
    why: str
    """A clause that may follow `because`."""
    surroundings_differ: float | None = None
    """Of display values 0..1; None: they are not to be seen."""
    explained_by_object: float | None = None
    explained_by_camera: float | None = None
    """Share of the differences between pictures of a place, by what is mirrored in the object's frame and by what faces where in the camera's."""
    wants_trial: bool = False
    """It may be the camera's all the same: brightness says so, and what is around the object is not to be seen."""


def with_light_of_camera(views: Views) -> Views:
    """The same under light that stands still with the camera; its table is that of the first view."""
    rotations = [camera.camera_from_world[:3, :3].double() for camera in views.cameras]
    return replace(views, light_from_world=tuple((rotations[0].T @ rotation).float() for rotation in rotations))


def light_found(capture: Capture, views: Views, points: InitialPoints) -> LightFound:
    """What the pictures say.

    Args:
        views: of the capture, of any size. points: with normals, or nothing is said.
    """
    axes = torch.stack([camera.camera_from_world[2, :3] for camera in views.cameras])
    apart = float(torch.rad2deg(torch.acos((axes @ axes.T).clamp(-1, 1))).max())
    if len(views.cameras) < FEWEST_VIEWS or apart < WIDEST_APART:
        return LightFound("object", "the pictures were taken from one side")
    differ, unseen = _surroundings_differ(capture), "the pictures do not show what is around the object"
    if differ is not None and differ > ALIKE:
        return LightFound(
            "object", f"what is around the object changes from picture to picture (by {differ:.2f} of full brightness)", differ
        )
    if points.normals_world is None or not views.has_masks:
        return LightFound("object", unseen if differ is None else "nothing is known of the object's shape yet", differ)
    explained = {frame: _explained(views, points, frame) for frame in ("object", "camera")}
    figures = (differ, explained["object"], explained["camera"])
    shares = f"{explained['camera']:.3f} of the differences between pictures of a place follow the camera and {explained['object']:.3f} the object"
    follows_camera = explained["camera"] >= explained["object"] + CLEARER
    if differ is None:
        return LightFound("object", f"{unseen}, and {shares}" if follows_camera else unseen, *figures, wants_trial=follows_camera)
    if not follows_camera:
        return LightFound("object", f"{shares}, though what is around the object stays the same", *figures)
    return LightFound("camera", f"what is around the object stays the same while it turns, and {shares}", *figures)


def _surroundings_differ(capture: Capture) -> float | None:
    """Median over pictures, mean over places around the object; None where pictures are cut out, of several sizes, or full of object."""
    if len({photograph.size_on_disc for photograph in capture.photographs}) > 1:
        return None
    if any(photograph.mask is None or photograph.mask_is_depth for photograph in capture.photographs):
        return None
    shown = []
    for photograph in capture.photographs:
        assert photograph.mask is not None
        with Image.open(photograph.image) as image:
            picture = as_eight_bits(image)
            if "A" in picture.getbands() or "transparency" in picture.info:
                return None
            picture = picture.convert("L")
        mask = Image.fromarray(mask_channel(photograph.mask))
        grey, cover = (np.asarray(image.resize((SIDE, SIDE), Image.Resampling.BOX)) for image in (picture, mask))
        around = binary_erosion(cover == 0, iterations=CLEAR, border_value=1)
        shown.append(np.where(around, grey / 255, np.nan))
    values = np.stack(shown)
    seen = np.isfinite(values).sum(0) >= FEWEST_SEEN
    if seen.mean() < LEAST_SURROUNDINGS:
        return None
    values = values[:, seen]
    usual = np.nanmedian(values, 0)
    if np.median(usual) < DARKEST:  # painted black: cut out as well
        return None
    # Exposures differ, too.
    compared = [np.isfinite(row) & (usual > DARKEST) for row in values]
    gains = np.array([np.median(row[ok] / usual[ok]) if ok.any() else 1.0 for row, ok in zip(values, compared, strict=True)])
    return float(np.nanmedian(np.abs(values / gains[:, None].clip(0.1) - usual), 0).mean())


def _explained(views: Views, points: InitialPoints, frame: LightFrame) -> float:
    """Share of the differences of logarithmic brightness between pictures of one point, by harmonics in a frame, beyond exposure and grazing."""
    assert points.normals_world is not None
    every = slice(None, None, 1 + len(points.points_world) // COMPARED_POINTS)
    places, normals = points.points_world[every], points.normals_world[every]
    parts: list[tuple[ndarray, ...]] = []
    for number, (camera, image, coverage) in enumerate(zip(views.cameras, views.images_srgb, views.coverage, strict=True)):
        column, row, seen, _ = project_points(camera, places.numpy())
        towards = torch.nn.functional.normalize(camera.center_world - places, dim=1)
        cosine = (towards * normals).sum(1)
        seen &= (coverage.numpy()[row, column] > 200) & (cosine > FACING).numpy()
        color = image[torch.from_numpy(row[seen]), torch.from_numpy(column[seen])].float() / 255
        index = np.flatnonzero(seen)[((color > DARKEST) & (color < BRIGHTEST)).all(1).numpy()]
        color = image[torch.from_numpy(row[index]), torch.from_numpy(column[index])].float() / 255
        normal, wo, facing = normals[index], towards[index], cosine[index, None]
        mirrored = 2 * facing * normal - wo
        if frame == "camera":
            turn = camera.camera_from_world[:3, :3].T
            own = [_harmonics((normal @ turn).numpy()), _harmonics((mirrored @ turn).numpy())]
        else:  # of where a place faces nothing changes from picture to picture
            own = [_harmonics(mirrored.numpy())]
        exposures = np.eye(len(views.cameras))[[number] * len(index)]
        alike = np.concatenate([facing.numpy(), facing.numpy() ** 2, exposures], 1)
        parts.append((index, luminance(linear_from_srgb(color)).log().numpy(), alike, np.concatenate([alike, *own], 1)))
    index, brightness, common, features = (np.concatenate(part) for part in zip(*parts, strict=True))
    if len(index) == 0:
        return 0.0
    differences = _without_means(index, brightness[:, None])[:, 0]
    left_before, left = (_left_by_fit(_without_means(index, values), differences) for values in (common, features))
    return float(1 - left / max(left_before, 1e-9))


def _harmonics(direction: Float[ndarray, "seen 3"]) -> Float[ndarray, "seen 15"]:
    """Polynomials that span the harmonics of degrees 1 to 3."""
    x, y, z = direction.T.astype(np.float64)
    first, second = [x, y, z], [x * y, y * z, x * z, x * x - y * y, 3 * z * z - 1]
    third = [x**3 - 3 * x * y * y, 3 * x * x * y - y**3, x * z * z, y * z * z, z**3, x * y * z, z * (x * x - y * y)]
    return np.stack([*first, *second, *third], 1)


def _without_means(index: Int[ndarray, "seen"], values: Float[ndarray, "seen k"]) -> Float[ndarray, "seen k"]:
    """Less the mean over the pictures of the same point."""
    sums = np.zeros((index.max() + 1, values.shape[1]))
    np.add.at(sums, index, values)
    return values - (sums / np.maximum(np.bincount(index), 1)[:, None])[index]


def _left_by_fit(features: Float[ndarray, "seen k"], wanted: Float[ndarray, "seen"]) -> float:
    """Mean absolute error of a linear fit that counts what it misses widely less and less (Cauchy's weights)."""
    weight, error = np.ones(len(wanted)), wanted
    for _ in range(REWEIGHTINGS):
        weighted = features * weight[:, None]
        held = weighted.T @ features + 1e-3 * len(wanted) / 1e3 * np.eye(features.shape[1])
        error = wanted - features @ np.linalg.solve(held, weighted.T @ wanted)
        spread = 1.48 * float(np.median(np.abs(error))) + 1e-6
        weight = 1 / (1 + (error / (2 * spread)) ** 2)
    return float(np.abs(error).mean())
