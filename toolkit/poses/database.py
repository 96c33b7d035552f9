"""COLMAP's database: features in, matches in, facts out. Runs in the child process only."""

from __future__ import annotations

import os
import shutil
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context, parent_process
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import cv2
import numpy as np
import pycolmap

from toolkit.camera import Array
from toolkit.capture.images import load_image, load_mask
from toolkit.errors import InputError
from toolkit.files import atomic_path, read_json, remove, write_json
from toolkit.poses.features import sift
from toolkit.poses.job import Job, Picture
from toolkit.poses.pairs import coarse

THUMBNAIL = 32  # pixels a side of the picture kept to tell identical ones
GUESSED_FOCAL = 1.2  # of the long side, when nothing is known
PAIRS_A_STEP = 40  # matched between two progress reports
MOST_MATCHERS = 8  # processes, each of a hundred megabytes and more
MOST_COPIED = 2**30  # bytes of all copies of the database, of which each process that matches has one
MIN_INLIERS = 15  # COLMAP's own bound for a verified pair

Report = Callable[[float, float, str], None]


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
    for path in (job.records, job.key_file, job.result, *Path(job.folder).glob(f"{job.database.name}*")):
        remove(path)


# ------------------------------------------------------------------------------------------------- features


def extract(job: Job, database: pycolmap.Database, report: Report) -> list[dict[str, Any]]:
    """SIFT features of every picture into the database; what is there already is kept.

    Returns:
        a record a picture: name, width, height, keypoints, deviation (of grey values), thumbnail.
    """
    records: dict[str, dict[str, Any]] = {}
    if job.records.exists():
        records = {record["name"]: record for record in read_json(job.records)}
    todo = [i for i, picture in enumerate(job.pictures) if picture.name not in records or not database.exists_image(label(i))]
    done = len(job.pictures) - len(todo)
    report(done, len(job.pictures), f"features {done} of {len(job.pictures)}")
    for index, (record, keypoints, descriptors) in _features(job, todo):
        if not database.exists_image(label(index)):
            with pycolmap.DatabaseTransaction(database):
                _write_picture(job, database, index, record, keypoints, descriptors)
        records[record["name"]] = record
        done += 1
        if done % 10 == 0 or done == len(job.pictures):
            write_json(job.records, list(records.values()))
        report(done, len(job.pictures), f"features {done} of {len(job.pictures)}")
    return [records[picture.name] for picture in job.pictures]


def _features(job: Job, indices: list[int]) -> Iterator[tuple[int, tuple[dict[str, Any], Array, Array]]]:
    """Features of the pictures at `indices`, a few ahead of what is asked for, in order."""

    def work(index: int) -> tuple[dict[str, Any], Array, Array]:
        return _describe(job.pictures[index], job)

    with ThreadPoolExecutor(job.threads) as pool:
        ahead: list[tuple[int, Future[tuple[dict[str, Any], Array, Array]]]] = []
        for index in indices:
            ahead.append((index, pool.submit(work, index)))
            if len(ahead) > 2 * job.threads:
                first, future = ahead.pop(0)
                yield first, future.result()
        for first, future in ahead:
            yield first, future.result()


def _describe(picture: Picture, job: Job) -> tuple[dict[str, Any], Array, Array]:
    """One picture as every later stage loads it, its keypoints (N, 4) in its own pixels and descriptors (N, 128)."""
    frame = picture.frame()
    pixels = load_image(frame, exif=job.exif)
    height, width = pixels.shape[:2]
    grey = cv2.cvtColor(np.ascontiguousarray(pixels[..., :3]), cv2.COLOR_RGB2GRAY)
    usable = load_mask(frame)
    if pixels.shape[2] == 4:
        solid = pixels[..., 3] >= 128
        usable = solid if usable is None or usable.shape != solid.shape else usable & solid
    factor = min(1.0, job.image_size / max(width, height))
    small = grey if factor == 1.0 else cv2.resize(grey, (round(width * factor), round(height * factor)), interpolation=cv2.INTER_AREA)
    keypoints, descriptors = sift(small, job.max_features)
    keypoints = keypoints * np.array([width / small.shape[1], height / small.shape[0], width / small.shape[1], 1.0], dtype=np.float32)
    if usable is not None and usable.shape == (height, width) and len(keypoints):
        column = np.clip(keypoints[:, 0].astype(int), 0, width - 1)
        row = np.clip(keypoints[:, 1].astype(int), 0, height - 1)
        keep = usable[row, column]
        keypoints, descriptors = keypoints[keep], descriptors[keep]
    thumbnail = cv2.resize(grey, (THUMBNAIL, THUMBNAIL), interpolation=cv2.INTER_AREA)
    record = {
        "name": picture.name,
        "width": width,
        "height": height,
        "keypoints": len(keypoints),
        "deviation": round(float(grey.std()), 3),
        "thumbnail": thumbnail.ravel().tolist(),
    }
    return record, keypoints, descriptors


def label(index: int) -> str:
    """The name of a picture inside the database: COLMAP's lists of pairs cannot hold names with spaces."""
    return f"{index:06d}"


def _write_picture(job: Job, database: pycolmap.Database, index: int, record: dict[str, Any], keypoints: Array, descriptors: Array) -> None:
    camera_id, rig_id = _camera(job, database, job.pictures[index], record["width"], record["height"])
    image = pycolmap.Image(name=label(index), camera_id=camera_id)
    image_id = database.write_image(image)
    frame = pycolmap.Frame()
    frame.rig_id = rig_id
    image.image_id = image_id
    frame.add_data_id(image.data_id)
    database.write_frame(frame)
    database.write_keypoints(image_id, keypoints)
    data = pycolmap.FeatureDescriptors(type=pycolmap.FeatureExtractorType.SIFT, data=np.ascontiguousarray(descriptors))
    database.write_descriptors(image_id, data)


def lens_model(pictures: int) -> str:
    """Fewer parameters for fewer pictures: what a handful of views cannot tell apart is left out."""
    return "OPENCV" if pictures >= 30 else "SIMPLE_RADIAL"


def _camera(job: Job, database: pycolmap.Database, picture: Picture, width: int, height: int) -> tuple[int, int]:
    """The (camera, rig) ids for a picture: shared by pictures of one size when the job says that there is one camera."""
    focal = picture.focal_prior or GUESSED_FOCAL * max(width, height)
    if job.one_camera:
        for rig in database.read_all_rigs():
            camera = database.read_camera(rig.ref_sensor_id.id)
            if (camera.width, camera.height) == (width, height):
                return camera.camera_id, rig.rig_id
    model = lens_model(len(job.pictures)) if job.one_camera else "SIMPLE_RADIAL"
    camera = pycolmap.Camera.create_from_model_name(0, model, focal, width, height)
    camera.has_prior_focal_length = picture.focal_prior is not None
    camera.camera_id = database.write_camera(camera)
    rig = pycolmap.Rig()
    rig.add_ref_sensor(camera.sensor_id)
    return camera.camera_id, database.write_rig(rig)


# ------------------------------------------------------------------------------------------------- matches


def sketches(job: Job, database: pycolmap.Database) -> list[Array]:
    """The coarsest descriptors of every picture, for choosing pairs."""
    out = []
    for index in range(len(job.pictures)):
        image_id = database.read_image_with_name(label(index)).image_id
        keypoints = np.asarray(database.read_keypoints(image_id)).reshape(-1, 4)
        out.append(coarse(np.asarray(database.read_descriptors(image_id).data).reshape(-1, 128), keypoints[:, 2]))
    return out


def match(job: Job, pairs: list[tuple[int, int]], report: Report) -> None:
    """Match and verify `pairs` (indices into the job's pictures); pairs in the database already are skipped by COLMAP. Nobody else has the
    database open meanwhile.

    What is found does not depend on the threads. Two threads that match in one process, COLMAP's or ours, gave some pairs other matches now
    and then (docs/performance.md), so each is a process with its own copy of the features, and a second thread that verifies.
    """
    steps = [pairs[start : start + PAIRS_A_STEP] for start in range(0, len(pairs), PAIRS_A_STEP)]
    done = 0

    def tell(step: list[tuple[int, int]]) -> None:
        nonlocal done
        done += len(step)
        report(done, len(pairs), f"matching, pair {done} of {len(pairs)}")

    tell([])
    with _copies(job, min(job.threads, MOST_MATCHERS, len(steps))) as folders:
        if len(folders) < 2:
            for step in steps:
                _match(job, Path(job.folder), step)
                tell(step)
            return
        free: SimpleQueue[Path] = SimpleQueue()
        for folder in folders:
            free.put(folder)
        lock = threading.Lock()
        with ProcessPoolExecutor(len(folders), get_context("spawn"), _end_with_parent) as processes:

            def one(step: list[tuple[int, int]]) -> None:
                folder = free.get()
                try:
                    processes.submit(_match, job, folder, step).result()
                    with lock:
                        _bring(folder / job.database.name, job.database, step)
                        tell(step)
                finally:
                    free.put(folder)

            with ThreadPoolExecutor(len(folders)) as pool:
                try:
                    for _ in pool.map(one, steps):
                        pass
                finally:
                    pool.shutdown(cancel_futures=True)


@contextmanager
def _copies(job: Job, count: int) -> Iterator[list[Path]]:
    """Folders with a copy of the job's database each, `count` of them or as many as there is room for, while the block lasts."""
    place, made = Path(job.folder) / "matching", []
    remove(place)
    try:
        for number in range(min(count, MOST_COPIED // max(1, job.database.stat().st_size)) if count > 1 else 0):
            folder = place / str(number)
            folder.mkdir(parents=True)
            try:
                shutil.copyfile(job.database, folder / job.database.name)
            except OSError:  # no room: those that are there take turns
                remove(folder)
                break
            made.append(folder)
        yield made
    finally:
        remove(place)


def _end_with_parent() -> None:
    """In a process that matches: never outlive the one that asked."""
    parent = parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(3)

    threading.Thread(target=watch, daemon=True).start()


def _match(job: Job, folder: Path, pairs: list[tuple[int, int]]) -> None:
    """COLMAP's matcher on the database in `folder`."""
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = 1
    matching.use_gpu = False
    matching.guided_matching = False
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = job.seed
    pairing = pycolmap.ImportedPairingOptions()
    with atomic_path(folder / "pairs.txt") as listing:
        listing.write_text("".join(f"{label(i)} {label(j)}\n" for i, j in pairs), encoding="utf-8")
        pairing.match_list_path = listing
        pycolmap.match_image_pairs(folder / job.database.name, matching, pairing, verification, pycolmap.Device.cpu)


def _bring(source: Path, target: Path, pairs: list[tuple[int, int]]) -> None:
    """Copy what was found for `pairs` from one database to another with the same pictures.

    By COLMAP's own SQLite: two of these libraries in one process know nothing of each other's locks.
    """
    found, database = pycolmap.Database.open(source), pycolmap.Database.open(target)
    try:
        ids = {int(image.name): image.image_id for image in found.read_all_images()}
        with pycolmap.DatabaseTransaction(database):
            for i, j in pairs:
                first, second = ids[i], ids[j]
                if not found.exists_matches(first, second) or database.exists_matches(first, second):
                    continue
                database.write_matches(first, second, found.read_matches(first, second))
                if found.exists_two_view_geometry(first, second):
                    database.write_two_view_geometry(first, second, found.read_two_view_geometry(first, second))
    finally:
        found.close()
        database.close()


def pair_facts(job: Job, database: pycolmap.Database) -> list[dict[str, Any]]:
    """Each verified pair: indices, matches, inliers, whether a homography explains it (with it), how far features moved."""
    index = {image.image_id: int(image.name) for image in database.read_all_images()}
    keypoints = {image_id: np.asarray(database.read_keypoints(image_id)).reshape(-1, 4) for image_id in index}
    configurations = pycolmap.TwoViewGeometryConfiguration
    flat = (configurations.PLANAR, configurations.PANORAMIC, configurations.PLANAR_OR_PANORAMIC)
    facts = []
    ids, geometries = database.read_two_view_geometries()
    for pair_id, geometry in zip(ids, geometries, strict=True):
        inliers = np.asarray(geometry.inlier_matches).reshape(-1, 2)
        if len(inliers) < MIN_INLIERS:
            continue
        first, second = pycolmap.pair_id_to_image_pair(pair_id)
        moved = keypoints[first][inliers[:, 0], :2] - keypoints[second][inliers[:, 1], :2]
        homography = None if geometry.H is None else np.asarray(geometry.H, dtype=np.float64)
        explained = geometry.config in flat and homography is not None and bool(np.all(np.isfinite(homography)))
        facts.append(
            {
                "first": index[first],
                "second": index[second],
                "inliers": len(inliers),
                "flat": explained,
                "homography": homography.tolist() if explained and homography is not None else None,
                "moved": float(np.median(np.linalg.norm(moved, axis=1))),
            }
        )
    return facts
