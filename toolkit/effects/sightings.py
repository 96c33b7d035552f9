"""Points that several pictures show, found quickly with the poses that there are: what all evidence of effects is made of.

Matches are held against the epipolar geometry with a wide tolerance: a lens that nobody told, rows one after the other, or poses that are a
little off must not remove the very points that show them.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.capture.images import load_image, load_mask, turns_by_exif
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.effects.evidence import Tracks
from fieldfuse.poses.overlap import best_neighbours, guessed_depth, overlap, parallax
from fieldfuse.poses.points import epipolar_distance, mutual_matches, tracks, undistorted
from fieldfuse.progress import SILENT, Progress
from fieldfuse.tone import LINEAR

LONG_SIDE = 480  # pixels that features are looked for on
FEATURES = 700  # a picture
NEIGHBOURS = 5
LOOSE = 0.025  # of the long side: how far off its epipolar line a match may lie
MIN_IMAGES = 3  # pictures that show a point
WINDOW = 4.0  # working pixels: deviation of the window that slopes are weighted with
LEVELS = 8  # of blur for colours, each √2 of the one before
FIRST = 0.8  # working pixels: the least of them


@dataclass(frozen=True)
class Effort:
    """How closely pictures are looked at."""

    long_side: int = LONG_SIDE
    features: int = FEATURES
    neighbours: int = NEIGHBOURS


FULL, QUICK = Effort(), Effort(320, 450, 3)


@dataclass(frozen=True)
class Sightings:
    """F pictures, P points, O observations of them, sorted by point."""

    names: list[str]  # (F)
    cameras: list[Intrinsics]  # (F) as the capture gives them
    poses: Array  # (F, 4, 4) float64 world_from_camera
    times: Array  # (F,) in steps of the capture, ascending where pictures follow each other; NaN: not known
    scale: Array  # (F,) working pixels a pixel of the picture
    frame: Array  # (O,) int
    point: Array  # (O,) int
    pixel: Array  # (O, 2) in the picture's own pixels, centres at +0.5
    linear: Array  # (O, 3) linear light of the patch
    slope: Array  # (O, 3) mean of gx², gx·gy, gy² around it, of log light, in working pixels
    size: Array  # (O,) working pixels: deviation of the blob that was found
    sharpness: Array  # (F,) root mean square of the slopes of log light at the points
    pictures: tuple[Array, ...] = ()  # (F) working pictures, (h, w) uint8 grey

    @property
    def points(self) -> int:
        return int(self.point.max(initial=-1)) + 1

    @property
    def focal(self) -> Array:
        """(F,) working pixels."""
        return np.array([0.5 * (camera.fx + camera.fy) for camera in self.cameras]) * self.scale

    def ideal(self) -> Array:
        """(O, 2) observed places on the ideal image plane (x/z, y/z), by the lens that the capture tells."""
        out = np.full((len(self.frame), 2), np.nan)
        for index, camera in enumerate(self.cameras):
            mine = self.frame == index
            out[mine] = undistorted(camera, self.pixel[mine])
        return out

    def radius(self) -> Array:
        """(O,) distance from the principal point in half diagonals."""
        centre = np.array([[c.cx, c.cy] for c in self.cameras])[self.frame]
        half = np.array([0.5 * np.hypot(c.width, c.height) for c in self.cameras])[self.frame]
        return np.asarray(np.linalg.norm(self.pixel - centre, axis=1) / half)

    def row(self) -> Array:
        """(O,) share of the picture's height, −1/2 at its top, +1/2 at its bottom."""
        height = np.array([c.height for c in self.cameras])[self.frame]
        return np.asarray(self.pixel[:, 1] / height - 0.5)

    def tracks(self) -> Tracks:
        """Colours alone, for the evidence of what happens to light."""
        return Tracks(self.linear, self.frame, self.point, self.radius())

    def where(self, keep: Array) -> Sightings:
        """The observations `keep` (O,) bool; points that are then seen less than twice go, the rest are numbered anew."""
        counts = np.bincount(self.point[keep], minlength=self.points)
        keep = keep & (counts[self.point] > 1)
        parts = {name: getattr(self, name)[keep] for name in ("frame", "pixel", "linear", "slope", "size")}
        return replace(self, point=np.unique(self.point[keep], return_inverse=True)[1], **parts)


def gather(
    capture: Capture, chosen: Sequence[int], progress: Progress = SILENT, effort: Effort = FULL, known: dict[int, Look] | None = None
) -> Sightings:
    """Look for points in the pictures `chosen` (indices into the frames, all posed), match each picture with a few that overlap.

    Args:
        known: what was found in pictures with the same effort before; what is found now is added.

    Raises:
        InputError: a picture cannot be read.
    """
    frames = [capture.frames[index] for index in chosen]
    cameras = [frame.intrinsics for frame in frames if frame.intrinsics is not None]
    poses = np.array([frame.world_from_camera for frame in frames], dtype=np.float64).reshape(-1, 4, 4)
    seen = []
    exif = turns_by_exif(capture)
    for number, frame in enumerate(frames):
        progress.check()
        progress.update(number, 2 * len(frames), f"looking for effects, picture {number + 1} of {len(frames)}")
        look = None if known is None else known.get(chosen[number])
        if look is None:
            look = _look(load_image(frame, exif=exif), load_mask(frame, exif=exif), cameras[number], effort)
            if known is not None:
                known[chosen[number]] = look
        seen.append(look)
    starts = np.concatenate([[0], np.cumsum([len(look.pixel) for look in seen])])
    flat = [undistorted(camera, look.pixel) for camera, look in zip(cameras, seen, strict=True)]
    links = []
    pairs = _pairs(poses, cameras, effort.neighbours)
    for number, (i, j) in enumerate(pairs):
        progress.check()
        progress.update(len(frames) + len(frames) * number / len(pairs), 2 * len(frames), f"looking for effects, pair {number + 1}")
        found = mutual_matches(seen[i].descriptor, seen[j].descriptor)
        if len(found):
            focal = 0.5 * (cameras[i].fx + cameras[j].fx)
            off = epipolar_distance(poses[i], poses[j], flat[i][found[:, 0]], flat[j][found[:, 1]]) * focal
            found = found[off < LOOSE * max(cameras[i].width, cameras[i].height)]
            links.append(np.stack([found[:, 0] + starts[i], found[:, 1] + starts[j]], axis=1))
    owner = np.repeat(np.arange(len(frames)), [len(look.pixel) for look in seen])
    point, node = tracks(np.concatenate(links) if links else np.zeros((0, 2), np.int64), owner)
    often = np.bincount(point)[point] >= MIN_IMAGES if len(point) else np.zeros(0, bool)
    point, node = np.unique(point[often], return_inverse=True)[1], node[often]
    columns = {name: np.concatenate([getattr(look, name) for look in seen])[node] for name in ("pixel", "linear", "slope", "size")}
    return Sightings(
        names=[frame.name for frame in frames],
        cameras=cameras,
        poses=poses,
        times=_times(frames),
        scale=np.array([look.scale for look in seen]),
        frame=owner[node],
        point=point,
        sharpness=np.array([look.sharpness for look in seen]),
        pictures=tuple(look.grey for look in seen),
        **columns,
    )


def choose(count: int, most: int) -> list[int]:
    """At most `most` of `count` pictures, in runs of neighbours spread over the capture: motion shows between neighbours only."""
    if count <= most:
        return list(range(count))
    run = 4
    runs = max(1, most // run)
    starts = np.linspace(0, count - run, runs).round().astype(int)
    return sorted({int(start) + step for start in starts for step in range(run)})


def _pairs(poses: Array, cameras: list[Intrinsics], neighbours: int) -> list[tuple[int, int]]:
    """Each picture with those that overlap under good parallax, and with the next two."""
    if len(poses) < 2:
        return []
    depth = guessed_depth(poses)
    partners = best_neighbours(poses, overlap(poses, cameras, depth), parallax(poses, depth), neighbours)
    out = {(min(i, int(j)), max(i, int(j))) for i in range(len(poses)) for j in partners[i]}
    return sorted(out | {(i, i + step) for step in (1, 2) for i in range(len(poses) - step)})


def _times(frames: list[Frame]) -> Array:
    """(F,) the number that a file's name ends in: videos' frames and most cameras' pictures are counted. NaN where there is none."""
    numbers = [re.search(r"(\d+)\D*$", frame.name) for frame in frames]
    values = np.array([np.nan if found is None else float(found.group(1)) for found in numbers])
    return values if np.all(np.diff(values) > 0) else np.full(len(frames), np.nan)


@dataclass(frozen=True)
class Look:
    """What one picture shows."""

    pixel: Array  # (N, 2)
    descriptor: Array  # (N, 128)
    linear: Array  # (N, 3)
    slope: Array  # (N, 3)
    size: Array  # (N,)
    scale: float
    sharpness: float
    grey: Array  # (h, w) uint8


def _look(picture: Array, mask: Array | None, camera: Intrinsics, effort: Effort) -> Look:
    height, width = picture.shape[:2]
    scale = min(1.0, effort.long_side / max(width, height))
    small = np.ascontiguousarray(picture[..., :3])
    if scale < 1:
        small = np.asarray(cv2.resize(small, (round(width * scale), round(height * scale)), interpolation=cv2.INTER_AREA))
    grey = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY)
    keypoints, descriptors = cv2.SIFT.create(nfeatures=effort.features, contrastThreshold=0.012).detectAndCompute(grey, None)
    if descriptors is None or len(keypoints) == 0:
        empty = np.zeros((0, 3))
        return Look(np.zeros((0, 2)), np.zeros((0, 128), np.float32), empty, empty, np.zeros(0), scale * width / camera.width, 0.0, grey)
    at = np.array([k.pt for k in keypoints], dtype=np.float32)  # whole-number pixel centres
    size = 0.5 * np.array([k.size for k in keypoints], dtype=np.float32)
    log = np.log2(np.maximum(LINEAR[grey], LINEAR[8]))
    gx, gy = cv2.Sobel(log, cv2.CV_32F, 1, 0, scale=0.125), cv2.Sobel(log, cv2.CV_32F, 0, 1, scale=0.125)
    slopes = cv2.GaussianBlur(np.stack([gx * gx, gx * gy, gy * gy], axis=2), (0, 0), WINDOW)
    place = at[None, :, 0], at[None, :, 1]
    pixel = (at.astype(np.float64) + 0.5) * [camera.width / small.shape[1], camera.height / small.shape[0]]
    rooted = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-6)).astype(np.float32)
    keep = np.ones(len(at), dtype=bool)
    for shown in (picture[..., 3] if picture.shape[2] == 4 else None, None if mask is None else mask.astype(np.uint8) * 255):
        if shown is not None:
            solid = cv2.resize(shown, (small.shape[1], small.shape[0]), interpolation=cv2.INTER_AREA) >= 250
            keep &= solid[np.clip(np.rint(at[:, 1]).astype(int), 0, None), np.clip(np.rint(at[:, 0]).astype(int), 0, None)]
    slope = cv2.remap(slopes, *place, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[0]
    return Look(
        pixel=pixel[keep],
        descriptor=rooted[keep],
        linear=_around(LINEAR[small], at[keep], size[keep]),
        slope=slope[keep].astype(np.float64),
        size=size[keep].astype(np.float64),
        scale=scale * width / camera.width,
        sharpness=float(np.sqrt((slope[keep][:, 0] + slope[keep][:, 2]).mean())) if keep.any() else 0.0,
        grey=grey,
    )


def _around(light: Array, at: Array, size: Array) -> Array:
    """(N, 3) light around places (N, 2), weighted by a Gaussian as wide as what was found there: from near and far the same patch."""
    level = np.clip(2 * np.log2(np.maximum(size, FIRST) / FIRST), 0, LEVELS - 1.001)
    below = level.astype(int)
    out = np.zeros((len(at), 3))
    blurred, deviation = light, 0.0
    for number in range(LEVELS):
        wanted = FIRST * 2 ** (number / 2)
        blurred, deviation = cv2.GaussianBlur(blurred, (0, 0), float(np.sqrt(wanted**2 - deviation**2))), wanted
        share = np.where(below == number, 1 - (level - below), np.where(below == number - 1, level - below, 0))
        mine = share > 0
        if mine.any():
            values = cv2.remap(blurred, at[None, mine, 0], at[None, mine, 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            out[mine] += share[mine, None] * values.reshape(-1, 3)
    return out
