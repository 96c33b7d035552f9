"""A first look at every picture of a capture: refuse what cannot work, and say what will work badly, before time is spent."""

from __future__ import annotations

import hashlib
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from fieldfuse.camera import Array, pinhole_share
from fieldfuse.capture import heif
from fieldfuse.capture.depth_checks import check_depth
from fieldfuse.capture.duplicates import copies, suspects
from fieldfuse.capture.headers import PANORAMA, Header, is_panorama, read_bytes, read_header
from fieldfuse.capture.images import decode, largest, read_picture, turns_by_exif, upright
from fieldfuse.capture.listing import counted, natural_key, unique_names
from fieldfuse.capture.photos import size_from_exif
from fieldfuse.capture.sizes import TIFFS, fitted
from fieldfuse.capture.tiff import unturned
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.capture.usable import with_usable_depth, without
from fieldfuse.errors import InputError
from fieldfuse.progress import SILENT, Progress

THUMB_SIDE = 320  # at least this many pixels on the long side of what is looked at
PIXEL_BUDGET = 600e6  # stored pixels decoded at most; of a larger capture every n-th picture is decoded, all are checked for wholeness
SAME = 0.6  # grey levels by which pictures of one and the same view differ on average, at 48 × 48
FLAT = 2.0  # grey levels of standard deviation below which a picture shows nothing
DARK = 40  # grey level that 95% of a dark picture's pixels stay under
BLOWN = 253  # grey level from which a pixel counts as saturated
BLURRED = 0.25  # of the usual sharpness of the capture
CUT_OFF = 0.1  # share of an image that is not used, from which on that is said
FLOAT_WHITES = (255, 1023, 4095, 16383, 65535)  # that floating-point values may be meant for
WHOLE, BRIGHT, EVERY = 4.0, 90, 7  # they are where their 90th percentile, of every 7th that is not black, is as large as this
ABOVE_ONE = 1e-3  # by which values may exceed 1 before that is worth a word
FEWER_BITS = (1023, 4095, 16383)  # largest values of sensors that store 10, 12 and 14 bits in 16
LOOKED_AT_SHAPES, SAME_SHAPE = 5, 0.05  # images whose EXIF is looked at; difference of width to height that rounding and lenses explain
NOTICE = 0.1  # share of pictures from which a warning is worth reading


@dataclass(frozen=True)
class Look:
    """What is measured on the thumbnail of one picture."""

    name: str
    tiny: Array  # (48, 48) float32 grey
    deviation: float
    sharpness: float
    bright: float  # grey level of the 95th percentile
    blown: float  # share of saturated pixels


def check_capture(capture: Capture, progress: Progress = SILENT) -> Capture:
    """Look at all pictures and some depth maps; return the capture with warnings and `extra["sizes"]` added.

    A video that has not been split into pictures, or a film of pictures, passes as it is: `select_frames` checks what it writes.

    Raises:
        InputError: fewer than two pictures, a file that is missing, cut short, no picture or of another shape than its camera,
            all pictures alike or blank, depth that is empty or in another unit than the poses.
    """
    frames = capture.frames
    if not frames:
        raise InputError(f"{capture.root} holds no pictures; give a video, a folder of photos or a capture")
    if capture.filmed:
        if len(frames) < 2:
            raise InputError(f"the video {frames[0].image} has only one frame; film for some seconds while moving around the scene")
        return capture
    if len(frames) == 1:
        raise InputError(f"{capture.root} holds only one picture; take at least 20 from different places")
    capture = floats_to_white(scaled_to_white(capture, progress), progress)
    capture, headers, looks, exact = _look_at_all(capture, progress)
    capture = with_usable_depth(capture)
    _refuse_blank(capture, looks)
    _refuse_same(capture, looks)
    capture, headers, looks, copy_warnings = _once_each(capture, headers, looks, exact)
    sizes = Counter(_upright_size(header, turns_by_exif(capture)) for header in headers)
    warnings = [*_size_warnings(capture, sizes), *_shape_warnings(capture, headers), *_lens_warnings(capture), *copy_warnings]
    warnings += _picture_warnings(capture, looks)
    warnings += check_depth(capture, progress)
    extra = {**capture.extra, "sizes": {f"{width}x{height}": number for (width, height), number in sizes.most_common()}}
    return replace(
        capture, extra=extra, warnings=capture.warnings + tuple(warning for warning in warnings if warning not in capture.warnings)
    )


def scaled_to_white(capture: Capture, progress: Progress = SILENT) -> Capture:
    """The capture with `Frame.white` where its images use 10, 12 or 14 of 16 bits, by the files' own word or their largest value."""
    deep = [frame for frame in capture.frames if frame.image.suffix.lower() in (*TIFFS, ".png") and frame.video_index is None]
    most, said = 0, True
    for number, frame in enumerate(deep):
        progress.check()
        try:
            header = read_header(read_bytes(frame.image), frame.image)
            value = 0 if not header.deep else header.white if header.white is not None else largest(frame.image)
        except InputError:
            continue  # said where images are looked at
        if not header.deep:
            return capture
        said, most = said and header.white is not None, max(most, value)
        if most > FEWER_BITS[-1]:
            return capture
        progress.update(number, len(deep), frame.name)
    if not deep or len(deep) < len(capture.frames) or most <= 255:
        return capture
    white = next(bits for bits in FEWER_BITS if most <= bits)
    why = "as the files say" if said else f"as no value exceeds {most}"
    remark = f"the images use {white.bit_length()} of 16 bits, {why}; {white} is taken for white"
    return replace(capture, frames=tuple(replace(frame, white=white) for frame in capture.frames), warnings=(*capture.warnings, remark))


def floats_to_white(capture: Capture, progress: Progress = SILENT) -> Capture:
    """The capture with `Frame.white` where its floating-point images hold whole numbers (up to 255 or 65535) instead of 0 to 1, and with a
    remark on these, or on values beyond 1 that are cut off."""
    found: dict[str, tuple[float, float]] = {}  # the largest value, and a high percentile of what is not black
    for frame in capture.frames:
        if frame.image.suffix.lower() not in TIFFS or frame.video_index is not None:
            continue
        progress.check()
        try:
            if not read_header(read_bytes(frame.image), frame.image).floating:
                break  # of a capture, all are of one kind
            image = decode(frame.image)[0]
        except InputError:
            continue  # said where images are looked at
        values = image[..., :3][np.isfinite(image[..., :3])] if image.ndim == 3 else image[np.isfinite(image)]
        some = values[values > 0][::EVERY]
        found[frame.name] = (float(values.max()), float(np.percentile(some, BRIGHT))) if some.size else (0.0, 0.0)
    most = max((largest for largest, _ in found.values()), default=0.0)
    beyond = sum(largest > 1 + ABOVE_ONE for largest, _ in found.values())
    if not beyond:
        return capture
    if np.median([bright for _, bright in found.values()]) < WHOLE or most > FLOAT_WHITES[-1]:
        many = counted(beyond, "floating-point image has", "floating-point images have")
        remark = f"{many} values up to {most:.4g}; 1 is taken for white, and what is above it is cut off"
        return replace(capture, warnings=(*capture.warnings, remark))
    white = next(value for value in FLOAT_WHITES if most <= value)
    remark = f"the floating-point images have values up to {most:.4g}; {white} is taken for white"
    frames = tuple(replace(frame, white=white) if frame.name in found else frame for frame in capture.frames)
    return replace(capture, frames=frames, warnings=(*capture.warnings, remark))


def _look_at_all(capture: Capture, progress: Progress) -> tuple[Capture, list[Header], list[Look], dict[int, int]]:
    """The capture without images that cannot be used, headers of all others, thumbnail measures of as many as `PIXEL_BUDGET` allows and of
    all that may be copies by their names, and the indices of exact copies with those that they are copies of.

    Raises:
        InputError: more than a few images cannot be used.
    """
    headers: list[Header] = []
    looks: list[Look] = []
    first: dict[bytes, int] = {}
    exact: dict[int, int] = {}
    bad: dict[str, str] = {}
    named = suspects(capture.frames)
    every = 1
    exif = turns_by_exif(capture)
    for index, frame in enumerate(capture.frames):
        progress.check()
        progress.update(index, len(capture.frames), frame.name)
        try:
            data = read_bytes(frame.image)
            header = read_header(data, frame.image)
            if is_panorama(data, header, frame.intrinsics is not None):
                raise InputError(f"{frame.image}: {PANORAMA}")
            if not headers:
                # Entropy decoding of a JPEG costs about a third of a PNG's, whatever size it is reduced to.
                cost = header.width * header.height * len(capture.frames) * (0.35 if header.format in ("JPEG", "MPO") else 1.0)
                every = max(1, min(int(np.ceil(cost / PIXEL_BUDGET)), len(capture.frames) // 20))
            if frame.intrinsics is not None:
                fitted(frame.intrinsics, _upright_size(header, exif), str(frame.image))
            if index % every == 0 or index in named:
                looks.append(_look(frame, data, header, exif))
        except InputError as error:
            bad[frame.name] = str(error)
            continue
        headers.append(header)
        same = first.setdefault(hashlib.blake2b(data, digest_size=16).digest(), len(headers) - 1)
        if same != len(headers) - 1:
            exact[len(headers) - 1] = same
    return without(capture, bad), headers, looks, exact


def _once_each(
    capture: Capture, headers: list[Header], looks: list[Look], exact: dict[int, int]
) -> tuple[Capture, list[Header], list[Look], list[str]]:
    """The same without copies of photos, of which nothing but pixels is given; copies among posed pictures are remarked on."""
    place = {frame.name: index for index, frame in enumerate(capture.frames)}
    seen = [place[look.name] for look in looks if look.deviation >= FLAT]
    sizes = [headers[index].width * headers[index].height for index in seen]
    near = copies([look.tiny for look in looks if look.deviation >= FLAT], sizes, [capture.frames[index].name for index in seen])
    double = {**exact, **{seen[copy]: seen[other] for copy, other in near.items()}}
    if not double:
        return capture, headers, looks, []
    names = [f"{capture.frames[copy].image.name} of {capture.frames[other].image.name}" for copy, other in sorted(double.items())]
    listed = ", ".join(names[:3]) + (", …" if len(names) > 3 else "")
    many = counted(len(double), "picture is a copy", "pictures are copies")
    if capture.kind != "photos" or capture.filmed or len(capture.frames) - len(double) < 2:
        return capture, headers, looks, [f"{many} of others ({listed}); where the one is held out and the other is not, scores say little"]
    stays = [index for index in range(len(capture.frames)) if index not in double]
    names_left = {capture.frames[index].name for index in stays}
    shorter = unique_names([capture.frames[index].image for index in stays])
    frames = tuple(replace(capture.frames[index], name=name) for index, name in zip(stays, shorter, strict=True))
    left = replace(capture, frames=tuple(sorted(frames, key=lambda frame: natural_key(frame.name))))
    looks = [look for look in looks if look.name in names_left]
    warning = f"{many} of others ({listed}) and {'counts' if len(double) == 1 else 'count'} once"
    return left, [headers[index] for index in stays], looks, [warning]


def _look(frame: Frame, data: bytes, header: Header, exif: bool) -> Look:
    name, thumb = frame.name, thumbnail(data, header, frame.image, frame.white)
    grey = upright(thumb, header.orientation if exif and header.format != heif.FORMAT else 1).astype(np.float32)
    deviation = float(grey.std())
    # Divided by the contrast, so that a dim picture does not pass for a blurred one.
    sharpness = float(cv2.Laplacian(cv2.GaussianBlur(grey, (0, 0), 0.8), cv2.CV_32F).var()) / max(deviation**2, 1.0)
    tiny = np.asarray(cv2.resize(grey, (48, 48), interpolation=cv2.INTER_AREA), dtype=np.float32)
    return Look(name, tiny, deviation, sharpness, float(np.quantile(grey, 0.95)), float((thumb >= BLOWN).mean()))


def thumbnail(data: bytes, header: Header, path: Path, white: int | None = None) -> Array:
    """A small grey picture (h, w) uint8, long side about `THUMB_SIDE`; JPEG is decoded at an eighth, a quarter or half its size.

    Raises:
        InputError: the picture cannot be decoded.
    """
    ratio = max(header.width, header.height) / THUMB_SIDE
    flags = cv2.IMREAD_GRAYSCALE
    for factor, reduced in ((8, cv2.IMREAD_REDUCED_GRAYSCALE_8), (4, cv2.IMREAD_REDUCED_GRAYSCALE_4), (2, cv2.IMREAD_REDUCED_GRAYSCALE_2)):
        if ratio >= factor and header.format in ("JPEG", "MPO"):
            flags = reduced
            break
    grey: Array | None
    try:
        if header.format == heif.FORMAT:
            grey = heif.small(data, THUMB_SIDE, path)
        elif header.deep or header.format == "AVIF":
            grey = np.asarray(cv2.cvtColor(read_picture(path, white)[0][..., :3], cv2.COLOR_RGB2GRAY))
        else:
            grey = cv2.imdecode(np.frombuffer(unturned(data), np.uint8), flags | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        grey = None
    if grey is None:
        raise InputError(f"the picture {path} ({header.format}) is damaged or of a kind that cannot be decoded; copy it again or remove it")
    factor = THUMB_SIDE / max(grey.shape[:2])
    if factor < 0.75:
        grey = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    return np.asarray(grey)


# ------------------------------------------------------------------------------------------------ what is refused


def _refuse_blank(capture: Capture, looks: list[Look]) -> None:
    blank = [look for look in looks if look.deviation < FLAT]
    if len(blank) > 0.5 * len(looks):
        kind = "black" if np.mean([look.tiny.mean() for look in blank]) < 20 else "of one colour"
        raise InputError(
            f"{len(blank)} of {len(looks)} pictures in {capture.root} are {kind}, there is nothing to see in them; "
            "check the camera and the files"
        )


def _refuse_same(capture: Capture, looks: list[Look]) -> None:
    difference = max(float(np.abs(look.tiny - looks[0].tiny).mean()) for look in looks)
    if difference < SAME:
        raise InputError(
            f"all {len(capture.frames)} pictures in {capture.root} show the same view; depth needs a camera that moves, "
            "take each picture from another place"
        )


# ------------------------------------------------------------------------------------------------ what is remarked


def _upright_size(header: Header, exif: bool) -> tuple[int, int]:
    turned = exif and header.orientation >= 5
    return (header.height, header.width) if turned else (header.width, header.height)


def _size_warnings(capture: Capture, sizes: Counter[tuple[int, int]]) -> list[str]:
    if len(sizes) == 1:
        return []
    listed = ", ".join(f"{width}×{height} ({number})" for (width, height), number in sizes.most_common(4)) + (
        ", …" if len(sizes) > 4 else ""
    )
    if all(frame.intrinsics is not None for frame in capture.frames):
        return [f"the pictures have {len(sizes)} sizes: {listed}; each comes with its own camera, so this is fine"]
    return [f"the pictures have {len(sizes)} sizes: {listed}; each size gets its own camera, which is less certain than one camera for all"]


def _shape_warnings(capture: Capture, headers: list[Header]) -> list[str]:
    """Images that EXIF says were taken in another shape: squeezed into theirs, no camera with one focal length fits them."""
    changed, example = 0, ""
    chosen = [int(at) for at in np.unique(np.linspace(0, len(headers) - 1, LOOKED_AT_SHAPES).round())]
    for index in chosen:
        taken = size_from_exif(capture.frames[index].image)
        stored = headers[index].width / headers[index].height
        if taken and all(abs(stored / ratio - 1) > SAME_SHAPE for ratio in (taken[0] / taken[1], taken[1] / taken[0])):
            changed += 1
            example = f"{taken[0]}×{taken[1]}, as EXIF has it, and are {headers[index].width}×{headers[index].height}"
    if 2 * changed <= len(chosen):
        return []
    return [f"the images were taken at {example}: cropped, or squeezed, and no camera with one focal length fits squeezed images"]


def _lens_warnings(capture: Capture) -> list[str]:
    """That much of a wide lens's image lies outside of the pinhole image that is made of it."""
    cameras = {frame.intrinsics for frame in capture.frames if frame.intrinsics is not None and frame.intrinsics.distorted}
    shares = [pinhole_share(camera) for camera in cameras]
    if not shares or min(shares) > 1 - CUT_OFF:
        return []
    return [
        f"{100 * (1 - float(np.mean(shares))):.0f}% of the images' pixels lie outside of the pinhole view that is made of them (a wide "
        "lens) and are not used; cut the images into several perspective views to use all"
    ]


def _picture_warnings(capture: Capture, looks: list[Look]) -> list[str]:
    warnings = []
    total = len(looks)
    blank = [look for look in looks if look.deviation < FLAT]
    if blank:
        names = ", ".join(look.name for look in blank[:3]) + (", …" if len(blank) > 3 else "")
        warnings.append(f"{len(blank)} of {total} pictures show nothing but one colour ({names}); remove them")
    looks = [look for look in looks if look.deviation >= FLAT]
    usual = _usual_sharpness(np.array([look.sharpness for look in looks]), capture.ordered)
    blurred = sum(look.sharpness < BLURRED * sharp for look, sharp in zip(looks, usual, strict=True))
    # Object captures are dark or white around the object on purpose.
    dark = 0 if capture.alpha else sum(look.bright < DARK for look in looks)
    blown = 0 if capture.alpha else sum(look.blown > 0.3 for look in looks)
    for number, text in (
        (blurred, "are much less sharp than the others; hold the camera still or use more light"),
        (dark, "are very dark; use more light or a longer exposure"),
        (blown, "are white in large parts (overexposed, or a white backdrop); if it is light, lower the exposure"),
    ):
        if number > NOTICE * total:
            warnings.append(f"{number} of {total} pictures {text}")
    return warnings


def _usual_sharpness(sharpness: Array, ordered: bool) -> Array:
    """The median around each picture (neighbours in time show much the same), or of all when their order means nothing."""
    if not len(sharpness) or not ordered or len(sharpness) < 11:
        return np.full(len(sharpness), np.median(sharpness) if len(sharpness) else 0.0)
    padded = np.pad(sharpness, 5, mode="reflect")
    return np.asarray(np.median(np.lib.stride_tricks.sliding_window_view(padded, 11), axis=1))
