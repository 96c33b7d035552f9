"""Whether a model's cameras agree with the matches it was made of. Runs in the child process only.

A verified pair's inliers agree with one fundamental matrix, whichever. Those that also agree with the cameras of the model speak for it;
where many do not, the mapper has put a picture to a place that only some of its matches tell of, as happens to few photos that stand
far apart.
"""

from __future__ import annotations

import numpy as np
import pycolmap

from fieldfuse.camera import Array
from fieldfuse.poses.database import MIN_INLIERS
from fieldfuse.poses.job import Job
from fieldfuse.poses.mapping import SMALLEST, Model


def agreement(job: Job, model: Model, apart: int = 0) -> dict[int, float]:
    """For each placed picture (its index in the job) the share of its matches with other placed ones that agree with their cameras, of
    those more than `apart` away in order; 0 without any."""
    database = pycolmap.Database.open(job.database)
    try:
        index = {image.image_id: int(image.name) for image in database.read_all_images()}
        keypoints = {image_id: np.asarray(database.read_keypoints(image_id)).reshape(-1, 4)[:, :2] for image_id in index}
        pairs = list(zip(*database.read_two_view_geometries(), strict=True))
    finally:
        database.close()
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
            camera.cam_from_img(keypoints[image_id][matches[:, side]].astype(np.float64))
            for side, (camera, image_id) in enumerate(zip(cameras, (first, second), strict=True))
        ]
        moved = placed[there].cam_from_world() * placed[here].cam_from_world().inverse()
        off = epipolar_distance(rays[0], rays[1], moved.rotation.matrix(), np.asarray(moved.translation))
        near = int(np.count_nonzero(off * cameras[0].mean_focal_length() < job.tolerance))
        for i in (here, there):
            agree[i] += near
            total[i] += len(matches)
    return {i: agree[i] / total[i] if total[i] else 0.0 for i in sorted(placed)}


def leave_out(model: Model, shares: dict[int, float], least: float) -> dict[int, float]:
    """Take pictures that fewer than `least` of their matches agree with out of the model, where these are a quarter of it at most.

    Of more nobody can tell who is right. What is left of `shares` comes back.
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


def epipolar_distance(first: Array, second: Array, rotation: Array, translation: Array) -> Array:
    """(N,) Sampson distances of (N, 2) pairs of normalised image points from the epipolar constraint of second_from_first (3, 3), (3,).

    To first order how far both points together are from a pair that one point in space explains (Hartley and Zisserman, eq. 11.9).
    """
    x, y, z = translation
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ rotation
    here, there = (np.concatenate([points, np.ones((len(points), 1))], axis=1) for points in (first, second))
    lines, back = here @ essential.T, there @ essential
    slope = np.sqrt((lines[:, :2] ** 2).sum(axis=1) + (back[:, :2] ** 2).sum(axis=1))
    return np.asarray(np.abs((there * lines).sum(axis=1)) / np.maximum(slope, 1e-12))
