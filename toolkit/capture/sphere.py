"""Views of a sphere: panoramas and fisheye images cut into overlapping pinhole images, as all later stages take them.

The views of one image are one rig: they have one place and time, and their rotations to each other are known exactly, as their
intrinsics are. Panoramas give a ring of six views of 90° and one straight up; what lies below is the tripod, or the person with the camera.
Of a fisheye lens as few views are cut as keep `ENOUGH` of what it shows.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from fieldfuse.camera import EQUIRECTANGULAR, FISHEYE, Array, Intrinsics, directions_of, seen_at
from fieldfuse.capture.calibration import fitted
from fieldfuse.capture.checks import check_capture
from fieldfuse.capture.convert import MOST_AT_ONCE, PIXELS_AT_ONCE, save_image, still_good
from fieldfuse.capture.headers import image_header
from fieldfuse.capture.images import load_depth, load_image, load_mask, spread, turns_by_exif
from fieldfuse.capture.listing import counted
from fieldfuse.capture.types import CUT, Capture, Frame
from fieldfuse.files import atomic_path, fingerprint
from fieldfuse.progress import SILENT, Progress
from fieldfuse.threads import share

VERSION = 1  # of what is cut, and how
VIEWS = "views"  # folder of the views, in the run's `frames`
SIDE = 1024  # pixels of a view at most, unless larger images are wanted
MOST_SIDE = 100_000  # pixels, before that
FIELD = 90.0  # degrees across a view
ENOUGH = 0.95  # of the solid angle that a lens shows: what its views have to keep
AROUND = 6  # views of a panorama along the horizon
SAMPLES = 4000  # directions that shares are measured by
LOOKED_AT, CIRCLE = 12, 256  # fisheye images by which the image circle is found, and their pixels across
UNLIT, LEAST_OUTSIDE = 12, 0.01  # grey level below which a pixel is black; share of an image outside the circle that matters
WRAP = 4  # columns of a panorama that are repeated beyond its edges, for interpolation
# Of a fisheye lens: is there a view along the axis, how many around it, and from where these are counted (in steps, from the right)
PATTERNS = (
    (True, 0, 0.0), (False, 2, 0.0), (False, 2, 0.5), (False, 3, 0.0), (True, 2, 0.0), (False, 4, 0.5),
    (True, 4, 0.0), (True, 4, 0.5), (True, 5, 0.0), (True, 6, 0.0), (True, 8, 0.0),
)  # fmt: skip
TILTS = np.arange(20.0, 90.1, 5.0)  # degrees from the axis


@dataclass(frozen=True, eq=False)
class View:
    """A pinhole view of what another camera shows at the same place."""

    camera: Intrinsics
    source_from_view: Array  # (3, 3)


# ------------------------------------------------------------------------------------------------ which views


@lru_cache(maxsize=64)
def views_of(camera: Intrinsics, side: int = SIDE) -> tuple[tuple[View, ...], float]:
    """The views, of at most `side` pixels each, that a panorama or fisheye image is cut into, and the share of the solid angle shown that
    they keep. No views: the image is used as it is, since its own pinhole image keeps enough (`share_of_pinhole`)."""
    if camera.lens == EQUIRECTANGULAR:
        turns = [*(_looking(0, 360 * k / AROUND) for k in range(AROUND)), _looking(90, 0)]
        return (made := _limited([_square(camera, turn) for turn in turns], side)), _kept(camera, made)
    if camera.lens != FISHEYE or share_of_pinhole(camera) >= ENOUGH:
        return (), 1.0
    # Each image of a capture may have a camera of its own, and they hardly differ: what is searched for is searched for once.
    width, height = 1000, max(1, round(1000 * camera.height / camera.width))
    alike = camera.scaled(width, height)
    rounded = {name: round(getattr(alike, name)) for name in ("fx", "fy", "cx", "cy")}
    turns = _turns(replace(alike, **rounded, distortion=tuple(round(value, 2) for value in camera.distortion)))
    cropped = [view for turn in turns if (view := _cropped(camera, _square(camera, turn))) is not None]
    made = _limited(cropped, side if len(cropped) > 1 else max(side, camera.width, camera.height))
    return made, _kept(camera, made)


@lru_cache(maxsize=64)
def _turns(camera: Intrinsics) -> list[Array]:
    """(3, 3) source_from_view of as few views as keep `ENOUGH` of what a fisheye lens shows, or of those that keep most."""
    best: tuple[list[Array], float] = ([], 0.0)
    for along, around, first in PATTERNS:
        for tilt in TILTS if around else (0.0,):
            turns = [np.eye(3)] * along + [_tilted(tilt, 360 * (k + first) / around) for k in range(around)]
            if (kept := _kept(camera, tuple(_square(camera, turn) for turn in turns))) > best[1] + 1e-9:
                best = turns, kept
        if best[1] >= ENOUGH:
            break
    return best[0]


def share_of_pinhole(camera: Intrinsics) -> float:
    """Share of the solid angle shown by a lens (up to `WIDEST` off its axis) that the pinhole image of its size and focal length has."""
    return _kept(camera, (View(camera.pinhole(), np.eye(3)),))


def _looking(up: float, right: float) -> Array:
    """(3, 3) source_from_view of a view that looks so many degrees up and to the right."""
    return np.asarray(Rotation.from_euler("YX", [right, up], degrees=True).as_matrix())


def _tilted(tilt: float, towards: float) -> Array:
    """(3, 3) source_from_view of a view tilted from the axis towards an angle in the image, from the right clockwise, without a roll."""
    turn = np.radians(towards)
    return np.asarray(Rotation.from_rotvec(np.radians(tilt) * np.array([-np.sin(turn), np.cos(turn), 0.0])).as_matrix())


def _square(camera: Intrinsics, source_from_view: Array) -> View:
    """A view of `FIELD`, with the pixels that the source has in the middle."""
    half = math.tan(math.radians(FIELD) / 2)
    side = int(np.clip(2 * half * math.sqrt(camera.fx * camera.fy), 16, MOST_SIDE))
    focal = side / (2 * half)
    return View(Intrinsics(side, side, focal, focal, side / 2, side / 2), source_from_view)


def _limited(views: list[View], side: int) -> tuple[View, ...]:
    """The views, all made smaller by the same factor where the largest has more pixels than `side`."""
    factor = min(1.0, side / max((max(view.camera.width, view.camera.height) for view in views), default=side))
    sizes = [(max(1, round(view.camera.width * factor)), max(1, round(view.camera.height * factor))) for view in views]
    return tuple(replace(view, camera=view.camera.scaled(*size)) for view, size in zip(views, sizes, strict=True))


def _cropped(camera: Intrinsics, view: View) -> View | None:
    """The view without rows and columns that show nothing of the source; None where all are such."""
    step = max(1, view.camera.width // 96)
    grid = np.arange(step / 2, view.camera.width, step)
    seen = seen_at(camera, _rays(view, *np.meshgrid(grid, grid)))[1]
    if not seen.any():
        return None
    (left, right), (top, bottom) = (
        (max(0, int(at[0]) - step), min(view.camera.width, math.ceil(at[-1]) + step))
        for at in (grid[np.flatnonzero(seen.any(axis=axis))] for axis in (0, 1))
    )
    own = view.camera
    return View(replace(own, width=right - left, height=bottom - top, cx=own.cx - left, cy=own.cy - top), view.source_from_view)


def _rays(view: View, u: Array, v: Array) -> Array:
    """(..., 3) directions in the source's axes of a view's pixels, of length 1 along the view's axis."""
    own = view.camera
    x, y = np.broadcast_arrays((u - own.cx) / own.fx, (v - own.cy) / own.fy)
    return np.stack([x, y, np.ones_like(x)], axis=-1) @ view.source_from_view.T


def _pixel_rays(view: View) -> Array:
    """(h, w, 3) the same through all pixel centres."""
    return _rays(view, *np.meshgrid(np.arange(view.camera.width) + 0.5, np.arange(view.camera.height) + 0.5))


def _kept(camera: Intrinsics, views: tuple[View, ...]) -> float:
    """Share of the directions which a camera shows that some of its views show."""
    shown = _shown(camera)
    inside = np.zeros(len(shown), dtype=bool)
    for view in views:
        inside |= seen_at(view.camera, shown @ view.source_from_view)[1]
    return float(inside.mean()) if len(shown) else 1.0


@lru_cache(maxsize=64)
def _shown(camera: Intrinsics) -> Array:
    """(N, 3) evenly spread directions in a camera's axes that its image shows, of a panorama all."""
    index = np.arange(SAMPLES) + 0.5
    lowest = -1.0
    if camera.lens != EQUIRECTANGULAR:
        corners = np.array([(u, v) for u in (0, camera.width) for v in (0, camera.height)], dtype=np.float64)
        lowest = float(directions_of(camera, corners)[:, 2].min())
    z, angle = 1 - (1 - lowest) * index / SAMPLES, index * np.pi * (3 - np.sqrt(5))
    flat = np.sqrt(1 - z * z)
    every = np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=1)
    return np.asarray(every[seen_at(camera, every)[1]])


# ------------------------------------------------------------------------------------------------ cutting


def to_cut(capture: Capture) -> list[int]:
    """Indices of the frames whose images are to be cut into views, where that was announced (`announced`)."""
    if CUT not in capture.extra:
        return []
    return [i for i, frame in enumerate(capture.frames) if frame.instant is None and frame.intrinsics and views_of(frame.intrinsics)[0]]


def announced(capture: Capture) -> Capture:
    """The capture with a sentence in `extra["cut"]`, where images of it are to be cut."""
    cameras = [frame.intrinsics for frame in capture.frames if frame.intrinsics is not None and views_of(frame.intrinsics)[0]]
    if not cameras:
        return capture
    numbers, kept = {len(views_of(camera)[0]) for camera in cameras}, min(views_of(camera)[1] for camera in set(cameras))
    lenses = {camera.lens for camera in cameras}
    kind = "wide" if len(lenses) > 1 else "360°" if EQUIRECTANGULAR in lenses else "fisheye"
    many = counted(len(cameras), f"{kind} image")
    into = " or ".join(str(number) for number in sorted(numbers))
    text = f"each of {many} is cut into {into} views; {100 * kept:.0f}% of what it shows is kept"
    return replace(capture, extra={**capture.extra, CUT: text})


def cut_images(capture: Capture, out: Path, threads: int, progress: Progress = SILENT, side: int = SIDE) -> Capture:
    """The capture with every frame of `to_cut` replaced by its views (`views_of`), as JPEG (with alpha: PNG) in `out/frames/views`, in sRGB
    and upright.

    Views of a frame have its pose, turned; their masks leave out what the lens does not show; depth becomes that along the view's own axis,
    and of panoramas is left out. What is there and is of the same file is not written again.

    Returns:
        the capture, checked.

    Raises:
        InputError: an image, mask or depth map is damaged, or the capture is unusable (see `check_capture`).
        OutputError: a view cannot be written.
    """
    indices, exif = to_cut(capture), turns_by_exif(capture)
    folder = Path(out) / "frames" / VIEWS
    frames = dict(zip(indices, (capture.frames[i] for i in indices), strict=True))
    names = {i: _names(frame) for i, frame in frames.items()}
    states = {i: fingerprint(VERSION, side, frame.intrinsics, exif, *_state(frame)) for i, frame in frames.items()}
    done = still_good(folder, {name: states[i] for i in indices for name in names[i]})
    lit = image_circles(list(frames.values()), exif) if len(done) < sum(map(len, names.values())) else {}
    finished = 0

    def cut(index: int) -> tuple[int, list[Frame]]:
        nonlocal finished
        progress.check()
        where = {folder / name: done.get(name) for name in names[index]}
        written = list(_cut(frames[index], capture, where, side, lit.get(image_header(frames[index].image).size)))
        finished += 1
        progress.update(finished, len(indices), f"views of {finished} of {counted(len(indices), 'image')}")
        return index, written

    largest = max((math.prod(image_header(frame.image).size) for frame in frames.values()), default=1)
    at_once = max(1, min(threads, MOST_AT_ONCE, int(PIXELS_AT_ONCE / max(1, largest))))
    made = dict(share(cut, indices, at_once))
    every = [view for i, frame in enumerate(capture.frames) for view in made.get(i, [frame])]
    deep = sum(frame.depth is not None and _is_panorama(frame) for frame in frames.values())
    remark = [f"{capture.extra[CUT]}; the views lie in the run's frames/{VIEWS}, and exported cameras are theirs"]
    remark += [f"the depth of {counted(deep, 'panorama')} is not used, since it is not measured along one axis"] if deep else []
    return check_capture(capture.with_frames(every, *remark), progress)


def image_circles(frames: Sequence[Frame], exif: bool) -> dict[tuple[int, int], Array]:
    """What fisheye lenses light up of their images, by the images' size as stored, where that is less than all: (h, w) bool, `CIRCLE`
    pixels across. Beyond the image circle of some of them all images are black, up to the border."""
    brightest: dict[tuple[int, int], Array] = {}
    fisheye = [frame for frame in frames if not _is_panorama(frame)]
    for frame in spread(fisheye, LOOKED_AT):
        image = load_image(frame, exif=exif)[..., :3]
        height = max(1, round(CIRCLE * image.shape[0] / image.shape[1]))
        small = cv2.resize(image, (CIRCLE, height), interpolation=cv2.INTER_AREA).max(axis=2)
        size = image_header(frame.image).size
        before = brightest.setdefault(size, small)
        brightest[size] = np.maximum(before, small) if before.shape == small.shape else before
    found = {}
    for size, grey in brightest.items():
        _, part = cv2.connectedComponents((grey < UNLIT).astype(np.uint8))
        border = np.unique(np.concatenate([part[0], part[-1], part[:, 0], part[:, -1]]))
        outside = np.isin(part, border[border > 0])
        if outside.mean() > LEAST_OUTSIDE:
            found[size] = ~cv2.dilate(outside.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)  # the rim is half lit
    return found


def _is_panorama(frame: Frame) -> bool:
    return frame.intrinsics is not None and frame.intrinsics.lens == EQUIRECTANGULAR


def _names(frame: Frame) -> list[str]:
    assert frame.intrinsics is not None
    return [f"{frame.name.replace('/', '_')}_view{number}" for number in range(len(views_of(frame.intrinsics)[0]))]


def _state(frame: Frame) -> list[object]:
    """What distinguishes the files that a frame's views are made of."""
    shown = [frame.white, frame.linear, frame.balance]
    return [frame.image, frame.mask or "", frame.depth or "", frame.confidence or "", shown, frame.mask_excludes]


def _cut(frame: Frame, capture: Capture, done: dict[Path, Path | None], side: int, lit: Array | None) -> Iterator[Frame]:
    """The views of a frame, written unless they are `done` (file without its suffix → file); `lit` as of `image_circles`."""
    exif, camera = turns_by_exif(capture), frame.intrinsics
    assert camera is not None
    views, _ = views_of(camera, side)
    missing = [target for target, path in done.items() if path is None]
    image = load_image(frame, exif=exif) if missing else None
    allowed = load_mask(frame, exif=exif) if missing and not frame.mask_is_alpha else None
    deep = frame.depth is not None and not _is_panorama(frame)
    depth = load_depth(frame, capture) if missing and deep else None
    for (target, path), view in zip(done.items(), views, strict=True):
        mask_path, depth_path = target.parent / "mask" / f"{target.name}.png", target.parent / "depth" / f"{target.name}.npy"
        if path is None:
            assert image is not None
            if depth is not None:
                source = fitted(frame.depth_intrinsics or camera, (depth.shape[1], depth.shape[0]), str(frame.depth))
                _save_array(depth_path, depth_in_view(depth, source, view) * np.float32(capture.depth_scale))
            pixels, seen = cut_view(image, camera, view)
            for usable in (allowed, lit):
                if usable is not None:
                    seen &= _nearest(usable, camera, view)
            _remove_or_save_mask(mask_path, seen)
            path = save_image(pixels, target, frame.image)  # last: where it is, the others are
        pose = np.eye(4)
        pose[:3, :3] = view.source_from_view
        yield Frame(
            name=target.name,
            image=path.resolve(),
            intrinsics=view.camera,
            world_from_camera=None if frame.world_from_camera is None else frame.world_from_camera @ pose,
            depth=depth_path.resolve() if deep else None,
            mask=mask_path.resolve() if mask_path.is_file() else None,
            split=frame.split,
            instant=frame.name,
            source_from_view=pose,
        )


def cut_view(image: Array, camera: Intrinsics, view: View) -> tuple[Array, Array]:
    """A view of an image (H, W, C) uint8 of `camera`, whatever its size: pixels (h, w, C) uint8, and (h, w) bool where the source shows
    something. The image is first shrunk, by areas, to the view's resolution in its middle: then nothing is skipped."""
    own, height = camera.scaled(image.shape[1], image.shape[0]), image.shape[0]
    factor = view.camera.fx / math.sqrt(own.fx * own.fy)
    if factor < 0.99:
        image = cv2.resize(image, (max(2, round(own.width * factor)), max(2, round(height * factor))), interpolation=cv2.INTER_AREA)
        own = own.scaled(image.shape[1], image.shape[0])
    map_x, map_y, seen = _maps(own, view)
    if camera.lens == EQUIRECTANGULAR:
        image = cv2.copyMakeBorder(image, 0, 0, WRAP, WRAP, cv2.BORDER_WRAP)
        map_x = map_x + np.float32(WRAP)
    return np.asarray(cv2.remap(image, map_x, map_y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)), seen.copy()


def depth_in_view(depth: Array, camera: Intrinsics, view: View) -> Array:
    """(H, W) float32 depth along the axis of `camera`, 0 = missing → (h, w) float32 along the view's, from the nearest values. What lies
    farther than 89° off the camera's axis has no such depth."""
    rays = _pixel_rays(view)
    ahead = rays[..., 2] > math.cos(math.radians(89)) * np.linalg.norm(rays, axis=-1)
    found = _nearest(depth, camera, view)
    return np.asarray(np.where(ahead, found / np.where(ahead, rays[..., 2], 1.0), 0), dtype=np.float32)


def _nearest(values: Array, camera: Intrinsics, view: View) -> Array:
    """The (H, W) map `values` of `camera`, whatever its size, at the pixels of a view; zero or False where it shows nothing."""
    height, width = values.shape
    map_x, map_y, seen = _maps(camera.scaled(width, height), view)
    column, row = ((np.clip(np.floor(at + 0.5), 0, last - 1)).astype(np.intp) for at, last in ((map_x, width), (map_y, height)))
    return np.where(seen, values[row, column], values.dtype.type(0))


@lru_cache(maxsize=16)
def _maps(camera: Intrinsics, view: View) -> tuple[Array, Array, Array]:
    """Where each pixel of a view lies in the image of `camera`: maps (h, w) float32 in OpenCV's whole-number coordinates, and whether it
    does, (h, w) bool."""
    pixels, seen = seen_at(camera, _pixel_rays(view))
    pixels = np.where(np.isfinite(pixels), pixels, 0.0)
    return (pixels[..., 0] - 0.5).astype(np.float32), (pixels[..., 1] - 0.5).astype(np.float32), seen


def _remove_or_save_mask(path: Path, seen: Array) -> None:
    if seen.all():
        path.unlink(missing_ok=True)
        return
    with atomic_path(path) as temporary:
        temporary.write_bytes(cv2.imencode(".png", seen.astype(np.uint8) * 255)[1].tobytes())


def _save_array(path: Path, values: Array) -> None:
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.save(file, values)
