"""Points that several images show, found quickly with the poses that there are: what all evidence of effects is made of.

Matches are held against the epipolar geometry with a wide tolerance: an unknown lens, rows one after the other, or poses that are a
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
from fieldfuse.effects.light import LightTracks
from fieldfuse.poses.points import detect_sift, find_tracks, neighbour_pairs, undistorted
from fieldfuse.progress import SILENT, Progress
from fieldfuse.tone import LINEAR

LONG_SIDE = 480  # pixels that features are looked for on
LOOSE = 0.025  # of the long side: how far off its epipolar line a match may lie
MIN_IMAGES = 3  # images that show a point
WINDOW = 4.0  # working pixels: deviation of the window that slopes are weighted with
LEVELS = 8  # of blur for colors, each √2 of the one before
FIRST = 0.8  # working pixels: the least of them
RUN = 4  # images next to each other that are looked at together: motion shows between neighbours only


@dataclass(frozen=True)
class Effort:
    """How closely images are looked at."""

    long_side: int = LONG_SIDE
    features: int = 700  # an image
    neighbours: int = 5


FULL, QUICK = Effort(), Effort(320, 450, 3)


@dataclass(frozen=True)
class Tracks:
    """F images, P points, O observations of them, sorted by point."""

    names: list[str]  # (F)
    cameras: list[Intrinsics]  # (F) as the capture gives them
    poses: Array  # (F, 4, 4) float64 world_from_camera
    times: Array  # (F,) in steps of the capture, ascending where images follow each other; NaN: not known
    scale: Array  # (F,) working pixels a pixel of the image
    frame: Array  # (O,) int
    point: Array  # (O,) int
    pixel: Array  # (O, 2) in the image's own pixels, centres at +0.5
    linear: Array  # (O, 3) linear light of the patch
    slope: Array  # (O,) mean of gx² + gy² around it, of log light, in working pixels
    images: tuple[Array, ...] = ()  # (F) working images, (h, w) uint8 grey

    @property
    def points(self) -> int:
        return int(self.point.max(initial=-1)) + 1

    @property
    def focal(self) -> Array:
        """(F,) working pixels."""
        return np.array([0.5 * (camera.fx + camera.fy) for camera in self.cameras]) * self.scale

    def ideal(self) -> Array:
        """(O, 2) observed places on the ideal image plane (x/z, y/z), by the capture's own lens."""
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
        """(O,) share of the image's height, −1/2 at its top, +1/2 at its bottom."""
        height = np.array([c.height for c in self.cameras])[self.frame]
        return np.asarray(self.pixel[:, 1] / height - 0.5)

    def light(self) -> LightTracks:
        """Colors alone, for the evidence of what happens to light."""
        return LightTracks(self.linear, self.frame, self.point, self.radius())

    def rows(self, keep: Array) -> Tracks:
        """The observations `keep` (O,) bool; points that are then seen less than twice go, the rest are numbered anew."""
        counts = np.bincount(self.point[keep], minlength=self.points)
        keep = keep & (counts[self.point] > 1)
        parts = {name: getattr(self, name)[keep] for name in ("frame", "pixel", "linear", "slope")}
        return replace(self, point=np.unique(self.point[keep], return_inverse=True)[1], **parts)


@dataclass(frozen=True)
class Look:
    """What one image shows: N features."""

    pixel: Array  # (N, 2)
    descriptor: Array  # (N, 128)
    linear: Array  # (N, 3)
    slope: Array  # (N,)
    scale: float
    grey: Array  # (h, w) uint8


def gather(
    capture: Capture, chosen: Sequence[int], progress: Progress = SILENT, effort: Effort = FULL, known: dict[int, Look] | None = None
) -> Tracks:
    """Look for points in the images `chosen` (indices into the frames, all posed), match each with a few that overlap and the next two.

    Args:
        known: what was found in images with the same effort before; what is found now is added.

    Raises:
        InputError: an image cannot be read.
    """
    known = {} if known is None else known
    frames = [capture.frames[index] for index in chosen]
    cameras = [frame.intrinsics for frame in frames if frame.intrinsics is not None]
    poses = np.array([frame.world_from_camera for frame in frames], dtype=np.float64).reshape(-1, 4, 4)
    exif = turns_by_exif(capture)
    for number, (index, frame) in enumerate(zip(chosen, frames, strict=True)):
        progress.check()
        progress.update(number, 2 * len(frames), f"looking for effects, picture {number + 1} of {len(frames)}")
        if index not in known:
            known[index] = _look(load_image(frame, exif=exif), load_mask(frame, exif=exif), cameras[number], effort)
    seen = [known[index] for index in chosen]

    def tick(done: int, of: int) -> None:
        progress.check()
        progress.update(len(frames) * (1 + done / of), 2 * len(frames), f"looking for effects, pair {done + 1}")

    flat = [undistorted(camera, look.pixel) for camera, look in zip(cameras, seen, strict=True)]
    following = {(i, i + step) for step in (1, 2) for i in range(len(poses) - step)}
    pairs = sorted(following | set(neighbour_pairs(poses, cameras, effort.neighbours))) if len(poses) > 1 else []
    tolerance = [LOOSE * max(cameras[i].width, cameras[i].height) / (0.5 * (cameras[i].fx + cameras[j].fx)) for i, j in pairs]
    owner, point, node = find_tracks(poses, flat, [look.descriptor for look in seen], pairs, tolerance, tick)
    often = np.bincount(point)[point] >= MIN_IMAGES if len(point) else np.zeros(0, bool)
    point, node = np.unique(point[often], return_inverse=True)[1], node[often]
    columns = {name: np.concatenate([getattr(look, name) for look in seen])[node] for name in ("pixel", "linear", "slope")}
    return Tracks(
        names=[frame.name for frame in frames],
        cameras=cameras,
        poses=poses,
        times=_times(frames),
        scale=np.array([look.scale for look in seen]),
        frame=owner[node],
        point=point,
        images=tuple(look.grey for look in seen),
        **columns,
    )


def choose(count: int, most: int) -> list[int]:
    """At most `most` of `count` images, in runs of neighbours spread over the capture."""
    if count <= most:
        return list(range(count))
    starts = np.linspace(0, count - RUN, max(1, most // RUN)).round().astype(int)
    return sorted({int(start) + step for start in starts for step in range(RUN)})


def _times(frames: list[Frame]) -> Array:
    """(F,) the number that a file's name ends in: videos' frames and most cameras' images are counted. NaN where there is none."""
    numbers = [re.search(r"(\d+)\D*$", frame.name) for frame in frames]
    values = np.array([np.nan if found is None else float(found.group(1)) for found in numbers])
    return values if np.all(np.diff(values) > 0) else np.full(len(frames), np.nan)


def _look(image: Array, mask: Array | None, camera: Intrinsics, effort: Effort) -> Look:
    height, width = image.shape[:2]
    scale = min(1.0, effort.long_side / max(width, height))
    small = np.ascontiguousarray(image[..., :3])
    if scale < 1:
        small = np.asarray(cv2.resize(small, (round(width * scale), round(height * scale)), interpolation=cv2.INTER_AREA))
    grey = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY)
    at, size, descriptors = detect_sift(grey, effort.features, 0.012)
    log = np.log2(np.maximum(LINEAR[grey], LINEAR[8]))
    gx, gy = cv2.Sobel(log, cv2.CV_32F, 1, 0, scale=0.125), cv2.Sobel(log, cv2.CV_32F, 0, 1, scale=0.125)
    slopes = cv2.GaussianBlur(np.stack([gx * gx, gx * gy, gy * gy], axis=2), (0, 0), WINDOW)  # of two channels OpenCV samples coarsely
    keep = np.ones(len(at), dtype=bool)
    for shown in (image[..., 3] if image.shape[2] == 4 else None, None if mask is None else mask.astype(np.uint8) * 255):
        if shown is not None:
            solid = cv2.resize(shown, (small.shape[1], small.shape[0]), interpolation=cv2.INTER_AREA) >= 250
            keep &= solid[np.clip(np.rint(at[:, 1]).astype(int), 0, None), np.clip(np.rint(at[:, 0]).astype(int), 0, None)]
    if len(at):
        slopes = cv2.remap(slopes, at[None, :, 0], at[None, :, 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    slope = slopes.reshape(-1, 3)[: len(at)]
    return Look(
        pixel=((at.astype(np.float64) + 0.5) * [camera.width / small.shape[1], camera.height / small.shape[0]])[keep],
        descriptor=descriptors[keep],
        linear=_around(LINEAR[small], at[keep], 0.5 * size[keep]),
        slope=slope[keep].astype(np.float64)[:, ::2].sum(1),
        scale=scale * width / camera.width,
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
