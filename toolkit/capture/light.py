"""What becomes white in images of more than 8 bits, and which of them hold linear light: decided once for a whole capture, so that one
surface has one colour in all its images.

Linear light is what OpenEXR holds, what a camera's sensor counts, and what floating-point TIFFs hold where their profile says so, where
values exceed 1 or where they are no levels of 8 or 16 bits. It is shown as sRGB, with one value as white.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from fieldfuse.camera import Array
from fieldfuse.capture import exr, raw
from fieldfuse.capture.archive import read_bytes
from fieldfuse.capture.colours import is_linear
from fieldfuse.capture.headers import TIFFS, read_header
from fieldfuse.capture.images import decode, spread
from fieldfuse.capture.listing import counted
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.errors import InputError
from fieldfuse.progress import SILENT, Progress

LIGHT = "light"  # in `Capture.extra`: what floating-point images hold by the setting, "linear" or "display"
SAMPLED, PIXELS = 24, 20_000  # images that the exposure is chosen by, evenly spread, and pixels of each
JUDGED = 5  # floating-point images that are looked at for levels
LEVEL, LEVELS = 0.02, 0.99  # how near to whole numbers values are that were levels, and how many of them
BRIGHTEST = 99  # percentile of an image's strongest channel that becomes white
AS_STORED = (0.4, 1.25)  # where it lies here already, 1 is white
DARKEST = 0.05  # of white: what half of the pixels have at least, also where lamps or the sky are far brighter
FLOAT_WHITES = (255, 1023, 4095, 16383, 65535)  # that floating-point values may be meant for
WHOLE, BRIGHT, EVERY = 4.0, 90, 7  # they are where their 90th percentile, of every 7th that is not black, is as large as this
ABOVE_ONE = 1e-3  # by which values may exceed 1 before that is worth a word
FEWER_BITS = (1023, 4095, 16383)  # largest values of sensors that store 10, 12 and 14 bits in 16


def with_white(capture: Capture, progress: Progress = SILENT) -> Capture:
    """The capture with `white`, `linear` and `balance` of its frames where these are not as usual, and with remarks on them. Itself for
    images of 8 bits, and where it was done before."""
    if any(frame.white is not None or frame.linear is not None for frame in capture.frames):
        return capture
    return _whole_numbers(_linear_light(_fewer_bits(capture, progress), progress), progress)


def _linear_light(capture: Capture, progress: Progress) -> Capture:
    given = capture.extra.get(LIGHT)
    images = [frame for frame in capture.frames if frame.video_index is None]
    raws = [frame for frame in images if raw.is_raw(frame.image)]
    floats = [frame for frame in images if frame.image.suffix.lower() == exr.SUFFIX]
    tiffs = [frame for frame in images if frame.image.suffix.lower() in TIFFS and frame.white is None]
    why = "OpenEXR"
    if tiffs and _is_floating(tiffs[0]) and (given or not floats):
        judged = "as capture.light has it" if given == "linear" else _holds_linear(tiffs)
        if judged:
            floats, why = [*floats, *tiffs], f"floating-point TIFF, {judged}"
    if given == "display":
        capture = capture.with_frames([replace(frame, linear=False) if frame in floats else frame for frame in capture.frames])
        floats = []
    for some, what in ((floats, f"hold linear light ({why})"), (raws, "are camera raw")):
        if some:
            capture = _exposed(capture, some, what, progress)
    return capture


def _exposed(capture: Capture, frames: Sequence[Frame], what: str, progress: Progress) -> Capture:
    """The capture with these frames' white chosen by all of them together; `what` says in a remark why."""
    balance = _balance(frames) if raw.is_raw(frames[0].image) else None
    parts = []
    for number, frame in enumerate(chosen := spread(frames, SAMPLED)):
        progress.check()
        progress.update(number, len(chosen), frame.name)
        with suppress(InputError):  # reported where images are looked at
            parts.append(_brightness(decode(frame.image, balance, small=True)[0]))
    values = np.concatenate(parts) if parts else np.zeros(0, np.float32)
    white, cut = 1.0, 0.0
    if values.size:
        bright = float(np.percentile(values, BRIGHTEST))
        white = 1.0 if AS_STORED[0] <= bright <= AS_STORED[1] else bright
        white = min(white, float(np.median(values)) / DARKEST)
        white = float(f"{white:.3g}")
        cut = float((values > white).mean())
    names, top = {frame.name for frame in frames}, 1.0 if balance is None else 65535.0
    light: dict[str, Any] = {"white": white * top, "linear": True, "balance": balance}
    changed = [replace(frame, **light) if frame.name in names else frame for frame in capture.frames]
    shown = f"shown as sRGB with {white:.3g} as white in all of them"
    if balance is not None:
        by = f"red {balance[0]:.3g}, blue {balance[2]:.3g} times green"
        shown = f"developed with one white balance ({by}) and with {white:.3g} of the sensor's range as white"
    remark = f"{counted(len(frames), 'image')} {what}, {shown} ({100 * cut:.1f}% of the pixels are brighter)"
    return capture.with_frames(changed, remark)


def _brightness(image: Array) -> Array:
    """The strongest channel of some pixels of a decoded image, in shares of 1, without black and see-through ones."""
    most = np.float32(65535 if image.dtype == np.uint16 else 255 if image.dtype == np.uint8 else 1)
    flat = image.reshape(-1, 1) if image.ndim == 2 else image.reshape(-1, image.shape[2])
    flat = flat[:: max(1, len(flat) // PIXELS)].astype(np.float32) / most
    strongest = flat[:, :3].max(axis=1)
    seen = np.isfinite(strongest) & (strongest > 0)
    return strongest[seen & (flat[:, 3] > 0.5)] if flat.shape[1] == 4 else strongest[seen]


def _balance(frames: Sequence[Frame]) -> raw.Balance:
    """The median of the white balances that the camera chose for some of its raw files."""
    found = []
    for frame in spread([frame for frame in frames if raw.is_raw(frame.image)], SAMPLED):
        with suppress(InputError):
            if (balance := raw.camera_balance(read_bytes(frame.image), frame.image)) is not None:
                found.append(balance)
    red, green, blue = np.median(found, axis=0).tolist() if found else (1.0, 1.0, 1.0)
    return float(f"{red:.4g}"), green, float(f"{blue:.4g}")


def _is_floating(frame: Frame) -> bool:
    try:
        return read_header(read_bytes(frame.image), frame.image).floating
    except InputError:
        return False


def _holds_linear(frames: Sequence[Frame]) -> str:
    """Why floating-point images are taken for linear light; empty where they are levels of 8 or 16 bits, or whole numbers."""
    over = level = 0
    judged = 0
    for frame in spread(frames, JUDGED):
        try:
            image, header = decode(frame.image)
        except InputError:
            continue
        if (by_profile := is_linear(header.profile)) is not None:
            return "by their profile" if by_profile else ""
        values = _brightness(image)
        if not values.size or np.percentile(values, BRIGHT) >= WHOLE:
            continue
        judged += 1
        within = values[values <= 1]
        over += len(within) < len(values)
        level += any((np.abs(within * top - np.round(within * top)) < LEVEL).mean() > LEVELS for top in (255, 65535)) if within.size else 0
    if not judged or level > judged / 2:
        return ""
    return "as values exceed 1" if over else "as they are no levels of 8 or 16 bits: --set capture.light=display if they are for screens"


def _fewer_bits(capture: Capture, progress: Progress) -> Capture:
    """The capture with `Frame.white` where its images use 10, 12 or 14 of 16 bits, by the files' headers or their largest value."""
    deep = [frame for frame in capture.frames if frame.image.suffix.lower() in (*TIFFS, ".png") and frame.video_index is None]
    most, by_header = 0, True
    for number, frame in enumerate(deep):
        progress.check()
        try:
            header = read_header(read_bytes(frame.image), frame.image)
            if header.deep and header.white is not None:
                most = max(most, header.white)
            elif header.deep:
                image, by_header = decode(frame.image)[0], False
                colours = image[..., :3] if image.ndim == 3 else image
                most = max(most, int(colours.max()) if image.dtype == np.uint16 else 0)
        except InputError:
            continue  # reported where images are looked at
        if not header.deep or most > FEWER_BITS[-1]:
            return capture
        progress.update(number, len(deep), frame.name)
    if not deep or len(deep) < len(capture.frames) or most <= 255:
        return capture
    white = next(bits for bits in FEWER_BITS if most <= bits)
    why = "by the files' headers" if by_header else f"as no value exceeds {most}"
    remark = f"the images use {white.bit_length()} of 16 bits, {why}; {white} is taken for white"
    return capture.with_frames([replace(frame, white=white) for frame in capture.frames], remark)


def _whole_numbers(capture: Capture, progress: Progress) -> Capture:
    """The capture with `Frame.white` where its floating-point images hold whole numbers (up to 255 or 65535) instead of 0 to 1, and with a
    remark on these, or on values beyond 1 that are cut off."""
    found: dict[str, tuple[float, float]] = {}  # the largest value, and a high percentile of what is not black
    for frame in capture.frames:
        if frame.image.suffix.lower() not in TIFFS or frame.video_index is not None or frame.linear:
            continue
        progress.check()
        try:
            if not read_header(read_bytes(frame.image), frame.image).floating:
                break  # of a capture, all are of one kind
            image = decode(frame.image)[0]
        except InputError:
            continue  # reported where images are looked at
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
        return capture.with_frames(capture.frames, remark)
    white = next(value for value in FLOAT_WHITES if most <= value)
    remark = f"the floating-point images have values up to {most:.4g}; {white} is taken for white"
    return capture.with_frames([replace(frame, white=white) if frame.name in found else frame for frame in capture.frames], remark)
