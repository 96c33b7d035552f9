"""Which images are 360° panoramas: equirectangular, the whole sphere, twice as wide as high.

Photos say so in XMP (Google's GPano, https://developers.google.com/streetview/spherical-metadata), videos in their container (Google's
spherical video, https://github.com/google/spatial-media). Many have lost that; then the picture shows it: its left and right edges
continue each other, and its first and last rows, each one point of the sphere, hardly change along the image.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.capture.headers import UNREADABLE, image_header
from fieldfuse.capture.images import read_image, spread, turns_by_exif, upright
from fieldfuse.capture.listing import counted
from fieldfuse.capture.sphere import announced
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.capture.usable import without
from fieldfuse.capture.video import iterate_video
from fieldfuse.errors import InputError

AUTO, PERSPECTIVE, PANORAMAS = "auto", "perspective", "equirectangular"
HEAD = 2**18  # bytes at the beginning of a photo that hold its XMP
ENDS = 2**22  # bytes at either end of a video that hold its headers
SHAPE = 0.01  # by which a panorama's width may differ from twice its height: videos have even sizes
LOOKED_AT = 5  # images, or frames of a video, whose pixels are looked at
WIDE = 512  # pixels across what is looked at
SEAM, FAR = 2.0, 0.5  # the edges differ by at most so many times as much as neighbouring columns do, and so much as those far apart
SEAM_LEVELS = 2.0  # grey levels by which they may differ besides
POLE, POLE_LEVELS = 0.5, 8.0  # deviation along the first and last rows, of that along the others, or in grey levels
EMPTY = 8.0  # grey levels of deviation along an edge that shows nothing, as around an object that was cut out
CROPPED = "is a part of a 360° panorama, by its XMP; only whole ones (equirectangular, twice as wide as high) are read: export it whole"
SAY = "--set capture.projection"


def with_projection(capture: Capture, projection: str = AUTO) -> Capture:
    """The capture with the camera of a panorama for each frame that is one, and with a word on into what its images are to be cut.

    Args:
        projection: auto | perspective: no image is a panorama, and fisheye images stay whole | equirectangular: all are.

    Raises:
        InputError: an image is a part of a panorama, or it cannot be what `projection` has it be.
    """
    if projection == PERSPECTIVE:
        return _refuse_panoramas(capture)
    if capture.kind in ("photos", "video") and not any(frame.intrinsics for frame in capture.frames):
        capture = _of_video(capture, projection) if capture.filmed else _of_photos(capture, projection)
    elif projection == PANORAMAS:
        capture = _refuse_cameras(capture)
    return announced(capture)


def _refuse_panoramas(capture: Capture) -> Capture:
    if any(frame.intrinsics is not None and frame.intrinsics.lens == PANORAMAS for frame in capture.frames):
        raise InputError(f"{capture.root} comes with cameras of 360° panoramas; leave {SAY} at auto")
    return capture


def _refuse_cameras(capture: Capture) -> Capture:
    if all(frame.intrinsics is not None and frame.intrinsics.lens == PANORAMAS for frame in capture.frames):
        return capture
    raise InputError(
        f"{capture.root} comes with cameras that are no panoramas'; leave {SAY} at auto, or correct them (in transforms.json: "
        "\"camera_model\": \"EQUIRECTANGULAR\")"
    )


def _of_photos(capture: Capture, projection: str) -> Capture:
    exif, found, bad, lost = turns_by_exif(capture), dict[str, tuple[int, int]](), dict[str, str](), list[Frame]()
    for frame in capture.frames:
        with suppress(InputError):  # what cannot be read is reported where all images are looked at
            size, tag = image_header(frame.image).size, photo_tag(frame.image)
            if size == UNREADABLE.size:
                continue
            if tag == CROPPED or (tag and not twice_as_wide(size)):
                bad[frame.name] = f"{frame.image} {CROPPED}"
            elif tag or (projection == PANORAMAS and twice_as_wide(size)):
                found[frame.name] = size
            elif projection == PANORAMAS:
                shape = f"{frame.image} is {size[0]}×{size[1]}, and a 360° panorama is twice as wide as high"
                bad[frame.name] = f"{shape}; leave {SAY} at auto"
            elif twice_as_wide(size):
                lost.append(frame)
    remarks = []
    if lost:
        looked = [frame for frame in spread(lost, LOOKED_AT) if shows_sphere(upright(*read_image(frame)) if exif else read_image(frame)[0])]
        if 2 * len(looked) > min(len(lost), LOOKED_AT):
            found |= {frame.name: image_header(frame.image).size for frame in lost}
            what = "image is taken for a 360° panorama" if len(lost) == 1 else "images are taken for 360° panoramas"
            remarks.append(f"{len(lost)} {what} by what they show; {SAY}=perspective takes them for plain ones")
        else:
            remarks.append(
                f"{counted(len(lost), 'image is', 'images are')} twice as wide as high and no panorama: the edges do not continue each "
                f"other; if {'it is' if len(lost) == 1 else 'they are'}, {SAY}=equirectangular"
            )
    capture = without(capture, bad)
    frames = [
        replace(frame, intrinsics=Intrinsics.equirectangular(*found[frame.name]), focal_prior=None) if frame.name in found else frame
        for frame in capture.frames
    ]
    return capture.with_frames(frames, *remarks)


def _of_video(capture: Capture, projection: str) -> Capture:
    size = int(capture.extra.get("width") or 0), int(capture.extra.get("height") or 0)
    path = capture.frames[0].image
    if not twice_as_wide(size):
        if projection == PANORAMAS:
            raise InputError(f"{path} is {size[0]}×{size[1]}, and a 360° video is twice as wide as high; leave {SAY} at auto")
        return capture
    remark = []
    if projection == AUTO and not video_tag(path):
        shown = [shows_sphere(image) for image in _some_frames(capture)]
        if 2 * sum(shown) <= len(shown):
            text = "the video is twice as wide as high and no panorama: its edges do not continue each other"
            return capture.with_frames(capture.frames, f"{text}; if it is, {SAY}=equirectangular")
        remark = [f"the video is taken for a 360° panorama by what it shows; {SAY}=perspective takes it for a plain one"]
    camera = Intrinsics.equirectangular(*size)
    return capture.with_frames([replace(frame, intrinsics=camera) for frame in capture.frames], *remark)


def _some_frames(capture: Capture) -> Iterator[Array]:
    first = capture.frames[0]
    numbers = {min(len(capture.frames) - 1, 15 * step) for step in range(LOOKED_AT)}  # at the beginning: a video is decoded from its start
    for _, image in iterate_video(first.image, numbers, as_stored=first.as_stored):
        yield image


# ------------------------------------------------------------------------------------------------ evidence


def twice_as_wide(size: tuple[int, int]) -> bool:
    """Whether (width, height) is the shape of a whole panorama."""
    return min(size) > 0 and abs(size[0] / (2 * size[1]) - 1) <= SHAPE


def photo_tag(path: Path) -> str:
    """What Google's XMP in a photo says: empty where there is none, or it is of another projection; `CROPPED` for a part of a panorama."""
    try:
        with path.open("rb") as file:
            head = file.read(HEAD)
    except OSError:
        return ""
    if b"GPano:" not in head or b"equirectangular" not in head:
        return ""

    def value(name: bytes) -> int | None:
        found = re.search(rb"GPano:" + name + rb"(?:=[\"']|>)\s*(\d{1,6})\b", head)
        return int(found[1]) if found else None

    for side in (b"Width", b"Height"):
        whole, cropped = value(b"FullPano" + side + b"Pixels"), value(b"CroppedAreaImage" + side + b"Pixels")
        if whole and cropped and cropped < (1 - SHAPE) * whole:
            return CROPPED
    return PANORAMAS


def video_tag(path: Path) -> bool:
    """Whether a video's container says that its frames are equirectangular: the box `equi` in `sv3d`, or version 1's XML."""
    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            ends = file.read(ENDS)
            file.seek(max(0, size - ENDS))
            ends += file.read(ENDS)
    except OSError:
        return False
    return (b"sv3d" in ends and b"equi" in ends) or b"<GSpherical:ProjectionType>equirectangular" in ends


def shows_sphere(image: Array) -> bool:
    """Whether an image (H, W, 3 or 4) looks like an equirectangular panorama: see this module."""
    grey = cv2.cvtColor(np.ascontiguousarray(image[:, :, :3]), cv2.COLOR_RGB2GRAY)
    small = cv2.resize(grey, (WIDE, WIDE // 2), interpolation=cv2.INTER_AREA).astype(np.float32)
    seam = float(np.abs(small[:, 0] - small[:, -1]).mean())
    beside = float(np.abs(np.diff(small, axis=1)).mean())
    apart = float(np.median([np.abs(small - np.roll(small, shift, axis=1)).mean() for shift in (WIDE // 4, WIDE // 3, WIDE // 2)]))
    closed = seam <= SEAM * beside + SEAM_LEVELS and seam <= FAR * apart
    rows = cv2.resize(grey, (WIDE, grey.shape[0]), interpolation=cv2.INTER_AREA).astype(np.float32)
    usual = float(np.median(rows.std(axis=1)))
    poles = [float(rows[row].std()) <= max(POLE * usual, POLE_LEVELS) for row in (0, -1)]
    return closed and all(poles) and float(small[:, 0].std()) > EMPTY
