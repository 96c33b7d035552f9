"""Which frames of a video (or another film) are worth keeping: sharp ones, spread evenly over the camera's motion rather than over time."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from fieldfuse.camera import Array
from fieldfuse.capture.checks import check_capture
from fieldfuse.capture.film import DEPTH, QUALITY, Film
from fieldfuse.capture.listing import counted
from fieldfuse.capture.sphere import to_cut, views_of
from fieldfuse.capture.types import Capture
from fieldfuse.capture.video import UNCOUNTED
from fieldfuse.config import CaptureSettings
from fieldfuse.errors import InputError
from fieldfuse.files import atomic_path, fingerprint, read_json, write_json
from fieldfuse.progress import SILENT, Progress

log = logging.getLogger(__name__)

SELECTED = "selected_from"  # in `Capture.extra`: readable frames of the video that images were taken from
VERSION = 1  # of the measurement stored beside the frames
TRACK_SIDE = 320  # long side of the images that motion is measured on
SHARP_SIDE = 640  # and sharpness
MIN_STEP = 0.008  # motion between chosen frames, share of the long side: less adds no parallax
MAX_STEP = 0.20  # more than this between neighbours leaves too little overlap to match
ANCHOR = 0.012  # motion after which a new reference frame is taken
STILL = 0.03  # motion in a whole video below which nothing can be learnt from it
BLANK = 0.05  # sharpness of frames that show one colour
BLURRED = 0.6  # of the sharpness around it: a frame that may be excluded
MEASURED = 1200  # frames of a long video that are measured, evenly spread: converting one of 3840×2160 takes longer than decoding it …
MEASURED_A_SECOND = 10  # … but never fewer, so that what is seen in one is still seen in the next
INTERLACED = ", or, since all frames come out alike, convert it if it is interlaced, as camcorders' are, which cannot be read"
FEWEST_CUT = 24  # frames of a 360° video, at least, if there are so many
JUMP = 0.30  # motion booked where tracking fails (a cut, a blank wall, strong blur)


@dataclass(frozen=True)
class Measure:
    """One number per readable frame of the video, or of every `stride`-th."""

    sharpness: list[float]  # of the small grey image
    motion: list[float]  # way that the image's corners have moved since the start, in long sides; never decreases


def select_frames(capture: Capture, out: Path, settings: CaptureSettings, progress: Progress = SILENT) -> Capture:
    """At most `settings.max_frames` sharp, well-spread frames of a video, written as images under `out/frames`.

    Two passes: the first measures frames small (all, or about `MEASURED` of a long video), the second writes the chosen ones as JPEG,
    with their depth where the file holds that too. The measurement stays in `out/selection.json` and images that are there are not
    written again, so a killed run continues where it stopped and a second run does nothing.

    Returns:
        the capture with images as its frames, in time order, with all other facts of each; `extra["selected_from"]` is the number of
        readable frames.

    Raises:
        InputError: not a video, or its frames are unusable (all alike, black, fewer than two).
        OutputError: the frames cannot be written.
    """
    if not capture.filmed:
        raise InputError(f"{capture.root} is not a video, there are no frames to choose")
    film, announced = Film.of(capture), len(capture.frames)
    video = film.path
    stride = stride_of(announced, float(capture.extra.get("fps") or 0))
    # What is posed has as many frames as poses, and not what the video may have beyond them, or between them.
    numbers, last = film.numbers[::stride], film.numbers[-1]
    every = range(0, announced, stride)
    wanted = (every if numbers == list(every) else numbers) if stride > 1 or capture.posed else None
    measure = _measured(film, last + 1, wanted, Path(out) / "selection.json", progress)
    readable = min(len(measure.sharpness) * stride, announced)
    if readable < 2:
        raise InputError(
            f"only {readable} of {announced} frames of the video {video} can be decoded; the file is damaged, copy or convert it again"
        )
    # Of interlaced frames FFmpeg inside OpenCV converts none, and reports all as converted: one piece of memory comes back each time.
    alike = f"{INTERLACED} (ffmpeg -i {video.name} -vf bwdif new.mp4)" if len(set(measure.sharpness)) == 1 and not capture.film else ""
    if np.median(measure.sharpness) < BLANK:
        raise InputError(f"the video {video} shows nothing (its frames are black or of one colour); check the camera and the file{alike}")
    if measure.motion[-1] < STILL:
        raise InputError(
            f"the camera does not move in the video {video}; depth needs views from different places, film while walking around the scene"
            f"{alike}"
        )
    most = settings.max_frames
    if cut := to_cut(capture):  # each becomes several images, of which half would show as much
        most = max(FEWEST_CUT, 2 * most // len(views_of(capture.frames[cut[0]].intrinsics)[0]))
    best = choose(measure, most)
    folder = Path(out) / "frames"
    chosen = {number: folder / f"frame_{number:06d}.jpg" for number in (best if wanted is None else [wanted[index] for index in best])}
    _write(film, chosen, last + 1, progress)
    frames = [film.written(number, path) for number, path in chosen.items()]
    remarks = []
    if readable < 0.95 * announced and video.suffix.lower() in UNCOUNTED:
        remarks.append(
            f"the video has {readable} frames that can be decoded, not the {announced} of its length and rate: its rate varies, as that "
            "of screen recordings, or it is damaged"
        )
    elif readable < 0.95 * announced:
        remarks.append(f"the video announces {announced} frames, {readable} could be decoded")
    steps = np.diff(np.asarray(measure.motion)[best])
    if wide := int((steps > MAX_STEP).sum()):
        remarks.append(
            f"the camera moves so fast that {wide} of {len(steps)} neighbouring frames overlap little; film slower, or raise max_frames"
        )
    if film.as_stored and len(measure.sharpness) < len(every):
        remarks.append(
            f"about {readable} of the {announced} frames of {video} that have a pose can be decoded; if those that are missing do not lie "
            "at its end, images and poses do not belong together, and --poses sfm finds others"
        )
    deep = sum(film.known[number].depth is not None for number in chosen if number in film.known)
    if lost := deep - sum(frame.depth is not None for frame in frames):
        remarks.append(f"the depth of {counted(lost, 'chosen frame')} is damaged and left out")
    extra = {**capture.extra, SELECTED: readable, "video": str(video)}
    picked = replace(capture, frames=tuple(frames), ordered=True, film=False, extra=extra, warnings=(*capture.warnings, *remarks))
    return check_capture(picked, progress)


def stride_of(announced: int, fps: float) -> int:
    """Every which frame is measured; 1 where the rate is not known."""
    return max(1, min(math.ceil(announced / MEASURED), int(fps / MEASURED_A_SECOND)))


def choose(measure: Measure, max_frames: int) -> list[int]:
    """Indices of the frames to keep, ascending.

    The way that the picture moved is cut into equal parts; each gives its best frame, by sharpness relative to the frames
    around it, minus a penalty for lying away from the part's middle. Still stretches have no way, so they give at most one.
    """
    count = len(measure.sharpness)
    way = np.asarray(measure.motion)
    total = float(way[-1]) if count else 0.0
    parts = max(1, min(max_frames, count, math.floor(total / MIN_STEP) + 1))
    # What the scene shows changes slowly, blur comes and goes: relative to the median of 31 frames.
    sharp = np.asarray(measure.sharpness)
    padded = np.pad(sharp, 15, mode="reflect" if count > 15 else "edge")
    median = np.median(np.lib.stride_tricks.sliding_window_view(padded, 31), axis=1)
    clear = np.clip(sharp / np.maximum(median, 1e-6), 0.05, 20.0)
    part = np.minimum((way / max(total, 1e-12) * parts).astype(int), parts - 1) if total > 0 else np.zeros(count, dtype=int)
    middle = (part + 0.5) * total / parts
    away = np.abs(way - middle) / max(0.5 * total / parts, 1e-12)  # 0 in the middle of its part, 1 at its border
    score = np.log(clear) - 0.4 * away**2
    best: dict[int, int] = {}
    for index in range(count):
        before = best.get(int(part[index]))
        if before is None or score[index] > score[before]:
            best[int(part[index])] = index
    chosen = sorted(best.values())
    # Blurred frames are excluded, the worst first, where the frames on both sides still overlap well without them.
    for index in sorted((index for index in chosen if clear[index] < BLURRED), key=lambda index: float(clear[index])):
        place = chosen.index(index)
        before, after = chosen[max(place - 1, 0)], chosen[min(place + 1, len(chosen) - 1)]
        if len(chosen) > 2 and way[after] - way[before] <= 0.5 * MAX_STEP:
            chosen.remove(index)
    return chosen


def sharpness(image: Array) -> float:
    """How sharp an image (H, W, 3) or (H, W) uint8 is, to be compared with others of nearly the same view: the Laplacian's variance."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image
    # A light blur first: otherwise sensor noise and blocks of a codec count as detail.
    return float(cv2.Laplacian(cv2.GaussianBlur(grey, (0, 0), 0.8), cv2.CV_32F).var())


def measure_frames(frames: Iterator[tuple[int, Array | None]], announced: int, progress: Progress = SILENT) -> Measure:
    """Sharpness and motion of images (H, W, 3) uint8 RGB in time order. Damaged ones (None) are as blurred as can be, and do not move."""
    sharp: list[float] = []
    motion: list[float] = []
    anchor: Array | None = None  # grey image that motion is counted from; a new one only after real motion, so jitter adds nothing
    way = 0.0
    for index, image in frames:
        progress.check()
        if len(sharp) % 10 == 0:
            progress.update(index, 2 * announced, f"frame {index} of {announced}")
        before = motion[-1] if motion else 0.0
        if image is None:
            sharp.append(0.0)
            motion.append(before)
            continue
        grey = cv2.cvtColor(_shrunk(image, SHARP_SIDE), cv2.COLOR_RGB2GRAY)
        sharp.append(sharpness(grey))
        small = _shrunk(grey, TRACK_SIDE)
        moved = 0.0 if anchor is None or anchor.shape != small.shape else displacement(anchor, small)
        motion.append(max(way + moved, before))
        if anchor is None or anchor.shape != small.shape or moved > ANCHOR:
            anchor, way = small, motion[-1]
    return Measure(sharp, motion)


def displacement(before: Array, after: Array) -> float:
    """How far the corners of one grey image have moved in the next: the mean, in long sides. `JUMP` when they are lost."""
    long_side = max(before.shape)
    corners = cv2.goodFeaturesToTrack(before, maxCorners=120, qualityLevel=0.01, minDistance=8)
    if corners is None or len(corners) < 8:
        # Nothing to track. Blank images that stay alike have not moved; others have, unknown how far.
        return 0.0 if float(np.abs(before.astype(np.float32) - after).mean()) < 2.0 else JUMP
    moved, found, error = cv2.calcOpticalFlowPyrLK(before, after, corners, corners.copy(), winSize=(21, 21), maxLevel=3)
    tracked = (found.ravel() == 1) & (error.ravel() < 25)
    if tracked.sum() < max(8, 0.25 * len(corners)):
        return JUMP
    length = np.linalg.norm((moved - corners).reshape(-1, 2)[tracked], axis=1)
    return float(min(np.mean(np.clip(length, 0, np.quantile(length, 0.9))) / long_side, JUMP))


def _measured(film: Film, announced: int, wanted: Sequence[int] | None, path: Path, progress: Progress) -> Measure:
    """The measurement stored at `path` when it is of this very file, else a new one, stored there."""
    key = fingerprint(VERSION, *film.state(), *([wanted.stop, wanted.step] if isinstance(wanted, range) else [wanted] if wanted else []))
    if path.is_file():
        try:
            stored = read_json(path)
            measure = Measure([float(value) for value in stored["sharpness"]], [float(value) for value in stored["motion"]])
            whole = len(measure.sharpness) == len(measure.motion) > 0 and np.isfinite([measure.sharpness, measure.motion]).all()
            if stored["key"] == key and whole:
                return measure
        except (InputError, KeyError, TypeError, ValueError):
            log.info("%s is not readable, frames are measured again", path)
    measure = measure_frames(film.images(wanted), announced, progress)
    write_json(path, {"key": key, **{name: [round(value, 6) for value in values] for name, values in asdict(measure).items()}})
    return measure


def _write(film: Film, wanted: dict[int, Path], announced: int, progress: Progress) -> None:
    """Write the chosen frames (number → file), and the depth that lies with them, that are not there yet, and remove those of an earlier
    choice."""
    folder = next(iter(wanted.values())).parent
    depths = {number: depth for number, path in wanted.items() if (depth := film.depth_at(number, path)) is not None}
    marker = folder / "source.json"
    origin = {"video": fingerprint(VERSION, *film.state()), "quality": QUALITY}
    try:
        same = marker.is_file() and read_json(marker) == origin
    except InputError:
        same = False
    for stale in (*folder.glob("frame_*.jpg"), *(folder / DEPTH).glob("frame_*")):
        if not same or stale not in {*wanted.values(), *depths.values()}:
            stale.unlink(missing_ok=True)
    if not same:
        write_json(marker, origin)
    for number, data in film.jpegs({number for number, path in wanted.items() if not path.is_file()}):
        progress.check()
        progress.update(announced + number, 2 * announced, f"writing frame {number}")
        with atomic_path(wanted[number]) as temporary:
            temporary.write_bytes(data)
    for number, path in depths.items():
        if not path.is_file():
            progress.check()
            film.write_depth(number, path)
    for number, path in wanted.items():
        if not path.is_file():
            raise InputError(f"frame {number} of {film.path} could be decoded once and not again; the file or the disk is damaged")


def _shrunk(image: Array, long_side: int) -> Array:
    height, width = image.shape[:2]
    factor = long_side / max(height, width)
    if factor >= 1:
        return image
    return np.asarray(cv2.resize(image, (max(1, round(width * factor)), max(1, round(height * factor))), interpolation=cv2.INTER_AREA))
