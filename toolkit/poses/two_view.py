"""Matches between posed images, found without their poses, and how far they are off the epipolar geometry of any poses.

Pairs are chosen by order and by what the images share; matches are verified by a fundamental matrix of their own. So they are
evidence about the given poses, not an echo of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from fieldfuse.camera import Array, Intrinsics, invert
from fieldfuse.capture.images import turns_by_exif
from fieldfuse.capture.types import Capture
from fieldfuse.poses.pairs import coarse, common
from fieldfuse.poses.points import Features, features_of, mutual_matches, undistorted
from fieldfuse.progress import SILENT, Progress

RANKS = (0, 1, 3, 6)  # of the images most alike, those that an image is matched with: the first ones are often too near for parallax
ALIKE = 6  # coarse features in common that make a pair worth matching
STEPS = (1, 2)  # images further on that an image is matched with, where these are the capture's neighbours
MIN_INLIERS = 20  # matches that a fundamental matrix must explain
INLIER = 1.5  # working pixels off the epipolar line of the pair's own fundamental matrix
MAX_MATCHES = 60  # matches of a pair that count, so that no pair outweighs the others
AGREES = 3 / 640  # of the long side: how far off its epipolar line a match may lie that agrees with the poses
LEAST_PIXELS = 1.2  # working pixels: the same, at least
ONE_SPOT = 1e-9  # of the cameras' spread: two cameras nearer to each other stand on one spot
PARALLAX = 1.5  # degrees between rays, the median of a pair, from which its own essential matrix can be relied on
ROTATION, DIRECTION = 12.0, 40.0  # degrees by which rotation, and direction of motion, of noisy poses may be off


@dataclass(frozen=True)
class Matches:
    """P verified pairs of N images, K matches sorted by pair."""

    pairs: Array  # (P, 2) int, indices of images
    pair: Array  # (K,) int
    here: Array  # (K, 2) ideal image-plane points (x/z, y/z) in the first image
    there: Array  # (K, 2) in the second
    focal: Array  # (P,) working pixels
    tolerance: Array  # (P,) working pixels within which a match agrees with poses

    def by_pair(self, agrees: Array) -> Array:
        """(P,) share of each pair's matches for which `agrees` (K,) holds."""
        count = np.maximum(np.bincount(self.pair, minlength=len(self.pairs)), 1)
        return np.asarray(np.bincount(self.pair, agrees, len(self.pairs)) / count)

    def subset(self, keep: Array) -> Matches:
        """The pairs for which `keep` (P,) bool holds; images keep their numbers."""
        taken = keep[self.pair]
        pair, here, there = (np.cumsum(keep) - 1)[self.pair[taken]], self.here[taken], self.there[taken]
        return Matches(self.pairs[keep], pair, here, there, self.focal[keep], self.tolerance[keep])

    def without(self, images: Array) -> Array:
        """(P,) whether a pair holds none of the `images` (N,) bool."""
        return ~(images[self.pairs[:, 0]] | images[self.pairs[:, 1]])

    def refocused(self, factor: float, shift: Array) -> Matches:
        """The same matches seen through cameras of `factor` times the focal length whose image-plane points lie `shift` (N, 2) further."""
        first, second = (shift[self.pairs[self.pair, side]] for side in (0, 1))
        return replace(self, here=(self.here + first) / factor, there=(self.there + second) / factor, focal=self.focal * factor)


def find_matches(
    capture: Capture,
    frames: Sequence[int],
    links: Sequence[tuple[int, int]] = (),
    *,
    alike: Sequence[int] | None = None,
    progress: Progress = SILENT,
    known: dict[str, Features] | None = None,
) -> Matches:
    """Match some of a capture's images (`frames`, ascending indices; intrinsics given), and verify each pair by itself.

    Args:
        links: pairs to match beside those that order and likeness suggest, as positions in `frames`.
        alike: positions of the images that all are compared with; None: all with all.
        known: features of images by name; what is found now is added.

    Raises:
        InputError: an image cannot be read.
    """
    known = {} if known is None else known
    exif = turns_by_exif(capture)
    seen: list[tuple[Features, Array, Array]] = []
    cameras: list[Intrinsics] = []
    for number, index in enumerate(frames):
        frame = capture.frames[index]
        assert frame.intrinsics is not None
        progress.check()
        progress.update(number, 2 * len(frames), f"checking poses, image {number + 1} of {len(frames)}")
        found = known.get(frame.name)
        if found is None:
            found = known[frame.name] = features_of(frame, frame.intrinsics, exif)
        cameras.append(frame.intrinsics)
        sketch = coarse(found.descriptor, found.size) if len(found.size) else found.descriptor
        seen.append((found, undistorted(frame.intrinsics, found.pixel), sketch))
    pairs = _choose(list(frames), [sketch for _, _, sketch in seen], links, alike)
    columns: list[tuple[Array, Array]] = []
    facts: list[tuple[int, int, float, float]] = []
    for number, (i, j) in enumerate(pairs):
        progress.check()
        progress.update(len(frames) * (1 + number / len(pairs)), 2 * len(frames), f"checking poses, pair {number + 1} of {len(pairs)}")
        (one, flat, _), (other, flat2, _) = seen[i], seen[j]
        found_pairs = mutual_matches(one.descriptor, other.descriptor)
        focal = 0.5 * sum(0.5 * (camera.fx + camera.fy) * look.scale for camera, look in ((cameras[i], one), (cameras[j], other)))
        here, there = _verified(flat[found_pairs[:, 0]], flat2[found_pairs[:, 1]], focal)
        if len(here) < MIN_INLIERS:
            continue
        side = max(cameras[i].width, cameras[i].height) * one.scale
        facts.append((i, j, focal, max(AGREES * side, LEAST_PIXELS)))
        spread = np.linspace(0, len(here) - 1, min(MAX_MATCHES, len(here))).round().astype(int)
        columns.append((here[spread], there[spread]))
    table = np.array(facts, dtype=np.float64).reshape(-1, 4)
    empty = np.zeros((0, 2))
    return Matches(
        pairs=table[:, :2].astype(np.int64),
        pair=np.repeat(np.arange(len(columns)), [len(here) for here, _ in columns]).astype(np.int64),
        here=np.concatenate([here for here, _ in columns]) if columns else empty,
        there=np.concatenate([there for _, there in columns]) if columns else empty,
        focal=table[:, 2],
        tolerance=table[:, 3],
    )


def _choose(
    frames: list[int], sketches: list[Array], links: Sequence[tuple[int, int]], alike: Sequence[int] | None
) -> list[tuple[int, int]]:
    """Pairs (i, j), i < j, of neighbours in order, of images that share coarse features, and `links`."""
    count = len(frames)
    chosen = {(min(i, j), max(i, j)) for i, j in links if i != j}
    chosen |= {(i, i + step) for step in STEPS for i in range(count - step) if frames[i + step] - frames[i] <= step}
    shared = np.zeros((count, count), dtype=int)
    for j in range(count) if alike is None else alike:
        for i in range(count) if alike is not None else range(j):
            shared[i, j] = shared[j, i] = common(sketches[i], sketches[j]) if i != j else 0
    for i in range(count):
        likely = [int(j) for j in np.argsort(-shared[i], kind="stable") if shared[i, j] >= ALIKE]
        chosen |= {(min(i, likely[rank]), max(i, likely[rank])) for rank in RANKS if rank < len(likely)}
    return sorted(chosen)


def _verified(here: Array, there: Array, focal: float) -> tuple[Array, Array]:
    """Those of the matched image-plane points (M, 2) that one fundamental matrix explains."""
    finite = np.isfinite(here).all(axis=1) & np.isfinite(there).all(axis=1)
    here, there = here[finite], there[finite]
    if len(here) < MIN_INLIERS:
        return here[:0], there[:0]
    cv2.setRNGSeed(0)
    try:
        _, inlier = cv2.findFundamentalMat(here * focal, there * focal, cv2.USAC_MAGSAC, INLIER, 0.999, 1000)
    except cv2.error:  # OpenCV fails an assertion of its own where no sample gives a model that it can refine
        _, inlier = cv2.findFundamentalMat(here * focal, there * focal, cv2.FM_RANSAC, INLIER, 0.999, 1000)
    keep = np.zeros(len(here), bool) if inlier is None else inlier.ravel() > 0
    return here[keep], there[keep]


def deviation(poses: Array, matches: Matches) -> Array:
    """(K,) how far each match is off what `poses` (N, 4, 4) world_from_camera allow, in units of the tolerance: up to 1 agrees.

    That is the Sampson distance from the epipolar line. A match whose rays meet behind a camera is off by half the angle between them, if
    that is more. Where both cameras stand on one spot, it is the distance from where the rotation takes the point.
    """
    relative = invert(poses[matches.pairs[:, 1]]) @ poses[matches.pairs[:, 0]]  # second camera from first
    rotation, way = relative[:, :3, :3], relative[:, :3, 3]
    length = np.linalg.norm(way, axis=1)
    centres = poses[:, :3, 3]
    spread = float(np.median(np.linalg.norm(centres - np.median(centres, axis=0), axis=1)))
    on_spot = length <= ONE_SPOT * max(spread, 1e-300)
    way = (way / np.maximum(length, 1e-300)[:, None])[matches.pair]
    one = np.concatenate([matches.here, np.ones((len(matches.here), 1))], axis=1)
    other = np.concatenate([matches.there, np.ones((len(matches.there), 1))], axis=1)
    turned = np.einsum("kij,kj->ki", rotation[matches.pair], one)
    line = np.cross(way, turned)  # in the second image
    back = np.einsum("kij,ki->kj", rotation[matches.pair], np.cross(other, way))  # in the first
    slope = np.sqrt(np.maximum((line[:, :2] ** 2).sum(axis=1) + (back[:, :2] ** 2).sum(axis=1), 1e-30))
    off = np.abs((other * line).sum(axis=1)) / slope
    rays = [ray / np.linalg.norm(ray, axis=1, keepdims=True) for ray in (turned, other)]
    normal = np.cross(rays[0], rays[1])
    behind = ((np.cross(other, way) * normal).sum(axis=1) < 0) | ((np.cross(rays[0], way) * normal).sum(axis=1) < 0)
    angle = np.arctan2(np.linalg.norm(normal, axis=1), (rays[0] * rays[1]).sum(axis=1))
    off = np.where(behind, np.maximum(off, 0.5 * angle), off)
    spot = on_spot[matches.pair]
    if spot.any():
        ahead = turned[:, 2] > 1e-6
        landed = turned[:, :2] / np.where(ahead, turned[:, 2], 1.0)[:, None]
        off = np.where(spot, np.where(ahead, np.linalg.norm(landed - matches.there, axis=1), np.inf), off)
    return np.asarray(off * (matches.focal / matches.tolerance)[matches.pair])


def own_motions(matches: Matches) -> tuple[Array, Array, Array]:
    """Rotation and direction by each pair's own essential matrix.

    Returns:
        (P, 3, 3) rotation and (P, 3) direction, second camera from first, and (P,) degrees between the rays of its matches in the median
        (0 where no essential matrix was found).
    """
    count = len(matches.pairs)
    rotations, directions, angles = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)), np.zeros(count)
    for number in range(count):
        mine = matches.pair == number
        here, there = matches.here[mine], matches.there[mine]
        cv2.setRNGSeed(0)
        essential, _ = cv2.findEssentialMat(here, there, np.eye(3), cv2.RANSAC, 0.999, INLIER / matches.focal[number])
        if essential is None or essential.shape != (3, 3):
            continue
        _, rotation, direction, _ = cv2.recoverPose(essential, here, there, np.eye(3))
        rays = [np.concatenate([points, np.ones((len(points), 1))], axis=1) for points in (here, there)]
        rays[0] = rays[0] @ rotation.T
        cosine = (rays[0] * rays[1]).sum(axis=1) / np.linalg.norm(rays[0], axis=1) / np.linalg.norm(rays[1], axis=1)
        rotations[number], directions[number] = rotation, direction[:, 0]
        angles[number] = np.degrees(np.median(np.arccos(np.clip(cosine, -1, 1))))
    return rotations, directions, angles


def roughly_right(poses: Array, matches: Matches) -> Array:
    """Of the pairs with parallax, whether `poses` turn and move the camera roughly as the pair's own essential matrix does."""
    rotations, directions, angles = own_motions(matches)
    relative = invert(poses[matches.pairs[:, 1]]) @ poses[matches.pairs[:, 0]]
    cosine = (np.einsum("pij,pij->p", rotations, relative[:, :3, :3]) - 1) / 2
    turned = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    length = np.maximum(np.linalg.norm(relative[:, :3, 3], axis=1), 1e-300)
    aside = np.degrees(np.arccos(np.clip((directions * relative[:, :3, 3]).sum(axis=1) / length, -1, 1)))
    return np.asarray(((turned < ROTATION) & (aside < DIRECTION))[angles >= PARALLAX])
