"""Images made ready for fitting and measuring: undistorted and resized once, depth and masks aligned, poses in the working frame."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace

import cv2
import numpy as np

from fieldfuse import memory
from fieldfuse.camera import Array, Intrinsics, Similarity, resample_maps, undistort_maps
from fieldfuse.capture.calibration import fitted
from fieldfuse.capture.images import load_depth, load_image, load_mask, turns_by_exif
from fieldfuse.capture.listing import natural_key
from fieldfuse.capture.types import Capture, Frame, Views
from fieldfuse.config import CaptureSettings
from fieldfuse.errors import InputError
from fieldfuse.progress import SILENT, Progress

DEFAULT_LONG_SIDE = 640
WHITE = (1.0, 1.0, 1.0)
LARGEST_SIDE = 2**30  # of images that stay as large as they were taken
_MAX_SAMPLES = 4  # samples a pixel and side taken through the lens; what shrinks more is averaged down to this first


def held_out(capture: Capture, holdout: int) -> Array:
    """(N,) bool, True for test views: the source's own split when it has one, else every `holdout`-th frame by name (0, n, 2n, …).

    Views that were cut out of one image are held out together: what one shows, its neighbour may show too. A `holdout` of 0 gives no test
    views, unless the source has a split. Training images alone (a `transforms_train.json` without others) are no split.
    """
    frames = capture.frames
    if any(frame.split == "test" for frame in frames):
        return np.array([frame.split == "test" for frame in frames], dtype=bool)
    test = np.zeros(len(frames), dtype=bool)
    if holdout > 0:
        for group in instants(capture)[::holdout]:
            test[group] = True
    return test


def instants(capture: Capture, among: Iterable[int] | None = None) -> list[list[int]]:
    """Indices of the frames (all, or `among` them) by name, those of one instant together."""
    groups: dict[str, list[int]] = {}
    for index in range(len(capture.frames)) if among is None else among:
        frame = capture.frames[index]
        groups.setdefault(frame.name if frame.instant is None else frame.instant, []).append(index)
    return [groups[name] for name in sorted(groups, key=natural_key)]


def limited(capture: Capture, holdout: int, limit: int | None) -> Capture:
    """`limit` evenly spread training images by name (all when there are no more), and every held-out one; the others are excluded. Views of
    one instant stay together, of one at least.

    Held-out images are the same whatever the limit is.
    """
    test = held_out(capture, holdout)
    train = np.flatnonzero(~test).tolist()
    if limit is None or limit >= len(train):
        return capture
    groups = instants(capture, train)
    stay = {index for place in evenly(len(groups), max(1, limit * len(groups) // len(train))) for index in groups[place]}
    return capture.with_frames(
        replace(frame, split="test" if test[index] else "train")  # with fewer frames every n-th is another
        for index, frame in enumerate(capture.frames)
        if test[index] or index in stay
    )


def evenly(count: int, some: int) -> list[int]:
    """`some` of `count` places, the first and the last among them; the middle one when it is a single one."""
    if some == 1:
        return [count // 2]
    return [int(place) for place in np.unique(np.linspace(0, count - 1, min(some, count)).round().astype(int))]


def prepare_views(capture: Capture, working_from_input: Similarity, settings: CaptureSettings, progress: Progress = SILENT) -> Views:
    """Every image of a posed capture as a pinhole image in the working frame, its long side `settings.image_size`.

    Images are never enlarged. Captures with alpha are composited on white before resampling. `valid` leaves out pixels that a
    mask excludes or that lie outside the lens's image; `depths` are in working units, taken from the nearest stored value.
    One frame is decoded at a time.

    Raises:
        InputError: a frame without pose or intrinsics, a file that cannot be read, an image of another shape than its camera, or more
            than there is memory for.
    """
    count = len(capture.frames)
    poses: list[Array] = []
    views = Views([], [], [], np.zeros((0, 4, 4)), held_out(capture, settings.holdout), background=WHITE if capture.alpha else None)
    long_side = settings.image_size or DEFAULT_LONG_SIDE
    size = expected_bytes(capture, long_side)
    memory.require(size, f"{count} images of {capture.root} at {long_side} pixels", "lower --image-size, or give fewer frames")
    shrink = _Shrinker(long_side)
    exif = turns_by_exif(capture)
    for index, frame in enumerate(capture.frames):
        progress.check()
        progress.update(index, count, frame.name)
        if frame.world_from_camera is None or frame.intrinsics is None:
            raise InputError(f"the frame {frame.name} of {capture.root} has no pose or no intrinsics; find poses first")
        source, colour, alpha = _loaded(frame, frame.intrinsics, capture, exif)
        target, image, seen = shrink(source, colour)
        usable = seen & _usable(frame, source, target, exif)
        views.names.append(frame.name)
        views.images.append(image)
        views.intrinsics.append(target)
        views.alpha.append(None if alpha is None else np.where(seen, shrink(source, alpha)[1], 0).astype(np.uint8))
        views.valid.append(None if usable.all() else usable)
        views.depths.append(
            None if frame.depth is None else _aligned_depth(frame, capture, source, target) * np.float32(working_from_input.scale)
        )
        poses.append(working_from_input.poses(frame.world_from_camera))
    views.world_from_camera = np.array(poses, dtype=np.float64).reshape(-1, 4, 4)
    progress.update(count, count)
    return views


def images_at(capture: Capture, indices: Iterable[int], long_side: int) -> Iterator[tuple[Intrinsics, Array]]:
    """The pinhole cameras and images (H, W, 3) uint8 of some frames as `prepare_views` makes them, in another size, one at a time.

    Raises:
        InputError: a frame without intrinsics, or a file that cannot be read.
    """
    shrink, exif = _Shrinker(long_side), turns_by_exif(capture)
    for index in indices:
        frame = capture.frames[index]
        if frame.intrinsics is None:
            raise InputError(f"the frame {frame.name} of {capture.root} has no intrinsics; find poses first")
        source, colour, _ = _loaded(frame, frame.intrinsics, capture, exif)
        target, image, _ = shrink(source, colour)
        yield target, image


def undistorted(capture: Capture) -> Iterator[tuple[Intrinsics, Array, Array]]:
    """For each frame of a posed capture, as large as it was taken: the pinhole camera, the image (H, W, 3) uint8, or (H, W, 4) where the
    capture has alpha, and (H, W) bool which pixels show the scene and are not masked out. One frame is decoded at a time.

    Raises:
        InputError: a frame without intrinsics, or a file that cannot be read.
    """
    shrink, exif = _Shrinker(LARGEST_SIDE), turns_by_exif(capture)
    for frame in capture.frames:
        if frame.intrinsics is None:
            raise InputError(f"the frame {frame.name} of {capture.root} has no intrinsics; find poses first")
        source, colour, alpha = _loaded(frame, frame.intrinsics, capture, exif)
        target, image, seen = shrink(source, colour)
        if alpha is not None:
            opaque = np.where(seen, shrink(source, alpha)[1], 0).astype(np.uint8)
            share = np.maximum(opaque, 1)[:, :, None].astype(np.float32) / 255
            image = np.clip((image - 255 * (1 - share)) / share, 0, 255).round().astype(np.uint8)  # without the white behind it
            image = np.dstack([image, opaque])
        yield target, image, seen & _usable(frame, source, target, exif)


def _loaded(frame: Frame, camera: Intrinsics, capture: Capture, exif: bool) -> tuple[Intrinsics, Array, Array | None]:
    """A frame's camera in the size of its file, the image (H, W, 3) uint8, and its alpha (H, W) if it is composited, on white."""
    image = load_image(frame, exif=exif)
    source = fitted(camera, (image.shape[1], image.shape[0]), str(frame.image))
    if not capture.alpha or image.shape[2] == 3:
        return source, np.ascontiguousarray(image[:, :, :3]), None
    alpha = image[:, :, 3:].astype(np.float32) / 255
    colour = image[:, :, :3].astype(np.float32) * alpha + 255 * (1 - alpha)
    return source, np.round(colour).astype(np.uint8), np.ascontiguousarray(image[:, :, 3])


def expected_bytes(capture: Capture, long_side: int) -> int:
    """Memory that the prepared views of a capture take while they are written: colour, alpha, mask and depth, and one copy of them."""
    total = 0
    for frame in capture.frames:
        if frame.intrinsics is not None:
            width, height = target_size(frame.intrinsics.width, frame.intrinsics.height, long_side)
            partial = frame.mask is not None or frame.intrinsics.distorted
            total += width * height * (3 + capture.alpha + partial + 4 * (frame.depth is not None))
    return 2 * total


def target_size(width: int, height: int, long_side: int) -> tuple[int, int]:
    """Size of a width × height image whose long side is brought to `long_side`, never enlarged."""
    factor = min(1.0, long_side / max(width, height))
    return max(1, math.floor(width * factor + 0.5)), max(1, math.floor(height * factor + 0.5))


def _aligned_depth(frame: Frame, capture: Capture, source: Intrinsics, target: Intrinsics) -> Array:
    """The frame's depth seen by the pinhole camera `target`, (H, W) float32 along z in the input's units, 0 = missing.

    A depth camera with its own intrinsics is taken to stand where the colour camera does. Then a ray is the same ray in both and
    depth along z stays as it is, so each pixel looks its value up (the nearest one, nothing is mixed across edges): no surface
    can hide another, and no holes open where the colour image is finer.
    """
    depth = load_depth(frame, capture)
    height, width = depth.shape
    return _nearest(depth, fitted(frame.depth_intrinsics or source, (width, height), str(frame.depth)), target)


def _nearest(values: Array, camera: Intrinsics, target: Intrinsics) -> Array:
    """The (H, W) map `values` of `camera` at the pixels of `target`; zero (or False) outside."""
    if not camera.distorted and camera == target:
        return values
    map_x, map_y, seen = resample_maps(camera, target)
    # A lens may send a pixel nowhere: what is not seen has no place to be looked up at.
    column = np.clip(np.floor(np.where(seen, map_x, 0) + 0.5), 0, camera.width - 1).astype(np.intp)
    row = np.clip(np.floor(np.where(seen, map_y, 0) + 0.5), 0, camera.height - 1).astype(np.intp)
    return np.where(seen, values[row, column], values.dtype.type(0))


def _usable(frame: Frame, source: Intrinsics, target: Intrinsics, exif: bool) -> Array:
    """(H, W) bool: pixels of `target` whose whole footprint the frame's mask allows."""
    mask = None if frame.mask_is_alpha else load_mask(frame, exif=exif)
    if mask is None:
        return np.ones((target.height, target.width), dtype=bool)
    camera = source.scaled(mask.shape[1], mask.shape[0])
    # Grown by half a target pixel, then looked up: a pixel is used only where nothing forbidden goes into it.
    reach = 2 * math.ceil(max(camera.width / target.width, camera.height / target.height) / 2) + 1
    allowed = cv2.erode(mask.astype(np.uint8), np.ones((reach, reach), np.uint8), borderValue=1)
    return _nearest(allowed.astype(bool), camera, target)


class _Shrinker:
    """Undistorts and resizes with the anti-aliasing that shrinking needs.

    Without a lens: the exact average over each target pixel's area. With one: k × k samples inside each target pixel, each
    through the lens (bicubic), averaged; k is the number of source pixels a target pixel spans. Maps are cached for the next
    frame, which mostly has the same camera.
    """

    def __init__(self, long_side: int) -> None:
        self.long_side = long_side
        self.key: tuple[Intrinsics, int, int] | None = None
        self.maps: tuple[Array, Array, Array] | None = None

    def __call__(self, source: Intrinsics, image: Array) -> tuple[Intrinsics, Array, Array]:
        """(h, w[, 3]) uint8 of `source` → the pinhole camera, the image in its size, and (H, W) bool where it shows the scene."""
        width, height = target_size(source.width, source.height, self.long_side)
        target = source.pinhole().scaled(width, height)
        if not source.distorted:
            if (width, height) != (source.width, source.height):
                image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
            return target, image, np.ones((height, width), dtype=bool)
        samples = min(_MAX_SAMPLES, math.ceil(source.width / width - 1e-9))
        if source.width > samples * width:
            image = cv2.resize(image, (samples * width, samples * height), interpolation=cv2.INTER_AREA)
            source = source.scaled(samples * width, samples * height)
        if self.key != (source, width, height):
            _, map_x, map_y, seen = undistort_maps(source, samples * width, samples * height)
            whole = np.asarray(seen.reshape(height, samples, width, samples).all(axis=(1, 3)))
            self.key, self.maps = (source, width, height), (map_x, map_y, whole)
        assert self.maps is not None
        fine = cv2.remap(image, self.maps[0], self.maps[1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        if samples > 1:
            fine = cv2.resize(fine, (width, height), interpolation=cv2.INTER_AREA)
        return target, fine, self.maps[2]
