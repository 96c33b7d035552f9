"""COLMAP's database: features in, facts out (`match.py` puts matches in). Runs in the child process only."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from safetensors import safe_open
from safetensors.numpy import save_file

from fieldfuse.camera import Array, directions_of
from fieldfuse.capture.images import load_image, usable_pixels
from fieldfuse.capture.types import Frame
from fieldfuse.cluster import Task
from fieldfuse.errors import InputError
from fieldfuse.files import atomic_path, fingerprint, read_json, remove, write_json
from fieldfuse.poses.job import SIFT, TOLERANCE, Job
from fieldfuse.poses.pairs import COARSE, coarse
from fieldfuse.poses.points import at_pixels
from fieldfuse.poses.spread import FOLDER, spread
from fieldfuse.progress import Progress

CONTRAST = 0.014  # finds as many as COLMAP's own detector does with its threshold
THUMBNAIL = 32  # pixels a side of the image, by which identical ones are found
GUESSED_FOCAL = 1.2  # of the long side, when nothing is known
MIN_INLIERS = 15  # COLMAP's own bound for a verified pair
ENLARGED = 2.0  # times at most that an image is enlarged for learned features, which are found to a pixel: SIFT does so by itself

# Of the extent of the matched features: what moves less stands still, what moves more moves, and what is off a line by less lies on it.
STANDING, MOVING, OFF = 0.0025, 0.01, 0.004
LEAST_STANDING, STANDING_SHARE = 8, 0.15  # matches that stand still, and their share, that are worth looking at
LEAST_MOVING = 12  # matches that move, and that one epipolar geometry must explain
STRAIGHT = 0.75  # share of them that go away from one point where the camera did not turn

IMAGES_A_TASK = 16  # whose features one task on a cluster finds
IMAGES_WORTH = 50  # for each thread of this machine, from which the cluster is worth its start (docs/cluster.md)

Report = Callable[[float, float, str], None]
Found = tuple[dict[str, Any], Array, Array]  # record, keypoints, descriptors of an image


@contextmanager
def opened(path: Path) -> Iterator[pycolmap.Database]:
    """The database at `path`, closed afterwards."""
    database = pycolmap.Database.open(path)
    try:
        yield database
    finally:
        database.close()


def keypoints_of(database: pycolmap.Database) -> dict[int, Array]:
    """(N, 4) of every image by its id in the database: x, y, scale, angle."""
    return {image.image_id: np.asarray(database.read_keypoints(image.image_id)).reshape(-1, 4) for image in database.read_all_images()}


def open_database(job: Job) -> pycolmap.Database:
    """The database of `job`, with what an earlier run of the same job left in it; emptied when the inputs differ."""
    key = job.key()
    try:
        same = read_json(job.key_file) == {"key": key, "pycolmap": pycolmap.__version__}
    except InputError:
        same = False
    if not same:
        _discard(job)
    try:
        database = pycolmap.Database.open(job.database)
        database.num_keypoints()
    except (RuntimeError, ValueError):
        _discard(job)
        database = pycolmap.Database.open(job.database)
    write_json(job.key_file, {"key": key, "pycolmap": pycolmap.__version__})
    return database


def _discard(job: Job) -> None:
    for path in (job.records, job.key_file, job.result, Path(job.folder) / FOLDER, *Path(job.folder).glob(f"{job.database.name}*")):
        remove(path)


# ------------------------------------------------------------------------------------------------- features


def sift(grey: Array, most: int) -> tuple[Array, Array]:
    """The `most` largest features of (H, W) uint8, always the same ones: these are found again from other places.

    Returns:
        (N, 4) float32 keypoints: x and y in pixels, pixel centres at +0.5, scale in pixels, angle in radians; (N, 128) uint8 descriptors,
        512 times the root of their shares (root-SIFT; Arandjelović and Zisserman, CVPR 2012).
    """
    # Without `enable_precise_upscale` all keypoints lie a quarter of a pixel off, right and below.
    finder = cv2.SIFT.create(contrastThreshold=CONTRAST, enable_precise_upscale=True)
    found, described = finder.detectAndCompute(np.ascontiguousarray(grey), None)
    if described is None or len(found) == 0:
        return np.zeros((0, 4), np.float32), np.zeros((0, 128), np.uint8)
    largest = np.argsort([-point.size for point in found], kind="stable")[:most]
    found, described = [found[i] for i in largest], described[largest]
    keypoints = np.array([(*point.pt, point.size / 2, np.deg2rad(point.angle)) for point in found], dtype=np.float32)
    keypoints[:, :2] += 0.5
    shares = described / np.maximum(described.sum(axis=1, keepdims=True), 1e-9)
    return keypoints, np.minimum(np.round(512 * np.sqrt(shares)), 255).astype(np.uint8)


def learned(grey: Array, most: int) -> tuple[Array, Array]:
    """As `sift`, by XFeat: the surest first; (N, 128) uint8 are the bytes of (N, 64) float16."""
    from fieldfuse.poses import xfeat  # torch takes a second and 200 MB, and is not always needed

    network = xfeat.installed()
    if network is None:  # on a node: a job with these features is made only where the weights are
        raise InputError(f"XFeat's weights are not installed there; {xfeat.INSTALL}")
    keypoints, descriptors = xfeat.detect(network, grey, most)
    return keypoints, descriptors.astype(np.float16).view(np.uint8)


def floats(descriptors: Array, features: str) -> Array:
    """(N, 128) uint8 from the database → (N, 128) or (N, 64) float32."""
    rows = np.ascontiguousarray(descriptors, dtype=np.uint8).reshape(-1, 128)
    return (rows if features == SIFT else rows.view(np.float16)).astype(np.float32)


def extract(job: Job, database: pycolmap.Database, report: Report) -> list[dict[str, Any]]:
    """Features of every image into the database, those that are not there yet.

    Returns:
        a record an image: name, width, height, keypoints, deviation (of grey values), thumbnail.
    """
    records: dict[str, dict[str, Any]] = {}
    if job.records.exists():
        records = {record["name"]: record for record in read_json(job.records)}
    todo = [i for i, image in enumerate(job.images) if image.name not in records or not database.exists_image(label(i))]
    done = len(job.images) - len(todo)
    report(done, len(job.images), f"features {done} of {len(job.images)}")
    with pycolmap.DatabaseTransaction(database):
        _write_rigs(job, database)
    for index, (record, keypoints, descriptors) in _features(job, todo, report):
        if not database.exists_image(label(index)):
            with pycolmap.DatabaseTransaction(database):
                _write_image(job, database, index, record, keypoints, descriptors)
        records[record["name"]] = record
        done += 1
        if done % 10 == 0 or done == len(job.images):
            write_json(job.records, list(records.values()))
        report(done, len(job.images), f"features {done} of {len(job.images)}")
    _write_rig_frames(job, database)
    return [records[image.name] for image in job.images]


def _features(job: Job, indices: list[int], report: Report) -> Iterator[tuple[int, Found]]:
    """Features of the images at `indices`, in order: of the job's cluster, where there is one and it helps, or a few ahead."""
    if job.address is not None and len(indices) >= IMAGES_WORTH * job.threads:
        places = _spread(job, indices, report)
        for path in places:
            yield from _read_features(path)
        remove(Path(job.folder) / FOLDER)
        if places:
            return
    with ThreadPoolExecutor(job.threads) as pool:
        ahead: list[tuple[int, Future[Found]]] = []
        for index in indices:
            ahead.append((index, pool.submit(_describe, job.images[index], job)))
            if len(ahead) > 2 * job.threads:
                first, future = ahead.pop(0)
                yield first, future.result()
        for first, future in ahead:
            yield first, future.result()


def _spread(job: Job, indices: list[int], report: Report) -> list[Path]:
    """Have the nodes of the job's cluster find features; files of these in order, none where the nodes would not be faster."""
    folder, count, missing = Path(job.folder) / FOLDER, len(job.images), set(indices)
    job.save(folder / "job.json")
    tasks = []
    for start in range(0, count, IMAGES_A_TASK):  # of all images, so that an interrupted run's files are those of the next
        part = [index for index in range(start, min(start + IMAGES_A_TASK, count)) if index in missing]
        if part:
            argument = (str(folder / "job.json"), part, str(folder / f"features-{fingerprint(part)}.safetensors"))
            tasks.append(Task(f"features of images {part[0] + 1} to {part[-1] + 1}", argument, memory=job.feature_bytes))

    def show(done: float) -> None:
        report(count - len(indices) + done * len(indices) / len(tasks), count, f"features of {count} images, on the cluster's nodes")

    return [Path(task.argument[-1]) for task in tasks] if spread(job, features_of, tasks, show, job.threads) else []


def features_of(argument: tuple[str, list[int], str], link: Progress) -> None:
    """A task: the features of some images of a job, into a file.

    Args:
        argument: the job's file, indices of its images, the file to be written.
    """
    cv2.setNumThreads(1)
    job, indices, target = Job.load(Path(argument[0])), argument[1], Path(argument[2])
    arrays, records = dict[str, Array](), dict[str, Any]()
    for done, index in enumerate(indices):
        link.update(done, len(indices))
        records[str(index)], arrays[f"keypoints {index}"], arrays[f"descriptors {index}"] = _describe(job.images[index], job)
    with atomic_path(target) as path:
        save_file(arrays, path, {"records": json.dumps(records)})


def _read_features(path: Path) -> Iterator[tuple[int, Found]]:
    with safe_open(path, "numpy") as file:
        for index, record in json.loads(file.metadata()["records"]).items():
            yield int(index), (record, file.get_tensor(f"keypoints {index}"), file.get_tensor(f"descriptors {index}"))


def _describe(frame: Frame, job: Job) -> Found:
    """One image as every later stage loads it, its keypoints (N, 4) in its own pixels and descriptors (N, 128) for the database."""
    pixels = load_image(frame, exif=job.exif)
    height, width = pixels.shape[:2]
    grey = cv2.cvtColor(np.ascontiguousarray(pixels[..., :3]), cv2.COLOR_RGB2GRAY)
    usable = usable_pixels(frame, pixels, exif=job.exif)
    factor = _factor(job, width, height)
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    seen = grey if factor == 1.0 else cv2.resize(grey, size, interpolation=cv2.INTER_AREA if factor < 1.0 else cv2.INTER_CUBIC)
    keypoints, descriptors = sift(seen, job.max_features) if job.features == SIFT else learned(seen, job.max_features)
    keypoints = keypoints * np.array([width / size[0], height / size[1], width / size[0], 1.0], dtype=np.float32)
    if usable is not None and len(keypoints):
        keep = at_pixels(usable, keypoints[:, :2])
        keypoints, descriptors = keypoints[keep], descriptors[keep]
    thumbnail = cv2.resize(grey, (THUMBNAIL, THUMBNAIL), interpolation=cv2.INTER_AREA)
    record = {
        "name": frame.name,
        "width": width,
        "height": height,
        "keypoints": len(keypoints),
        "deviation": round(float(grey.std()), 3),
        "thumbnail": thumbnail.ravel().tolist(),
    }
    return record, keypoints, descriptors


def _factor(job: Job, width: int, height: int) -> float:
    """Size of an image in which features are looked for, in sizes of its own."""
    return min(1.0 if job.features == SIFT else ENLARGED, job.image_size / max(width, height))


def tolerant(job: Job, records: list[dict[str, Any]]) -> Job:
    """The job with the tolerance that suits its features: learned ones lie within COLMAP's pixels of the image in which they were found."""
    if job.features == SIFT:
        return job
    return replace(job, tolerance=TOLERANCE / float(np.median([_factor(job, record["width"], record["height"]) for record in records])))


def label(index: int) -> str:
    """The name of an image inside the database: COLMAP's lists of pairs cannot hold names with spaces."""
    return f"{index:06d}"


def _write_image(job: Job, database: pycolmap.Database, index: int, record: dict[str, Any], keypoints: Array, descriptors: Array) -> None:
    of_rig = job.images[index].instant is not None
    if of_rig:
        camera_id, rig_id = job.view_cameras[index], 0
    else:
        camera_id, rig_id = _camera(job, database, job.images[index], record["width"], record["height"])
    image = pycolmap.Image(name=label(index), camera_id=camera_id)
    image_id = database.write_image(image)
    image.image_id = image_id
    if not of_rig:
        _write_frame(database, rig_id, [image])
    database.write_keypoints(image_id, keypoints)
    kind = pycolmap.FeatureExtractorType.SIFT if job.features == SIFT else pycolmap.FeatureExtractorType.UNDEFINED
    data = pycolmap.FeatureDescriptors(type=kind, data=np.ascontiguousarray(descriptors))
    database.write_descriptors(image_id, data)


def _write_frame(database: pycolmap.Database, rig_id: int, images: list[pycolmap.Image]) -> None:
    frame = pycolmap.Frame()
    frame.rig_id = rig_id
    for image in images:
        frame.add_data_id(image.data_id)
    database.write_frame(frame)


def _write_rigs(job: Job, database: pycolmap.Database) -> None:
    """Cameras and rigs of the job's instants, where they are not there yet; a rig has the id of its first camera."""
    cameras = job.view_cameras
    for views in job.instants:
        first = cameras.get(views[0])
        if first is None or database.exists_rig(first):
            continue
        rig = pycolmap.Rig(rig_id=first)
        start = job.images[views[0]].source_from_view
        for index in views:
            own, turn = job.images[index].intrinsics, job.images[index].source_from_view
            assert own is not None and turn is not None and start is not None
            camera = pycolmap.Camera(
                camera_id=cameras[index], model="PINHOLE", width=own.width, height=own.height, params=[own.fx, own.fy, own.cx, own.cy]
            )
            camera.has_prior_focal_length = True
            if not database.exists_camera(camera.camera_id):
                database.write_camera(camera, use_camera_id=True)
            if index == views[0]:
                rig.add_ref_sensor(camera.sensor_id)
            else:
                turned = pycolmap.Rotation3d((turn.T @ start)[:3, :3])
                rig.add_sensor(camera.sensor_id, pycolmap.Rigid3d(turned, np.zeros(3)))
        database.write_rig(rig, use_rig_id=True)


def _write_rig_frames(job: Job, database: pycolmap.Database) -> None:
    """The frames of the job's instants, where they are not there yet: their images are."""
    cameras = job.view_cameras
    there = {data.id for frame in database.read_all_frames() for data in frame.data_ids}
    with pycolmap.DatabaseTransaction(database):
        for views in job.instants:
            images = [database.read_image_with_name(label(index)) for index in views if index in cameras]
            if images and images[0].image_id not in there:
                _write_frame(database, cameras[views[0]], images)


def lens_model(images: int) -> str:
    """Fewer parameters for fewer images: those that a handful of views cannot separate are not there."""
    return "OPENCV" if images >= 30 else "SIMPLE_RADIAL"


def _camera(job: Job, database: pycolmap.Database, frame: Frame, width: int, height: int) -> tuple[int, int]:
    """The (camera, rig) ids for an image: shared by images of one size when the job has one camera."""
    focal = frame.focal_prior or GUESSED_FOCAL * max(width, height)
    if job.one_camera:
        of_views = set(job.view_cameras.values())
        for rig in database.read_all_rigs():
            if rig.rig_id in of_views:
                continue
            camera = database.read_camera(rig.ref_sensor_id.id)
            if (camera.width, camera.height) == (width, height):
                return camera.camera_id, rig.rig_id
    model = lens_model(len(job.images)) if job.one_camera else "SIMPLE_RADIAL"
    camera = pycolmap.Camera.create_from_model_name(0, model, focal, width, height)
    camera.has_prior_focal_length = frame.focal_prior is not None
    camera.camera_id = database.write_camera(camera)
    rig = pycolmap.Rig()
    rig.add_ref_sensor(camera.sensor_id)
    return camera.camera_id, database.write_rig(rig)


# ------------------------------------------------------------------------------------------------- matches


def sketches(job: Job, database: pycolmap.Database) -> list[Array]:
    """The coarsest descriptors of every image, for choosing pairs; of a view those of what no other view of its instant shows nearer to
    its axis, so that nothing is there twice."""
    out = []
    share = max((len(views) for views in job.instants), default=1)
    for index in range(len(job.images)):
        image_id = database.read_image_with_name(label(index)).image_id
        keypoints = np.asarray(database.read_keypoints(image_id)).reshape(-1, 4)
        descriptors = floats(database.read_descriptors(image_id).data, job.features)
        if index in job.view_cameras:
            own = _nearest_axis(job, index, keypoints[:, :2])
            keypoints, descriptors = keypoints[own], descriptors[own]
        out.append(coarse(descriptors, keypoints[:, 2], COARSE if share == 1 else 3 * COARSE // share))
    return out


def _nearest_axis(job: Job, index: int, pixels: Array) -> Array:
    """(N,) bool: whether what a view shows at pixels (N, 2) lies nearer to its axis than to that of any other view of its instant."""
    frame = job.images[index]
    assert frame.intrinsics is not None and frame.source_from_view is not None
    rays = directions_of(frame.intrinsics, pixels) @ frame.source_from_view[:3, :3].T
    siblings = next(views for views in job.instants if index in views)
    axes = np.array([turn[:3, 2] for i in siblings if (turn := job.images[i].source_from_view) is not None])
    return np.asarray((rays @ axes.T).argmax(axis=1) == siblings.index(index))


def pair_facts(database: pycolmap.Database) -> list[dict[str, Any]]:
    """Each verified pair: indices, matches, inliers, whether a homography explains it (with it), how far features moved, and what stands
    still beside what moves (`stands`)."""
    index = {image.image_id: int(image.name) for image in database.read_all_images()}
    keypoints = keypoints_of(database)
    configurations = pycolmap.TwoViewGeometryConfiguration
    flat = (configurations.PLANAR, configurations.PANORAMIC, configurations.PLANAR_OR_PANORAMIC)
    matched = dict(zip(*database.read_all_matches(), strict=True))
    facts = []
    for pair_id, geometry in zip(*database.read_two_view_geometries(), strict=True):
        inliers = np.asarray(geometry.inlier_matches).reshape(-1, 2)
        if len(inliers) < MIN_INLIERS:
            continue
        first, second = pycolmap.pair_id_to_image_pair(pair_id)
        here, there = keypoints[first][:, :2], keypoints[second][:, :2]
        homography = None if geometry.H is None else np.asarray(geometry.H, dtype=np.float64)
        explained = geometry.config in flat and homography is not None and bool(np.all(np.isfinite(homography)))
        rows = np.asarray(matched.get(pair_id, np.zeros((0, 2), np.int64))).reshape(-1, 2)
        facts.append(
            {
                "first": index[first],
                "second": index[second],
                "inliers": len(inliers),
                "flat": explained,
                "homography": homography.tolist() if explained and homography is not None else None,
                "moved": float(np.median(np.linalg.norm(here[inliers[:, 0]] - there[inliers[:, 1]], axis=1))),
                "stands": stands(here[rows[:, 0]], there[rows[:, 1]]),
            }
        )
    return facts


def stands(here: Array, there: Array) -> tuple[float, bool] | None:
    """Whether many features stay where they are in two images while others move together; None where nothing of the kind is seen.

    What is very far away stands still, too, before a camera that moves and does not turn: then all that moves goes away from one point,
    near or infinitely far.

    Returns:
        the share of the image's area that the standing ones take up, and whether the moving ones go other ways than from one point: then
        no motion of one camera explains both.

    Args:
        here, there: (M, 2) pixels of matched features in two images.
    """
    if len(here) < 2 * LEAST_MOVING:
        return None
    here, there = here.astype(np.float64), there.astype(np.float64)
    low, high = here.min(axis=0), here.max(axis=0)
    side = float((high - low).max())
    way = np.linalg.norm(here - there, axis=1)
    still, moving = way < STANDING * side, way > MOVING * side
    if still.sum() < max(LEAST_STANDING, STANDING_SHARE * len(here)) or moving.sum() < LEAST_MOVING:
        return None
    cv2.setRNGSeed(0)
    matrix, inlier = cv2.findFundamentalMat(here[moving], there[moving], cv2.FM_RANSAC, 0.5 * OFF * side, 0.999, 2000)
    if matrix is None or matrix.shape != (3, 3) or inlier.sum() < LEAST_MOVING:
        return None
    one, other = (points[moving][inlier.ravel() > 0] for points in (here, there))
    inner = np.quantile(here[still], [0.1, 0.9], axis=0)
    extent = float(np.prod((inner[1] - inner[0]) / np.maximum(high - low, 1e-9)))
    return extent, straight(one, other, OFF * side) < STRAIGHT


def straight(here: Array, there: Array, tolerance: float) -> float:
    """The largest share of features (M, 2) → (M, 2) found that move on lines through one point, near or infinitely far, within `tolerance`
    pixels."""
    one, other = (np.concatenate([points, np.ones((len(points), 1))], axis=1) for points in (here, there))
    lines = np.cross(one, other)
    lines /= np.maximum(np.linalg.norm(lines, axis=1, keepdims=True), 1e-12)
    random = np.random.default_rng(0)
    best = 0.0
    for _ in range(200):
        i, j = random.choice(len(lines), 2, replace=False)
        point = np.cross(lines[i], lines[j])
        through = np.cross(point, one)  # (M, 3) lines from the point through where features were
        off = np.abs((through * other).sum(axis=1)) / np.maximum(np.hypot(through[:, 0], through[:, 1]), 1e-12)
        best = max(best, float(np.mean(off < tolerance)))
    return best
