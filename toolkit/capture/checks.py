"""A first look at every image of a capture: refuse what cannot work, and remark on what will work badly, before time is spent."""

from __future__ import annotations

import hashlib
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from fieldfuse.camera import EQUIRECTANGULAR, FISHEYE, Array, pinhole_share
from fieldfuse.capture import heif
from fieldfuse.capture.archive import read_bytes
from fieldfuse.capture.calibration import fitted
from fieldfuse.capture.depth_checks import check_depth
from fieldfuse.capture.headers import LYING, Header, read_header, unturned
from fieldfuse.capture.images import read_image, spread, turns_by_exif, upright
from fieldfuse.capture.light import with_white
from fieldfuse.capture.listing import counted, natural_key, some_of, unique_names
from fieldfuse.capture.photos import size_from_exif
from fieldfuse.capture.types import CUT, Capture, Frame
from fieldfuse.capture.usable import with_usable_depth, without
from fieldfuse.errors import InputError
from fieldfuse.progress import SILENT, Progress

THUMB_SIDE = 320  # at least this many pixels on the long side of what is looked at
PIXEL_BUDGET = 600e6  # stored pixels decoded at most; of a larger capture every n-th image is decoded, all are checked for wholeness
SAME = 0.6  # grey levels by which images of one and the same view differ on average, at 48 × 48
FLAT = 2.0  # grey levels of standard deviation below which an image shows nothing
DARK = 40  # grey level that 95% of a dark image's pixels stay under
BLOWN = 253  # grey level from which a pixel counts as saturated
BLURRED = 0.25  # of the usual sharpness of the capture
CUT_OFF = 0.1  # share of an image that is not used, from which on there is a remark
LOOKED_AT_SHAPES, SAME_SHAPE = 5, 0.05  # images whose EXIF is looked at; difference of width to height that rounding and lenses explain
NOTICE = 0.1  # share of images from which a warning is worth reading
# Saved again (a quarter of the size, JPEG of quality 30), images differ by up to 1.3 grey levels on average and 14 at most, at 48 × 48;
# neighbours of eight captures by at least 6.6 and 83.
MEAN_DIFFERENCE, MAX_DIFFERENCE = 2.0, 24.0
CONTRAST = 40.0  # grey levels of standard deviation; of images of less, the limits are less in proportion
COPIED = re.compile(r"(([ _-]*\([0-9]{1,3}\))|([ _-]+(copy|kopie|copie|copia)([ _-]*[0-9]{1,3})?))+$")  # what programs add to a copy's name


@dataclass(frozen=True)
class Look:
    """What is measured on the thumbnail of one image."""

    frame: Frame
    tiny: Array  # (48, 48) float32 grey
    deviation: float
    sharpness: float
    bright: float  # grey level of the 95th percentile
    blown: float  # share of saturated pixels


def check_capture(capture: Capture, progress: Progress = SILENT) -> Capture:
    """Look at all images and some depth maps; return the capture with warnings and `extra["sizes"]` added.

    A video that has not been split into images, or a film of images, passes as it is: `select_frames` checks what it writes.

    Raises:
        InputError: fewer than two images, a file that is missing, cut short, no image or of another shape than its camera,
            all images alike or blank, depth that is empty or in another unit than the poses.
    """
    frames = capture.frames
    if not frames:
        raise InputError(f"{capture.root} holds no images; give a video, a folder of photos or a capture")
    if capture.filmed:
        if len(frames) < 2:
            raise InputError(f"the video {frames[0].image} has only one frame; film for some seconds while moving around the scene")
        return capture
    if len(frames) == 1:
        raise InputError(f"{capture.root} holds only one image; take at least 20 from different places")
    capture = with_white(capture, progress)
    capture, headers, looks, exact = _look_at_all(capture, progress)
    capture = with_usable_depth(capture)
    blank = [look for look in looks if look.deviation < FLAT]
    if len(blank) > 0.5 * len(looks):
        kind = "black" if np.mean([look.tiny.mean() for look in blank]) < 20 else "of one colour"
        why = f"{len(blank)} of {len(looks)} images in {capture.root} are {kind}, there is nothing to see in them"
        raise InputError(f"{why}; check the camera and the files")
    if max(float(np.abs(look.tiny - looks[0].tiny).mean()) for look in looks) < SAME:
        raise InputError(
            f"all {len(capture.frames)} images in {capture.root} show the same view; depth needs a camera that moves, "
            "take each image from another place"
        )
    cut = {frame.image for frame in capture.frames if frame.instant is not None}  # views of the sky, or a ceiling, look alike
    exact = {image: other for image, other in exact.items() if image not in cut}
    some = [look for look in looks if look.deviation >= FLAT and look.frame.image not in cut and look.frame.image not in exact]
    double = {**exact, **_copies(some, headers)}
    copy_warnings = []
    if double:
        capture, remark = _once_each(capture, double)
        copy_warnings.append(remark)
        stay = {frame.image for frame in capture.frames}
        looks = [look for look in looks if look.frame.image in stay]
    sizes = Counter(_upright_size(headers[frame.image], turns_by_exif(capture)) for frame in capture.frames)
    warnings = [*_size_warnings(capture, sizes), *_shape_warnings(capture, headers), *_lens_warnings(capture), *copy_warnings]
    warnings += _image_warnings(capture, looks)
    capture, remarks = check_depth(capture, progress)
    warnings += remarks
    extra = {**capture.extra, "sizes": {f"{width}x{height}": number for (width, height), number in sizes.most_common()}}
    new = [warning for warning in warnings if warning not in capture.warnings]
    return replace(capture, extra=extra, warnings=(*capture.warnings, *new))


def _look_at_all(capture: Capture, progress: Progress) -> tuple[Capture, dict[Path, Header], list[Look], dict[Path, Path]]:
    """The capture without images that cannot be used, headers of all others, thumbnail measures of as many as `PIXEL_BUDGET` allows and of
    all that may be copies by their names, and exact copies with what they are copies of.
    """
    headers: dict[Path, Header] = {}
    looks: list[Look] = []
    first: dict[bytes, Path] = {}
    exact: dict[Path, Path] = {}
    bad: dict[str, str] = {}
    # `IMG_1.png` and `IMG_1 (1).jpg` beside `IMG_1.jpg` may be copies.
    plain = [(frame.image.parent, COPIED.sub("", frame.image.stem.lower())) for frame in capture.frames]
    often = Counter(plain)
    every = 1
    exif = turns_by_exif(capture)
    for index, frame in enumerate(capture.frames):
        progress.check()
        progress.update(index, len(capture.frames), frame.name)
        try:
            data = read_bytes(frame.image)
            header = read_header(data, frame.image)
            if not headers:
                # Entropy decoding of a JPEG costs about a third of a PNG's, whatever size it is reduced to.
                cost = header.width * header.height * len(capture.frames) * (0.35 if header.format in ("JPEG", "MPO") else 1.0)
                every = max(1, min(int(np.ceil(cost / PIXEL_BUDGET)), len(capture.frames) // 20))
            if frame.intrinsics is not None:
                fitted(frame.intrinsics, _upright_size(header, exif), str(frame.image))
            if index % every == 0 or often[plain[index]] > 1:
                looks.append(_look(frame, data, header, exif))
        except InputError as error:
            bad[frame.name] = str(error)
            continue
        same = first.setdefault(hashlib.blake2b(data, digest_size=16).digest(), frame.image)
        if same != frame.image:
            exact[frame.image] = same
        headers[frame.image] = header
    return without(capture, bad), headers, looks, exact


def _look(frame: Frame, data: bytes, header: Header, exif: bool) -> Look:
    thumb = thumbnail(data, header, frame)
    grey = upright(thumb, header.orientation if exif and header.format != heif.FORMAT else 1).astype(np.float32)
    deviation = float(grey.std())
    # Divided by the contrast, so that a dim image does not pass for a blurred one.
    sharpness = float(cv2.Laplacian(cv2.GaussianBlur(grey, (0, 0), 0.8), cv2.CV_32F).var()) / max(deviation**2, 1.0)
    tiny = np.asarray(cv2.resize(grey, (48, 48), interpolation=cv2.INTER_AREA), dtype=np.float32)
    return Look(frame, tiny, deviation, sharpness, float(np.quantile(grey, 0.95)), float((thumb >= BLOWN).mean()))


def thumbnail(data: bytes, header: Header, frame: Frame) -> Array:
    """A small grey image (h, w) uint8, long side about `THUMB_SIDE`; JPEG is decoded at an eighth, a quarter or half its size."""
    path = frame.image
    ratio = max(header.width, header.height) / THUMB_SIDE
    reduced = ((8, cv2.IMREAD_REDUCED_GRAYSCALE_8), (4, cv2.IMREAD_REDUCED_GRAYSCALE_4), (2, cv2.IMREAD_REDUCED_GRAYSCALE_2))
    flags = next((flag for factor, flag in reduced if ratio >= factor and header.format in ("JPEG", "MPO")), cv2.IMREAD_GRAYSCALE)
    grey: Array | None
    try:
        if header.format == heif.FORMAT:
            grey = heif.small(data, THUMB_SIDE, path)
        elif header.deep or header.format == "AVIF":
            grey = np.asarray(cv2.cvtColor(read_image(frame, small=True)[0][..., :3], cv2.COLOR_RGB2GRAY))
        else:
            grey = cv2.imdecode(np.frombuffer(unturned(data), np.uint8), flags | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        grey = None
    if grey is None:
        raise InputError(f"the image {path} ({header.format}) is damaged or of a kind that cannot be decoded; copy it again or remove it")
    factor = THUMB_SIDE / max(grey.shape[:2])
    return np.asarray(cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA) if factor < 0.75 else grey)


# ------------------------------------------------------------------------------------------------ copies


def _copies(looks: Sequence[Look], headers: dict[Path, Header]) -> dict[Path, Path]:
    """An image that shows the same as another → that other one: the larger, then the one with the shorter name."""
    pixels = {look.frame.image: headers[look.frame.image].width * headers[look.frame.image].height for look in looks}
    order = sorted(looks, key=lambda look: (-pixels[look.frame.image], len(look.frame.name)))
    flat = np.array([look.tiny.ravel() for look in order], dtype=np.float32).reshape(len(order), 48 * 48)
    means = flat.mean(axis=1)
    contrast = np.minimum(1.0, flat.std(axis=1) / CONTRAST)
    out: dict[Path, Path] = {}
    stays = np.ones(len(order), dtype=bool)
    for place in range(1, len(order)):
        near = np.flatnonzero(stays[:place] & (np.abs(means[:place] - means[place]) < MEAN_DIFFERENCE))
        off = np.abs(flat[near] - flat[place])
        same = (off.mean(axis=1) < MEAN_DIFFERENCE * contrast[place]) & (off.max(axis=1) < MAX_DIFFERENCE * contrast[place])
        if same.any():
            out[order[place].frame.image] = order[int(near[np.argmax(same)])].frame.image
            stays[place] = False
    return out


def _once_each(capture: Capture, double: dict[Path, Path]) -> tuple[Capture, str]:
    """The capture without copies (image → the other) if it is photos; copies among posed images are remarked on only."""
    names = [f"{frame.image.name} of {double[frame.image].name}" for frame in capture.frames if frame.image in double]
    remark = f"{counted(len(double), 'image is a copy', 'images are copies')} of others ({some_of(names)})"
    stay = [frame for frame in capture.frames if frame.image not in double]
    if capture.kind != "photos" or len(stay) < 2:
        return capture, f"{remark}; where the one is held out and the other is not, scores mean little"
    shorter = unique_names([frame.image for frame in stay])
    named = [replace(frame, name=name) for frame, name in zip(stay, shorter, strict=True)]
    single = capture.with_frames(sorted(named, key=lambda frame: natural_key(frame.name)))
    return single, f"{remark} and {'counts' if len(double) == 1 else 'count'} once"


# ------------------------------------------------------------------------------------------------ what is remarked


def _upright_size(header: Header, exif: bool) -> tuple[int, int]:
    return header.size[::-1] if exif and header.orientation >= LYING else header.size


def _size_warnings(capture: Capture, sizes: Counter[tuple[int, int]]) -> list[str]:
    if len(sizes) == 1 or all(frame.instant is not None for frame in capture.frames):
        return []
    listed = some_of([f"{width}×{height} ({number})" for (width, height), number in sizes.most_common()], 4)
    if all(frame.intrinsics is not None for frame in capture.frames):
        return [f"the images have {len(sizes)} sizes: {listed}; each comes with its own camera, so this is fine"]
    return [f"the images have {len(sizes)} sizes: {listed}; each size gets its own camera, which is less certain than one camera for all"]


def _shape_warnings(capture: Capture, headers: dict[Path, Header]) -> list[str]:
    """Images that by EXIF were taken in another shape: squeezed into theirs, no camera with one focal length fits them."""
    changed, example = 0, ""
    chosen = spread(capture.frames, LOOKED_AT_SHAPES)
    for frame in chosen:
        original = size_from_exif(frame.image)
        width, height = headers[frame.image].size
        ratios = () if original is None else (original[0] / original[1], original[1] / original[0])
        if original and all(abs(width / height / ratio - 1) > SAME_SHAPE for ratio in ratios):
            changed += 1
            example = f"{original[0]}×{original[1]}, as EXIF has it, and are {width}×{height}"
    if 2 * changed <= len(chosen):
        return []
    return [f"the images were taken at {example}: cropped, or squeezed, and no camera with one focal length fits squeezed images"]


def _lens_warnings(capture: Capture) -> list[str]:
    """That much of a wide lens's image lies outside of the pinhole image that is made of it."""
    cut = (FISHEYE, EQUIRECTANGULAR) if CUT in capture.extra else ()
    cameras = {
        frame.intrinsics
        for frame in capture.frames
        if frame.intrinsics is not None and frame.intrinsics.distorted and frame.intrinsics.lens not in cut
    }
    shares = [pinhole_share(camera) for camera in cameras]
    if not shares or min(shares) > 1 - CUT_OFF:
        return []
    return [
        f"{100 * (1 - float(np.mean(shares))):.0f}% of the images' pixels lie outside of the pinhole view that is made of them (a wide "
        "lens) and are not used; cut the images into several perspective views to use all"
    ]


def _image_warnings(capture: Capture, looks: Sequence[Look]) -> list[str]:
    total, warnings = len(looks), []
    blank = [look.frame.name for look in looks if look.deviation < FLAT]
    if blank:
        warnings.append(f"{len(blank)} of {total} images show nothing but one colour ({some_of(blank)}); remove them")
    looks = [look for look in looks if look.deviation >= FLAT]
    # Neighbours in time show much the same.
    sharpness = np.array([look.sharpness for look in looks])
    usual = np.full(len(looks), np.median(sharpness) if len(looks) else 0.0)
    if capture.ordered and len(looks) >= 11:
        usual = np.median(np.lib.stride_tricks.sliding_window_view(np.pad(sharpness, 5, mode="reflect"), 11), axis=1)
    # Object captures are dark or white around the object on purpose.
    dark = 0 if capture.alpha else sum(look.bright < DARK for look in looks)
    blown = 0 if capture.alpha else sum(look.blown > 0.3 for look in looks)
    for number, text in (
        (int((sharpness < BLURRED * usual).sum()), "are much less sharp than the others; hold the camera still or use more light"),
        (dark, "are very dark; use more light or a longer exposure"),
        (blown, "are white in large parts (overexposed, or a white backdrop); if it is light, lower the exposure"),
    ):
        if number > NOTICE * total:
            warnings.append(f"{number} of {total} images {text}")
    return warnings
