"""COLMAP's mappers, tried from strict to loose until most images are registered, and whether their models agree with the matches.

Runs in the child process only.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from fieldfuse.camera import OPENCV, Intrinsics
from fieldfuse.errors import PoseError
from fieldfuse.files import remove
from fieldfuse.poses.child import alive
from fieldfuse.poses.database import MIN_INLIERS, Report, keypoints_of, opened
from fieldfuse.poses.job import GLOBAL, GONE_FAR, GONE_ON, IN_PARTS, LOOSE, PART, STRICT, TOLERANCE, Job
from fieldfuse.poses.points import epipolar_distance

SMALL_ANGLE, TINY_ANGLE = 1.0, 0.25  # degrees between rays that a point needs in a looser attempt, and in the last that adds images
LEFT_OUT, LEFT_OUT_SHARE = 3, 0.02  # images without a place, and share of all, that are worth that last one
WORSE = 1.25  # times the error of the strict model that a model which went on from it may have
LARGE = 2000  # images beyond which parts of them are mapped first: one after the other gets slower with each
SHARED = 100  # images that a part of them shares with the next
PARTS_ENOUGH = 0.9  # share of registered images below which such a model is not used, and all are mapped in one piece
ENOUGH = 0.6  # share of registered images below which a looser attempt is worth its time
FEW_POINTS = 12  # an image that sees fewer of the model's points hangs in the air: not registered
SMALLEST = 3  # registered images that make a model
MAX_ERROR = 3.0  # pixels; the mean reprojection error of a model that can be trusted
ADJUSTED_AFTER = 1.4  # times the images or points of the last time, after which all are adjusted again
STEP_TOLERANCE = 1e-5  # share of the error by which an adjustment has to get better to go on, while mapping …
LAST_TOLERANCE, LAST_STEPS = 1e-9, 30  # … and at the end; a point that flees to infinity would go on for ever
ANGLE_SAMPLE = 2000  # points looked at for the triangulation angle


@dataclass
class Model:
    """One reconstruction, and the attempt that made it."""

    reconstruction: pycolmap.Reconstruction
    attempt: str
    registered: list[int]  # image ids that see enough points

    @property
    def error(self) -> float:
        """Mean reprojection error in pixels."""
        return float(self.reconstruction.compute_mean_reprojection_error())

    @property
    def size(self) -> tuple[int, int]:
        return len(self.registered), self.reconstruction.num_points3D()


def map_images(job: Job, report: Report) -> tuple[Model | None, list[dict[str, Any]]]:
    """The largest trustworthy model in a settled frame, and what every attempt gave: `{"attempt", "models": [frames, …]}`, largest
    first."""
    attempts: list[tuple[str, Callable[[], list[pycolmap.Reconstruction]]]] = [
        (IN_PARTS, lambda: _in_parts(job, report) if len(job.images) > LARGE and not job.rigged else []),
        (STRICT, lambda: _incremental(job, report)),
        (GONE_ON, lambda: [] if best is None else _incremental(job, report, SMALL_ANGLE, best.reconstruction)),
        (GONE_FAR, lambda: [] if best is None else _incremental(job, report, TINY_ANGLE, best.reconstruction)),
        (LOOSE, lambda: _incremental(job, report, SMALL_ANGLE)),
        (GLOBAL, lambda: [] if job.rigged else _global(job, report)),
    ]
    best: Model | None = None
    history = []
    for name, attempt in attempts:
        if best is not None and best.size[0] >= _enough(name, len(job.images)):
            continue
        models = sorted((Model(found, name, _registered(found)) for found in attempt()), key=lambda model: model.size, reverse=True)
        models = [model for model in models if len(model.registered) >= SMALLEST]
        if name == IN_PARTS and not models:
            continue
        history.append({"attempt": name, "models": [len(model.registered) for model in models]})
        for model in models:
            if model.error <= MAX_ERROR * max(1.0, job.tolerance / TOLERANCE) and (best is None or _better(model, best)):
                best = model
    if best is not None:
        settle(best)
    return best, history


def joined(job: Job, model: Model, report: Report) -> Model | None:
    """The model, gone on from by COLMAP's own rules with what the job's images match besides; None where nothing sound comes of it."""
    found = [Model(one, STRICT, _registered(one)) for one in _incremental(job, report, None, model.reconstruction)]
    best = max(found, key=lambda one: one.size, default=None)
    if best is None or len(best.registered) < SMALLEST or best.error > MAX_ERROR:
        return None
    settle(best)
    return best


def many(images: int) -> float:
    """Images without a place that are worth another attempt."""
    return max(LEFT_OUT, LEFT_OUT_SHARE * images)


def _enough(attempt: str, images: int) -> float:
    """Registered images from which an attempt is not worth its time."""
    if attempt == GONE_ON:
        return images
    if attempt == STRICT:
        return PARTS_ENOUGH * images
    if attempt == GONE_FAR:
        return images - many(images) + 0.5
    return ENOUGH * images


def _better(model: Model, best: Model) -> bool:
    """Whether a looser attempt is worth it. One from scratch has to find clearly more: a few frames on top come at the price of accuracy.
    One that went on left the others where they were."""
    if model.attempt in (GONE_ON, GONE_FAR):
        return model.size[0] > best.size[0] and model.error <= WORSE * best.error
    return model.size[0] > 1.1 * best.size[0]


def _registered(reconstruction: pycolmap.Reconstruction) -> list[int]:
    """Ids of the images that see enough points; of a rig's, together."""
    out = list[int]()
    for frame_id in reconstruction.reg_frame_ids():
        images = [reconstruction.image(data.id) for data in reconstruction.frame(frame_id).image_ids]
        if sum(image.num_points3D for image in images) >= FEW_POINTS:
            out += [image.image_id for image in images]
    return sorted(out)


def _options(job: Job, angle: float | None = None) -> pycolmap.IncrementalPipelineOptions:
    """COLMAP's own rules, or with `angle` (degrees that a point needs) looser ones."""
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = job.repeating
    options.random_seed = job.seed
    options.extract_colors = False  # images may be frames of a video or turned: the points are coloured later where needed
    options.min_model_size = SMALLEST
    options.max_num_models = 10
    options.mapper.num_threads = options.num_threads
    options.mapper.random_seed = job.seed
    options.triangulation.random_seed = job.seed
    # COLMAP would go on to the last bit after every few images, and find the same in twice the time (docs/measured/performance.md).
    options.ba_global_frames_ratio = options.ba_global_points_ratio = ADJUSTED_AFTER
    if job.tolerance > TOLERANCE:
        options.mapper.filter_max_reproj_error = options.triangulation.complete_max_reproj_error = job.tolerance
        options.triangulation.merge_max_reproj_error = job.tolerance
        options.mapper.abs_pose_max_error *= job.tolerance / TOLERANCE
    options.ba_local_function_tolerance = options.ba_global_function_tolerance = STEP_TOLERANCE
    if job.rigged:  # what is known of views is exact
        options.ba_refine_sensor_from_rig = False
        options.constant_cameras = set(job.view_cameras.values())
    if angle is not None:
        options.mapper.init_min_tri_angle = 4.0
        options.mapper.init_min_num_inliers = 40
        options.mapper.abs_pose_min_num_inliers = 18
        options.mapper.abs_pose_min_inlier_ratio = 0.15
        options.mapper.filter_min_tri_angle = options.triangulation.min_angle = angle
    return options


def _incremental(
    job: Job, report: Report, angle: float | None = None, start: pycolmap.Reconstruction | None = None
) -> list[pycolmap.Reconstruction]:
    """The models that COLMAP's incremental mapper makes, by its own rules or with `angle` by looser ones; with `start` that one, gone on
    from."""
    options = _options(job, angle)
    total = len(job.images)
    how = "small" if angle == SMALL_ANGLE else "tiny"
    if angle is None:
        what = "mapping" if start is None else "closing loops"
    else:
        what = f"{'mapping again' if start is None else 'going on'} with {how} angles"
    count = 0 if start is None else start.num_reg_images()

    def started() -> None:
        nonlocal count
        count = 2
        report(count, total, f"{what}, 2 of {total} registered")

    def registered() -> None:
        nonlocal count
        count += 1
        report(min(count, total), total, f"{what}, {min(count, total)} of {total} registered")

    report(count, total, what)
    pycolmap.set_random_seed(job.seed)
    folder = _empty(Path(job.folder) / "attempt")
    given: Path | str = ""  # nothing
    if start is not None:
        options.multiple_models = False
        if angle is not None:  # what it begins with was adjusted, and `finish` adjusts all that it adds
            options.ba_local_max_refinements = options.ba_global_max_refinements = 1
        given = _empty(Path(job.folder) / "start")
        start.write_binary(given)
    try:
        found = pycolmap.incremental_mapping(
            job.database, folder, folder, options, given, initial_image_pair_callback=started, next_image_callback=registered
        )
    finally:
        remove(Path(job.folder) / "start")
    return list(found.values())


def _in_parts(job: Job, report: Report) -> list[pycolmap.Reconstruction]:
    """The models of `PART` images each, which several threads make by COLMAP's own rules, put together; the largest is adjusted, since
    parts are joined by nothing but a similarity."""
    options = pycolmap.HierarchicalPipelineOptions()
    options.incremental_options = _options(job)
    options.num_threads = options.num_workers = job.threads
    options.clustering_options.leaf_max_num_images = PART
    options.clustering_options.image_overlap = SHARED
    pycolmap.set_random_seed(job.seed)
    folder = _empty(Path(job.folder) / "attempt")
    with alive(lambda: report(0, len(job.images), f"mapping in parts of {PART} images")):
        found = list(pycolmap.hierarchical_mapping(job.database, folder, folder, options).values())
        models = [Model(one, IN_PARTS, _registered(one)) for one in found]
        best = max(models, key=lambda model: model.size, default=None)
        if best is not None and len(best.registered) >= SMALLEST:
            finish(job, best, report)
    return found


def _global(job: Job, report: Report) -> list[pycolmap.Reconstruction]:
    # Calibrating the view graph rewrites cameras and pairs: on a copy, so that a re-run starts from the same matches.
    copy = Path(job.folder) / "global.db"
    remove(copy)
    shutil.copyfile(job.database, copy)
    try:
        pycolmap.set_random_seed(job.seed)
        calibrate(copy, job.seed)
        options = pycolmap.GlobalPipelineOptions()
        options.num_threads = job.threads
        options.random_seed = job.seed
        folder = _empty(Path(job.folder) / "attempt")
        with alive(lambda: report(0, len(job.images), "mapping all at once")):
            return list(pycolmap.global_mapping(copy, folder, folder, options).values())
    finally:
        remove(copy)


def calibrate(database: Path, seed: int) -> None:
    """Put focal lengths into the cameras of a database that make most of its pairs' fundamental matrices essential ones."""
    options = pycolmap.ViewGraphCalibrationOptions()
    options.random_seed = seed
    pycolmap.calibrate_view_graph(database, options)


def _empty(folder: Path) -> Path:
    remove(folder)
    folder.mkdir(parents=True)
    return folder


# --------------------------------------------------------------------------------------------------- results


def finish(job: Job, model: Model, report: Report) -> None:
    """Adjust all cameras and points once more, to the end, and settle the frame."""
    report(len(job.images), len(job.images), "adjusting all once more")
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    if job.rigged:
        options.refine_sensor_from_rig = options.refine_focal_length = options.refine_extra_params = False
    options.ceres.solver_options.function_tolerance = LAST_TOLERANCE
    options.ceres.solver_options.max_num_iterations = LAST_STEPS
    options.ceres.solver_options.num_threads = job.repeating
    pycolmap.bundle_adjustment(model.reconstruction, options)
    # As after each of the mapper's own: a point that hardly any parallax held may have gone behind a camera, or to where numbers end.
    rules = _options(job, None if model.attempt in (STRICT, IN_PARTS) else TINY_ANGLE if model.attempt == GONE_FAR else SMALL_ANGLE).mapper
    pycolmap.ObservationManager(model.reconstruction).filter_all_points3D(rules.filter_max_reproj_error, rules.filter_min_tri_angle)
    model.registered = _registered(model.reconstruction)
    settle(model)


def settle(model: Model) -> None:
    """Fix the frame that structure from motion leaves free: the first registered camera's axes, cameras at mean distance 1 of their
    centre. COLMAP's own choice depends on the order in which threads finish."""
    reconstruction = model.reconstruction
    first = min(model.registered, key=lambda image_id: int(reconstruction.image(image_id).name))
    centres = np.array([reconstruction.image(image_id).projection_center() for image_id in model.registered])
    spread = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).mean())
    pose = reconstruction.image(first).cam_from_world()
    scale = 1.0 / max(spread, 1e-12)
    reconstruction.transform(pycolmap.Sim3d(scale, pose.rotation, scale * np.asarray(pose.translation)))


def save_model(model: Model, names: list[str], folder: Path) -> None:
    """COLMAP's binary files of the model, with the images' own names."""
    for image_id in model.reconstruction.reg_image_ids():
        image = model.reconstruction.image(image_id)
        image.name = names[int(image.name)]
    model.reconstruction.write_binary(_empty(folder))


def plain(model: Model) -> dict[str, Any]:
    """The model as plain data: cameras by image (indices into the job's images), poses in our convention, points."""
    reconstruction = model.reconstruction
    order = sorted(model.registered, key=lambda image_id: int(reconstruction.image(image_id).name))
    images = [reconstruction.image(image_id) for image_id in order]
    points = [point for _, point in sorted(reconstruction.points3D.items())]
    return {
        "attempt": model.attempt,
        "pictures": [int(image.name) for image in images],
        "intrinsics": [_intrinsics(reconstruction.camera(image.camera_id)).to_dict() for image in images],
        "world_from_camera": [[*image.cam_from_world().inverse().matrix().tolist(), [0.0, 0.0, 0.0, 1.0]] for image in images],
        "points": [np.asarray(point.xyz, dtype=np.float64).tolist() for point in points],
        "point_errors": [float(point.error) for point in points],
        "error": model.error,
        "angle": _median_angle(reconstruction),
    }


def _intrinsics(camera: pycolmap.Camera) -> Intrinsics:
    """COLMAP's camera in our terms; both put pixel centres at +0.5."""
    values = [float(value) for value in camera.params]
    if camera.model_name == "OPENCV":
        fx, fy, cx, cy, *lens = values
    elif camera.model_name == "PINHOLE":
        fx, fy, cx, cy = values
        return Intrinsics(int(camera.width), int(camera.height), fx, fy, cx, cy)
    elif camera.model_name == "SIMPLE_RADIAL":
        fx, cx, cy, k = values
        fy, lens = fx, [k, 0.0, 0.0, 0.0]
    else:
        raise PoseError(
            f"the lens model {camera.model_name} came back from mapping, which no camera had; remove the sparse folder and run again"
        )
    return Intrinsics(int(camera.width), int(camera.height), fx, fy, cx, cy, OPENCV, tuple(lens))


def _median_angle(reconstruction: pycolmap.Reconstruction) -> float:
    """Median over points of the largest angle, in degrees, between two of the rays that see one."""
    centres = {image_id: np.asarray(reconstruction.image(image_id).projection_center()) for image_id in reconstruction.reg_image_ids()}
    points = [point for _, point in sorted(reconstruction.points3D.items())]
    angles = []
    for point in points[:: max(1, len(points) // ANGLE_SAMPLE)]:
        rays = np.array([centres[element.image_id] for element in point.track.elements]) - np.asarray(point.xyz)
        rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
        angles.append(float(np.degrees(np.arccos(np.clip((rays @ rays.T).min(), -1.0, 1.0)))))
    return float(np.median(angles)) if angles else 0.0


# --------------------------------------------------------------------------------------------------- agreement


def agreement(job: Job, model: Model, apart: int = 0) -> dict[int, float]:
    """For each placed image (its index in the job) the share of its matches with other placed ones that agree with their cameras, of
    those more than `apart` away in order; 0 without any.

    A verified pair's inliers agree with one fundamental matrix, whichever. Where many do not agree with the cameras, the mapper has put an
    image to a place that only some of its matches support, as happens to few photos that stand far apart.
    """
    with opened(job.database) as database:
        index = {image.image_id: int(image.name) for image in database.read_all_images()}
        keypoints = keypoints_of(database)
        pairs = list(zip(*database.read_two_view_geometries(), strict=True))
    placed = {int(image.name): image for image in (model.reconstruction.image(image_id) for image_id in model.registered)}
    agree, total = dict.fromkeys(placed, 0), dict.fromkeys(placed, 0)
    for pair_id, geometry in pairs:
        first, second = pycolmap.pair_id_to_image_pair(pair_id)
        matches = np.asarray(geometry.inlier_matches).reshape(-1, 2)
        here, there = index[first], index[second]
        if len(matches) < MIN_INLIERS or here not in placed or there not in placed or abs(here - there) <= apart:
            continue
        cameras = [model.reconstruction.camera(placed[i].camera_id) for i in (here, there)]
        rays = [
            camera.cam_from_img(keypoints[image_id][matches[:, side], :2].astype(np.float64))
            for side, (camera, image_id) in enumerate(zip(cameras, (first, second), strict=True))
        ]
        moved = np.vstack([(placed[there].cam_from_world() * placed[here].cam_from_world().inverse()).matrix(), [0, 0, 0, 1]])
        near = int(np.count_nonzero(epipolar_distance(moved, *rays) * cameras[0].mean_focal_length() < job.tolerance))
        for i in (here, there):
            agree[i] += near
            total[i] += len(matches)
    return {i: agree[i] / total[i] if total[i] else 0.0 for i in sorted(placed)}


def leave_out(model: Model, shares: dict[int, float], least: float) -> dict[int, float]:
    """Take images that fewer than `least` of their matches agree with out of the model, where these are a quarter of it at most.

    Of more it is open which are right. What is left of `shares` comes back.
    """
    doubtful = [i for i, share in shares.items() if share < least]
    if not doubtful or 4 * len(doubtful) > len(shares) or len(shares) - len(doubtful) < SMALLEST:
        return shares
    for image_id in list(model.registered):
        image = model.reconstruction.image(image_id)
        if int(image.name) in doubtful:
            model.reconstruction.deregister_frame(image.frame_id)
            model.registered.remove(image_id)
    return {i: share for i, share in shares.items() if i not in doubtful}
