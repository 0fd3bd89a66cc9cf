"""Features, matches, poses and undistorted pictures by COLMAP. Run as a program of its own, never imported: pycolmap crashes where Pillow was
loaded before it, and what computes for minutes must be stoppable.

Usage: python run_colmap.py JOB.json. The job names the work folder, pictures, cameras and settings; finished steps leave NAME.done in the work folder
and are skipped the next time. On stdout, one JSON object a line: {"step", "done", "total"}. It ends with its stdin, so that it does not outlive who
started it. It knows nothing of drgs.

Same seed, same poses: pictures enter the database in the job's order, every RANSAC has a seed of its own, and the bundle adjustment runs on one thread.
Source: Schönberger and Frahm 2016, "Structure-from-Motion Revisited" (docs/sources.md: schoenberger2016).
"""

import json
import os
import shutil
import sqlite3
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

POLL_SECONDS = 0.5
LEAST_MODEL = 3
"""Pictures of a model that is kept."""
SMALL_SIDE = 1000
"""Pictures up to this size [pixels] are doubled before features are looked for, and fainter ones count: else there are too few."""
FAINT = 0.003
"""Contrast from which a feature counts there, as a share of white; COLMAP's own is 0.0067."""
MORE_PLACED = 0.05
"""Share of the pictures that placing all at once must find a place for beyond what one after the other does."""
MOST_PIXELS_OFF = 2.0
"""Mean reprojection error of all at once [pixels]: beyond it the pictures did not fit together."""


def main() -> None:
    threading.Thread(target=_end_with_stdin, daemon=True).start()
    pycolmap.logging.minloglevel = pycolmap.logging.WARNING.value
    job = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    work = Path(sys.argv[1]).parent
    for step, run in (("features", _extract), ("matches", _match), ("poses", _map), ("undistort", _undistort)):
        marker = work / f"{step}.done"
        if marker.exists():
            continue
        _tell(step, 0, 1)
        started = time.monotonic()
        run(job, work)
        draft = marker.with_suffix(".part")
        draft.write_text(json.dumps({"seconds": round(time.monotonic() - started, 2)}))
        os.replace(draft, marker)


def _extract(job: dict[str, Any], work: Path) -> None:
    """SIFT features of all pictures; one camera for each group."""
    database = work / "database.db"
    for stale in work.glob("database.db*"):
        stale.unlink()
    pycolmap.Database.open(database).close()
    for group in job["groups"]:
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = job["camera_model"]
        if group["focal_pixels"] is not None:
            camera = pycolmap.Camera.create_from_model_name(1, job["camera_model"], group["focal_pixels"], group["width"], group["height"])
            reader.camera_params = ",".join(repr(float(number)) for number in camera.params)
        pycolmap.import_images(database, work / "images", pycolmap.CameraMode.SINGLE, group["files"], reader)
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = job["camera_model"]
    if job["masked"]:
        reader.mask_path = work / "masks"
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.num_threads = job["threads"]
    options.max_image_size = job["feature_side"]
    options.sift.max_num_features = job["most_features"]
    longest = max(max(group["width"], group["height"]) for group in job["groups"])
    if longest <= SMALL_SIDE:
        options.sift.first_octave, options.sift.peak_threshold = -1, FAINT
    else:
        options.sift.first_octave = 0
    files = [file for group in job["groups"] for file in group["files"]]
    with _Polled("features", database, "keypoints", len(files)):
        pycolmap.extract_features(database, work / "images", files, pycolmap.CameraMode.AUTO, reader, options, pycolmap.Device.cpu)
    with pycolmap.Database.open(database) as opened:
        counts = {image.name: opened.num_keypoints_for_image(image.image_id) for image in opened.read_all_images()}
    _write(work / "features.json", counts)


def _match(job: dict[str, Any], work: Path) -> None:
    """Matches of all pairs, or of pictures near each other in the sequence, checked by two-view geometry."""
    database = work / "database.db"
    count = sum(len(group["files"]) for group in job["groups"])
    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu = False
    matching.num_threads = job["threads"]
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = job["seed"]
    if job["matching"] == "exhaustive":
        with _Polled("matches", database, "two_view_geometries", count * (count - 1) // 2):
            pycolmap.match_exhaustive(database, matching, pycolmap.ExhaustivePairingOptions(), verification, pycolmap.Device.cpu)
    else:
        pairing = pycolmap.SequentialPairingOptions()
        pairing.overlap = job["overlap"]
        with _Polled("matches", database, "two_view_geometries", count * pairing.overlap):
            pycolmap.match_sequential(database, matching, pairing, verification, pycolmap.Device.cpu)
    _write(work / "matches.json", _match_report(database))


def _match_report(database: Path) -> dict[str, Any]:
    """How many others each picture agrees with, and how far features move between the pictures of a pair."""
    with pycolmap.Database.open(database) as opened:
        images = {image.image_id: image for image in opened.read_all_images()}
        sides = {camera.camera_id: max(camera.width, camera.height) for camera in opened.read_all_cameras()}
        keypoints = {number: opened.read_keypoints(number)[:, :2] for number in images}
        partners = dict.fromkeys((image.name for image in images.values()), 0)
        moves = []
        for pair, geometry in zip(*opened.read_two_view_geometries(), strict=True):
            inliers = geometry.inlier_matches
            if len(inliers) == 0:
                continue
            first, second = pycolmap.pair_id_to_image_pair(pair)
            partners[images[first].name] += 1
            partners[images[second].name] += 1
            apart = np.linalg.norm(keypoints[first][inliers[:, 0]] - keypoints[second][inliers[:, 1]], axis=1)
            moves.append(float(np.median(apart)) / sides[images[first].camera_id])
    return {"partners": partners, "median_move": float(np.median(moves)) if moves else None}


def _map(job: dict[str, Any], work: Path) -> None:
    """Poses and points; of several models the one with the most pictures. Where pictures are left over, all are placed at once, too, by the rotations
    between pairs: a chain of few matches then need not begin anywhere, nor break."""
    sparse = work / "sparse"
    shutil.rmtree(sparse, ignore_errors=True)
    sparse.mkdir()
    total = sum(len(group["files"]) for group in job["groups"])
    placed = 2

    def next_image() -> None:
        nonlocal placed
        placed += 1
        _tell("poses", min(placed, total), total)

    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size = LEAST_MODEL
    # Several threads would add up in another order each time, and gain little: the solver is a small part on pictures by the hundred.
    options.num_threads = 1
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = job["seed"]
    pycolmap.set_random_seed(job["seed"])
    models = dict(pycolmap.incremental_mapping(work / "database.db", work / "images", sparse, options, next_image_callback=next_image))
    most = max((model.num_reg_images() for model in models.values()), default=0)
    if most <= (1 - MORE_PLACED) * total:
        whole = _all_at_once(job, work, sparse / "at_once")
        if whole is not None and whole.num_reg_images() >= most + MORE_PLACED * total:
            models[max(models, default=-1) + 1] = whole
    sizes = {str(number): model.num_reg_images() for number, model in models.items()}
    if not models:
        _write(work / "model.json", {"models": sizes, "pictures": {}})
        return
    number, model = max(models.items(), key=lambda item: (item[1].num_reg_images(), item[1].num_points3D(), -item[0]))
    points = [model.point3D(point_id) for point_id in sorted(model.point3D_ids())]
    np.savez(
        work / "points.npz",
        positions=np.array([point.xyz for point in points], dtype=np.float64).reshape(-1, 3),
        colors=np.array([point.color for point in points], dtype=np.uint8).reshape(-1, 3),
        errors=np.array([point.error for point in points], dtype=np.float64),
        views=np.array([point.track.length() for point in points], dtype=np.int64),
    )
    pictures = {
        image.name: {"camera": image.camera_id, "camera_from_world": image.cam_from_world().matrix().tolist(), "points": image.num_points3D}
        for image in sorted((model.image(image_id) for image_id in model.reg_image_ids()), key=lambda image: image.name)
    }
    report = {
        "models": sizes,
        "model": str(number),
        "mean_reprojection_error": model.compute_mean_reprojection_error(),
        "cameras": {str(camera_id): _camera(camera) for camera_id, camera in model.cameras.items()},
        "pictures": pictures,
    }
    _write(work / "model.json", report)


def _all_at_once(job: dict[str, Any], work: Path, sparse: Path) -> Any | None:
    """The largest model of global structure from motion (docs/sources.md: pan2024); None without one whose pictures fit together."""
    sparse.mkdir()
    options = pycolmap.GlobalPipelineOptions()
    options.min_model_size = LEAST_MODEL
    options.num_threads, options.random_seed = 1, job["seed"]
    pycolmap.set_random_seed(job["seed"])
    try:
        models = pycolmap.global_mapping(work / "database.db", work / "images", sparse, options)
    except (RuntimeError, ValueError) as error:  # pictures that have places need not lose them
        print(f"placing all pictures at once failed: {error}", file=sys.stderr)
        return None
    model = max(models.values(), key=lambda model: model.num_reg_images(), default=None)
    return model if model is not None and model.compute_mean_reprojection_error() <= MOST_PIXELS_OFF else None


def _undistort(job: dict[str, Any], work: Path) -> None:
    """Pictures and masks as a pinhole camera of the same focal length sees them, cut so that nothing is blank."""
    model = json.loads((work / "model.json").read_text())
    result = work / "undistorted"
    shutil.rmtree(result, ignore_errors=True)
    for part in ("images", "masks"):
        (result / part).mkdir(parents=True)
    options = pycolmap.UndistortCameraOptions()
    options.blank_pixels = 0.0
    pinholes = {}
    for done, (file, picture) in enumerate(model["pictures"].items(), 1):
        told = model["cameras"][str(picture["camera"])]
        camera = pycolmap.Camera.create_from_model_name(1, told["model"], 1.0, told["width"], told["height"])
        camera.params = told["parameters"]
        undistorted, pinhole = pycolmap.undistort_image(options, _bitmap(work / "images" / file, True), camera)
        undistorted.set_jpeg_quality(job["jpeg_quality"])
        undistorted.write(result / "images" / file)
        pinholes[str(picture["camera"])] = _camera(pinhole)
        mask = work / "masks" / f"{file}.png"
        if mask.exists():
            straight, _ = pycolmap.undistort_image(options, _bitmap(mask, False), camera)
            straight.write(result / "masks" / f"{Path(file).stem}.png")
        _tell("undistort", done, len(model["pictures"]))
    _write(work / "pinholes.json", pinholes)


class _Polled:
    """Tells how many rows a table of the database has got, while COLMAP's own threads fill it."""

    def __init__(self, step: str, database: Path, table: str, total: int) -> None:
        self._step, self._database, self._table, self._total = step, database, table, total
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._poll, daemon=True)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *raised: object) -> None:
        self._over.set()
        self._thread.join()

    def _poll(self) -> None:
        while not self._over.wait(POLL_SECONDS):
            try:
                with sqlite3.connect(f"file:{self._database}?mode=ro", uri=True) as connection:
                    (rows,) = connection.execute(f"SELECT COUNT(*) FROM {self._table}").fetchone()
            except sqlite3.Error:  # being written to: the next look will do
                continue
            _tell(self._step, min(rows, self._total), self._total)


def _bitmap(path: Path, as_rgb: bool) -> pycolmap.Bitmap:
    bitmap = pycolmap.Bitmap.read(path, as_rgb)
    if bitmap is None:
        raise ValueError(f"{path}: COLMAP cannot read it")
    return bitmap


def _camera(camera: Any) -> dict[str, Any]:
    return {
        "model": camera.model.name,
        "width": camera.width,
        "height": camera.height,
        "parameter_names": [name.strip() for name in camera.params_info.split(",")],
        "parameters": [float(number) for number in camera.params],
    }


def _tell(step: str, done: int, total: int) -> None:
    print(json.dumps({"step": step, "done": done, "total": total}), flush=True)


def _write(path: Path, document: dict[str, Any]) -> None:
    path.write_text(json.dumps(document), encoding="utf-8")


def _end_with_stdin() -> None:
    while os.read(0, 1):  # not sys.stdin, whose lock Python wants at its end
        pass
    os._exit(1)


if __name__ == "__main__":
    main()
    sys.stdout.flush()
    os._exit(0)  # COLMAP's modules do not always survive being torn down
