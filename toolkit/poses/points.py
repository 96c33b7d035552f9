"""Points for posed images that come without any: SIFT, matches that respect the known epipolar geometry, triangulation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from fieldfuse.camera import FISHEYE, Array, Intrinsics, distort, invert
from fieldfuse.capture.images import load_image, turns_by_exif, usable_pixels
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.poses.cloud import Cloud, every
from fieldfuse.poses.overlap import best_neighbours, guessed_depth, overlap, parallax
from fieldfuse.progress import SILENT, Progress

LONG_SIDE = 640  # pixels that SIFT works on
FEATURES = 1500  # a frame
MOST_FRAMES = 100
NEIGHBOURS = 4
RATIO = 0.8  # best against second-best descriptor distance
EPIPOLAR = 2.0  # working pixels off the epipolar line
REPROJECTION = 2.0  # working pixels
MIN_ANGLE = 1.0  # degrees between rays


@dataclass(frozen=True)
class Features:
    """SIFT features of one image."""

    pixel: Array  # (N, 2) in pixels of the camera, centres at +0.5
    descriptor: Array  # (N, 128) float32 unit length: root-SIFT
    size: Array  # (N,) working pixels
    scale: float  # working pixels a pixel of the camera


def triangulate(capture: Capture, progress: Progress = SILENT, known: dict[str, Features] | None = None) -> Cloud:
    """Sparse points of a posed capture from up to 100 of its images, each matched with up to 4 that overlap.

    A point is kept when all of its observations reproject within 2 pixels (of the image at a long side of 640), and two
    of its rays meet at more than 1°. The result may be empty.

    Args:
        known: features of images by name, found before.
    """
    known = known or {}
    chosen = every(len(capture.frames), MOST_FRAMES)
    frames = [capture.frames[i] for i in chosen]
    exif = turns_by_exif(capture)
    poses = np.array([frame.world_from_camera for frame in frames], dtype=np.float64)
    cameras = [frame.intrinsics for frame in frames if frame.intrinsics is not None]
    flat, descriptors, focal = [], [], np.zeros(len(frames))
    for i, (frame, camera) in enumerate(zip(frames, cameras, strict=True)):
        progress.check()
        progress.update(i, 2 * len(frames), f"points, picture {i + 1} of {len(frames)}")
        found = known.get(frame.name) or features_of(frame, camera, exif)
        flat.append(undistorted(camera, found.pixel))
        descriptors.append(found.descriptor)
        focal[i] = 0.5 * (camera.fx + camera.fy) * found.scale

    def tick(done: int, of: int) -> None:
        progress.check()
        progress.update(len(frames) * (1 + done / of), 2 * len(frames), f"points, pair {done + 1} of {of}")

    pairs = neighbour_pairs(poses, cameras, NEIGHBOURS)
    tolerance = [EPIPOLAR / (0.5 * (focal[i] + focal[j])) for i, j in pairs]
    owner, track, keypoint = find_tracks(poses, flat, descriptors, pairs, tolerance, tick)
    image_plane = np.concatenate(flat) if flat else np.zeros((0, 2))
    points, point, kept, z = intersect(poses, owner[keypoint], image_plane[keypoint], track, REPROJECTION / focal[owner[keypoint]])
    return Cloud(points, point, chosen[owner[keypoint[kept]]], z, "triangulated")


def features_of(frame: Frame, camera: Intrinsics, exif: bool) -> Features:
    """SIFT features of a frame's image at a long side of 640, of what its mask and alpha leave.

    Raises:
        InputError: the image or its mask cannot be read.
    """
    image = load_image(frame, exif=exif)
    usable = usable_pixels(frame, image, exif=exif)
    height, width = image.shape[:2]
    scale = min(1.0, LONG_SIDE / max(width, height))
    grey = cv2.cvtColor(np.ascontiguousarray(image[..., :3]), cv2.COLOR_RGB2GRAY)
    small = grey if scale == 1.0 else cv2.resize(grey, (round(width * scale), round(height * scale)), interpolation=cv2.INTER_AREA)
    at, sizes, descriptors = detect_sift(small, FEATURES, 0.02)
    pixels = (at.astype(np.float64) + 0.5) * [camera.width / small.shape[1], camera.height / small.shape[0]]
    if usable is not None:
        kept = at_pixels(usable, pixels * [width / camera.width, height / camera.height])
        pixels, descriptors, sizes = pixels[kept], descriptors[kept], sizes[kept]
    return Features(pixels, descriptors, sizes, scale * width / camera.width)


def detect_sift(grey: Array, most: int, contrast: float) -> tuple[Array, Array, Array]:
    """(N, 2) float32 places in (H, W) uint8, pixel centres whole numbers; (N,) float32 diameters; (N, 128) float32 root-SIFT of length 1,
    whose Euclidean distances compare histograms better than those of plain descriptors."""
    found, descriptors = cv2.SIFT.create(nfeatures=most, contrastThreshold=contrast).detectAndCompute(grey, None)
    if descriptors is None or len(found) == 0:
        return np.zeros((0, 2), np.float32), np.zeros(0, np.float32), np.zeros((0, 128), np.float32)
    rooted = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-6)).astype(np.float32)
    return np.array([k.pt for k in found], dtype=np.float32), np.array([k.size for k in found], dtype=np.float32), rooted


def at_pixels(values: Array, pixels: Array) -> Array:
    """(N,) values (H, W) at pixels (N, 2), centres at +0.5; those outside count as at the rim."""
    height, width = values.shape[:2]
    return np.asarray(values[np.clip(pixels[:, 1].astype(int), 0, height - 1), np.clip(pixels[:, 0].astype(int), 0, width - 1)])


def neighbour_pairs(poses: Array, cameras: Sequence[Intrinsics], count: int) -> list[tuple[int, int]]:
    """Pairs (i, j), i < j: each camera with the `count` that overlap under good parallax."""
    depth = guessed_depth(poses)
    partners = best_neighbours(poses, overlap(poses, cameras, depth), parallax(poses, depth), count)
    return sorted({(min(i, int(j)), max(i, int(j))) for i in range(len(poses)) for j in partners[i]})


def find_tracks(
    poses: Array,
    flat: Sequence[Array],
    descriptors: Sequence[Array],
    pairs: Sequence[tuple[int, int]],
    tolerance: Sequence[float],
    tick: Callable[[int, int], None],
) -> tuple[Array, Array, Array]:
    """Match pairs of posed images and gather what matches into tracks.

    Args:
        flat: of each image (N, 2) ideal image-plane points of its keypoints. descriptors: of each (N, 128), unit length.
        tolerance: of each pair how far off its epipolar line a match may lie, image-plane units.
        tick: called before each pair with its number and how many there are.

    Returns:
        (K,) image of every keypoint, numbered across images; and `tracks` of them.
    """
    starts = np.concatenate([[0], np.cumsum([len(points) for points in flat])])
    links = [np.zeros((0, 2), np.int64)]
    for number, ((i, j), near) in enumerate(zip(pairs, tolerance, strict=True)):
        tick(number, len(pairs))
        matched = mutual_matches(descriptors[i], descriptors[j])
        if len(matched):
            off = epipolar_distance(invert(poses[j]) @ poses[i], flat[i][matched[:, 0]], flat[j][matched[:, 1]])
            links.append(matched[off < near] + [starts[i], starts[j]])
    owner = np.repeat(np.arange(len(flat)), [len(points) for points in flat])
    return owner, *tracks(np.concatenate(links), owner)


def undistorted(camera: Intrinsics, pixels: Array) -> Array:
    """(N, 2) pixels → (N, 2) ideal image-plane points. Where the lens cannot be inverted there, NaN."""
    bent = (np.asarray(pixels, dtype=np.float64) - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    if not camera.distorted or len(bent) == 0:
        return bent
    coefficients = np.array(camera.distortion, dtype=np.float64)
    if camera.lens == FISHEYE:
        ideal = cv2.fisheye.undistortPoints(bent[:, None], np.eye(3), coefficients[:4])
    else:
        stop = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 40, 1e-10)
        ideal = cv2.undistortPoints(bent[:, None], np.eye(3), coefficients, criteria=stop)
    ideal = np.asarray(ideal, dtype=np.float64).reshape(-1, 2)
    wrong = ~(np.abs(distort(camera, ideal) - bent).max(axis=1) < 1e-4)
    ideal[wrong] = np.nan
    return ideal


def mutual_matches(first: Array, second: Array) -> Array:
    """(K, 2) indices of mutual best matches that pass the ratio test, of unit descriptors."""
    if len(first) < 2 or len(second) < 2:
        return np.zeros((0, 2), np.int64)
    similarity = first @ second.T
    forward = similarity.argmax(axis=1)
    rows = np.flatnonzero(similarity.argmax(axis=0)[forward] == np.arange(len(first)))
    top = np.partition(similarity[rows], -2, axis=1)[:, -2:]
    distance = np.sqrt(np.maximum(2 - 2 * top, 0))
    rows = rows[distance[:, 1] < RATIO * distance[:, 0]]
    return np.stack([rows, forward[rows]], axis=1)


def epipolar_distance(second_from_first: Array, first: Array, second: Array) -> Array:
    """(K,) Sampson distances of (K, 2) ideal image-plane points of two cameras, in image-plane units (times focal: pixels).

    To first order how far both points together are from a pair that one point in space explains (Hartley and Zisserman, eq. 11.9).
    """
    t = second_from_first[:3, 3] / max(float(np.linalg.norm(second_from_first[:3, 3])), 1e-15)
    essential = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]]) @ second_from_first[:3, :3]
    x1, x2 = (np.concatenate([points, np.ones((len(points), 1))], axis=1) for points in (first, second))
    line2, line1 = x1 @ essential.T, x2 @ essential
    slope = np.sqrt(np.maximum((line2[:, :2] ** 2).sum(axis=1) + (line1[:, :2] ** 2).sum(axis=1), 1e-30))
    distance = np.abs((x2 * line2).sum(axis=1)) / slope
    return np.where(np.isfinite(distance), distance, np.inf)


def tracks(links: Array, owner: Array) -> tuple[Array, Array]:
    """Connected keypoints that are one point in the world.

    Args:
        links: (K, 2) matched keypoints, numbered across frames. owner: frame of each keypoint.

    Returns:
        (M,) track number from 0, ascending, and (M,) keypoint. Tracks that hold one frame twice are dropped.
    """
    graph = coo_array((np.ones(len(links), bool), links.T), shape=(len(owner),) * 2)
    component = connected_components(graph, directed=False)[1]  # numbered by their first keypoints
    nodes = np.unique(links)
    number = np.unique(component[nodes], return_inverse=True)[1]
    order = np.lexsort((owner[nodes], number))
    number, nodes = number[order], nodes[order]
    twice = (np.diff(number) == 0) & (np.diff(owner[nodes]) == 0)
    keep = ~np.isin(number, number[1:][twice])
    return np.unique(number[keep], return_inverse=True)[1], nodes[keep]


def intersect(poses: Array, frame: Array, image_plane: Array, track: Array, tolerance: Array) -> tuple[Array, Array, Array, Array]:
    """Where the rays of each track meet.

    Args:
        poses: (N, 4, 4). frame, track, tolerance: (M,) of each observation, tolerance in image-plane units. image_plane: (M, 2).

    Returns:
        points (P, 3); and of the observations kept: point index (K,), index into the M given (K,), depth along z (K,).
    """
    empty = np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0)
    if len(track) == 0:
        return empty
    count = int(track.max()) + 1
    centres = poses[frame, :3, 3]
    rays = np.einsum("mij,mj->mi", poses[frame, :3, :3], np.concatenate([image_plane, np.ones((len(frame), 1))], axis=1))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    usable = np.ones(len(track), dtype=bool)
    weights = np.ones(len(track))
    points = np.zeros((count, 3))
    error = np.zeros(len(track))
    z = np.zeros(len(track))
    for _ in range(4):
        points = _closest(centres, rays, track, weights * usable, count)
        local = np.einsum("mij,mi->mj", poses[frame, :3, :3], points[track] - centres)  # (M, 3) camera axes
        z = local[:, 2]
        front = np.where(z > 1e-12, z, 1.0)
        error = np.where(z > 1e-12, np.linalg.norm(local[:, :2] / front[:, None] - image_plane, axis=1), np.inf)
        # Distances from rays, divided by depth, are reprojection errors.
        weights = 1.0 / np.maximum(np.einsum("mi,mi->m", local, local), 1e-24)
        usable &= error < 4 * tolerance
    bad = np.zeros(count, dtype=bool)
    np.logical_or.at(bad, track[usable], (error > tolerance)[usable])
    enough = np.bincount(track[usable], minlength=count) >= 2
    good = enough & ~bad & (_spread(centres, points, track, usable, count) > MIN_ANGLE)
    kept = np.flatnonzero(usable & good[track])
    renumber = np.cumsum(good) - 1
    return points[good], renumber[track[kept]], kept, z[kept]


def _closest(centres: Array, rays: Array, track: Array, weights: Array, count: int) -> Array:
    """(count, 3) least-squares points closest to the weighted rays of each track."""
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    normal, side = np.zeros((count, 3, 3)), np.zeros((count, 3))
    np.add.at(normal, track, weights[:, None, None] * across)
    np.add.at(side, track, weights[:, None] * np.einsum("mij,mj->mi", across, centres))
    size = np.maximum(np.trace(normal, axis1=1, axis2=2), 1e-300)[:, None, None]
    solved: Array = np.linalg.solve(normal / size + 1e-12 * np.eye(3), (side / size[:, 0])[..., None])[..., 0]
    return solved


def _spread(centres: Array, points: Array, track: Array, usable: Array, count: int) -> Array:
    """(count,) degrees between a track's first ray and the one farthest from it: exact for two views, a lower bound of the widest for
    more."""
    towards = centres - points[track]
    towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-15)
    first = np.zeros((count, 3))
    kept = np.flatnonzero(usable)[::-1]
    first[track[kept]] = towards[kept]  # written last to first: the first stays
    angle = np.degrees(np.arccos(np.clip(np.einsum("mi,mi->m", towards, first[track]), -1, 1)))
    widest = np.zeros(count)
    np.maximum.at(widest, track[usable], angle[usable])
    return widest
