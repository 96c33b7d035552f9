"""The pieces of instant-ngp's, nerfstudio's and Blender's JSON: numbers, cameras, poses and listed files, all checked."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fieldfuse.camera import FISHEYE, OPENCV, PINHOLE, Array, Intrinsics, world_from_opengl
from fieldfuse.capture.headers import PANORAMA
from fieldfuse.capture.listing import counted
from fieldfuse.capture.mirrored import mirrors, unmirrored
from fieldfuse.capture.poses import checked_pose
from fieldfuse.capture.resolve import Found
from fieldfuse.capture.sizes import UNREADABLE, fitted, picture_header
from fieldfuse.capture.types import Frame
from fieldfuse.errors import InputError

MAX_SIDE = 1_000_000  # pixels
PANORAMAS = ("EQUIRECTANGULAR", "SPHERICAL", "VR180_L", "VR180_R", "OMNIDIRECTIONALSTEREO_L", "OMNIDIRECTIONALSTEREO_R")
SAME_FACTOR = 0.1  # how far a principal point may lie from a larger picture's centre to be taken for it
SQUARE = 1.15  # ratio of the focal lengths up to which pixels are nearly square
FOCALS = (0.1, 50.0)  # of an image's longer side: focal lengths that cameras have
OTHER_KEYS = (("f1_x", "f1_y", "c1_x", "c1_y"), ("fx", "fy", "cx", "cy"), ("f_x", "f_y", "c_x", "c_y"), ("focal_x", "focal_y", "cx", "cy"))
Listed = tuple[Mapping[str, Any], Mapping[str, Any], str]  # what all frames share, an entry, and where it stands (for messages)
MODELS = {
    "OPENCV": OPENCV,
    "SIMPLE_RADIAL": OPENCV,
    "RADIAL": OPENCV,
    "FULL_OPENCV": OPENCV,
    "PERSPECTIVE": OPENCV,
    "OPENCV_FISHEYE": FISHEYE,
    "FISHEYE": FISHEYE,
    # nerfstudio and instant-ngp apply coefficients of these too, so a file that has some was made for that.
    "PINHOLE": OPENCV,
    "SIMPLE_PINHOLE": OPENCV,
}


def number(data: Mapping[str, Any], key: str, where: str) -> float | None:
    """`data[key]` as a finite float, None when absent.

    Raises:
        InputError: something else stands there.
    """
    value = data.get(key)
    if value is None:
        return None
    try:
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise ValueError
        return float(value)
    except (ValueError, OverflowError) as error:
        raise InputError(f"{where}: {key!r} must be a finite number, not {str(value)[:40]!r}; correct it") from error


def matrix(value: Any, where: str) -> Array:
    """A (4, 4) float64 matrix from nested lists of 3×4 or 4×4 numbers. Its values are not judged.

    Raises:
        InputError: something else stands there.
    """
    try:
        array = np.array(value, dtype=np.float64)
    except (ValueError, TypeError, OverflowError) as error:
        raise InputError(f"{where} is not a 4×4 matrix of numbers; correct it") from error
    if array.shape == (3, 4):
        array = np.concatenate([array, [[0.0, 0.0, 0.0, 1.0]]])
    if array.shape != (4, 4):
        raise InputError(f"{where} has shape {array.shape}, a 4×4 matrix is expected; correct it")
    return array


def frame_list(data: Mapping[str, Any], path: Path) -> list[dict[str, Any]]:
    """The entries of `frames`, each with a `file_path`.

    Raises:
        InputError: there is no such list, or it is empty.
    """
    frames = data.get("frames")
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{path} lists no frames; a list named 'frames' is expected")
    for index, entry in enumerate(frames):
        if not isinstance(entry, dict) or not isinstance(entry.get("file_path"), str) or not entry["file_path"].strip():
            raise InputError(f"{path}: frame {index} has no 'file_path'; correct it")
    return frames


def listed_names(entries: Sequence[Mapping[str, Any]], keys: Sequence[str], path: Path) -> list[str | None]:
    """What each entry lists under the first of `keys` that it has; None where it has none of them.

    Raises:
        InputError: not a name.
    """
    out: list[str | None] = []
    for index, entry in enumerate(entries):
        listed = next((entry[key] for key in keys if entry.get(key) is not None), None)
        if listed is not None and not isinstance(listed, str):
            raise InputError(f"{path}, frame {index}: a file's name is expected, not {str(listed)[:40]!r}; correct it")
        out.append(listed)
    return out


def missing_remarks(count: int, found: Found) -> list[str]:
    """What to say when some of `count` listed images are not there."""
    missing = count - found.count
    if not missing:
        return []
    where = " (of some the paths lead outside the capture folder, where nothing is read)" if found.outside else ""
    return [f"{missing} of the {count} listed pictures do not exist{where}; the other {count - missing} are used"]


def once_each(frames: Sequence[Frame]) -> tuple[list[Frame], list[str]]:
    """Frames without those that list an image once more with the same pose and camera.

    Raises:
        InputError: an image is listed with two poses or cameras.
    """
    first: dict[Path, Frame] = {}
    for frame in frames:
        other = first.setdefault(frame.image, frame)
        if other is not frame and (other.intrinsics != frame.intrinsics or _apart(other.world_from_camera, frame.world_from_camera)):
            raise InputError(f"{frame.image} is listed twice, with different poses or cameras; keep the entry that is right")
    copies = len(frames) - len(first)
    return list(first.values()), [f"{counted(copies, 'picture')} listed once more with the same pose, used once"] if copies else []


def pose(entry: Mapping[str, Any], where: str) -> Array:
    """world_from_camera (4, 4) in OpenCV axes from an entry's OpenGL `transform_matrix`.

    Raises:
        InputError: absent, not finite, singular or not rigid.
    """
    return checked_pose(_pose_matrix(entry, where), where)


def _pose_matrix(entry: Mapping[str, Any], where: str) -> Array:
    """The same whose values are not judged."""
    if entry.get("transform_matrix") is None:
        raise InputError(f"{where} has no 'transform_matrix'; remove this frame or add its pose")
    return world_from_opengl(matrix(entry["transform_matrix"], f"{where}: 'transform_matrix'"))


def camera(shared: Mapping[str, Any], entry: Mapping[str, Any], size: tuple[int, int], where: str) -> Intrinsics:
    """The camera that the JSON describes, for the picture size that it names (or `size` when it names none).

    What stands in the frame's entry goes before what all frames share. Focal lengths `fl_x`, `fl_y` go before
    `camera_angle_x`, `camera_angle_y` (full angles, radians): f = (w / 2) / tan(angle / 2).

    Raises:
        InputError: no focal length, a value that is not usable, or a lens that cannot be modelled.
    """

    def value(key: str) -> float | None:
        own = number(entry, key, where)
        return number(shared, key, where) if own is None else own

    width = round(value("w") or size[0])
    height = round(value("h") or size[1])
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE):
        raise InputError(f"{where}: the picture size {width:g}×{height:g} is not usable; correct 'w' and 'h'")
    fx, fy = value("fl_x"), value("fl_y")
    cx, cy = value("cx"), value("cy")
    if fx is None and fy is None and (other := _other_keys(value, width, height)) is not None:
        fx, fy, cx, cy = other
    else:
        across, down = _turned_back(value("camera_angle_x"), value("camera_angle_y"), width, height)
        fx, fy = _focal(fx, across, width, where), _focal(fy, None if fx else down, height, where)
    fx, fy = (fy if fx is None else fx), (fx if fy is None else fy)
    if fx is None or fy is None:
        raise InputError(f"{where}: there is no focal length ('fl_x' or 'camera_angle_x'); add it, or use the pictures alone as photos")
    if cx == 0 and cy == 0:  # not filled in: no camera has its principal point in the very corner
        cx = cy = None
    lens, distortion = _lens(shared, entry, value, where)
    cx, cy = (width / 2 if cx is None else cx), (height / 2 if cy is None else cy)
    return Intrinsics(width, height, fx, fy, cx, cy, lens, distortion).checked(where)


def picture_camera(shared: Mapping[str, Any], entry: Mapping[str, Any], size: tuple[int, int], where: str) -> Intrinsics:
    """The same of a picture that is there, `size` (width, height) large: its principal point has to lie in it.

    Raises:
        InputError: as `camera`; the principal point lies outside, or the json seems to be for a picture of another size.
    """
    described = camera(shared, entry, size, where)
    if all(data.get(key) is None for data in (shared, entry) for key in ("w", "h")):
        # Without 'w' and 'h' nothing else tells that the pictures were made smaller since.
        factor = round(2 * described.cx / described.width)
        if factor >= 2 and all(
            abs(2 * at / length / factor - 1) < SAME_FACTOR
            for at, length in ((described.cx, described.width), (described.cy, described.height))
        ):
            raise InputError(
                f"{where}: the principal point ({described.cx:g}, {described.cy:g}) is the centre of a picture {factor} times as large as "
                f"the {described.width}×{described.height} one at hand; add 'w' and 'h', the size that the intrinsics are for"
            )
    return described.centred(where)


def says_pinhole(shared: Mapping[str, Any], entry: Mapping[str, Any]) -> bool:
    """Whether a camera model without a lens is named, whatever coefficients stand beside it."""
    return str(entry.get("camera_model", shared.get("camera_model"))).upper() in ("PINHOLE", "SIMPLE_PINHOLE")


def bent_remarks(count: int) -> list[str]:
    """What to say when `count` pictures have such a camera and a lens all the same."""
    if not count:
        return []
    return [
        f"{counted(count, 'picture')} with a PINHOLE camera and lens coefficients (k1, …), which are applied as in nerfstudio; "
        "remove them from the json if the pictures are undistorted already"
    ]


def _apart(one: Array | None, two: Array | None) -> bool:
    return one is None or two is None or not np.allclose(one, two, atol=1e-9)


def read_frames(listed: Sequence[Listed], images: Sequence[Path]) -> tuple[list[Frame], list[str]]:
    """Frames, without names yet, of entries whose images are there; and remarks.

    Raises:
        InputError: a pose or camera is not usable, or an image is of another shape than its camera.
    """
    scaled = bent = 0
    sizes = [picture_header(image).size for image in images]
    usual = next((size for size in sizes if size != UNREADABLE.size), UNREADABLE.size)
    sizes = [usual if size == UNREADABLE.size else size for size in sizes]
    cameras = []
    for (shared, entry, where), size, image in zip(listed, sizes, images, strict=True):
        described = picture_camera(shared, entry, size, where)
        cameras.append(fitted(described, size, where, image))
        scaled += cameras[-1] is not described
        bent += described.distorted and says_pinhole(shared, entry)
    poses, turned = _poses(listed, images, cameras)
    frames = [
        Frame(name="", image=image, intrinsics=intrinsics, world_from_camera=pose)
        for image, intrinsics, pose in zip(images, cameras, poses, strict=True)
    ]
    remarks = []
    if scaled:
        remarks.append(f"{counted(scaled, 'picture')} of another size than the json tells; intrinsics were scaled to fit")
    return frames, [*remarks, *bent_remarks(bent), *_camera_remarks(listed, sizes), *turned]


def _poses(
    listed: Sequence[Listed], images: Sequence[Path], cameras: Sequence[Intrinsics]
) -> tuple[list[Array], list[str]]:
    """world_from_camera (4, 4) of each entry in OpenCV axes, and remarks."""
    raw = [_pose_matrix(entry, where) for _, entry, where in listed]
    if len(raw) > 2 and all(map(mirrors, raw)):
        mended = unmirrored(raw, images, cameras)
        if mended is not None:
            return [checked_pose(matrix, where) for matrix, (*_, where) in zip(mended[0], listed, strict=True)], [mended[1]]
    return [checked_pose(matrix, where) for matrix, (*_, where) in zip(raw, listed, strict=True)], []


def _camera_remarks(listed: Sequence[Listed], sizes: Sequence[tuple[int, int]]) -> list[str]:
    """What to say of intrinsics that are not read as instant-ngp and nerfstudio write them."""
    others = swapped = centred = 0
    for (shared, entry, _), size in zip(listed, sizes, strict=True):
        both = {**shared, **{key: value for key, value in entry.items() if value is not None}}
        width, height = both.get("w") or size[0], both.get("h") or size[1]
        centred += both.get("cx") == 0 and both.get("cy") == 0
        if both.get("fl_x") is not None or both.get("fl_y") is not None:
            continue
        angles = both.get("camera_angle_x"), both.get("camera_angle_y")
        if _other_keys(both.get, width, height) is not None:
            others += 1
        elif _turned_back(*angles, width, height) != angles:
            swapped += 1
    remarks = []
    if others:
        remarks.append(f"the intrinsics of {counted(others, 'picture')} were read from other keys than 'fl_x', 'fl_y', 'cx', 'cy'")
    if swapped:
        remarks.append(
            f"'camera_angle_x' and 'camera_angle_y' of {counted(swapped, 'picture')} were exchanged: as they stand, pixels would be "
            "far from square"
        )
    if centred:
        remarks.append(f"the principal point of {counted(centred, 'picture')} is given as (0, 0); the middle of the picture is used")
    return remarks


def _other_keys(value: Callable[[str], Any], width: int, height: int) -> tuple[float, float, float | None, float | None] | None:
    """fx, fy, cx, cy under names that other programs use; None where there are none, or they are no camera of such an image."""
    for focal_x, focal_y, centre_x, centre_y in OTHER_KEYS:
        fx, fy, cx, cy = (value(key) for key in (focal_x, focal_y, centre_x, centre_y))
        usable = all(isinstance(number, int | float) and not isinstance(number, bool) for number in (fx, fy))
        if not usable or not all(FOCALS[0] * max(width, height) < focal < FOCALS[1] * max(width, height) for focal in (fx, fy)):
            continue
        if cx is None or cy is None:
            return fx, fy, None, None
        if 0 < cx < width and 0 < cy < height:
            return fx, fy, cx, cy
    return None


def _turned_back(across: Any, down: Any, width: int, height: int) -> tuple[Any, Any]:
    """Full angles (radians) of an image's width and height: exchanged where only so its pixels are nearly square."""
    try:
        ratio, exchanged = (
            (width * math.tan(0.5 * two)) / (height * math.tan(0.5 * one)) for one, two in ((across, down), (down, across))
        )
        square, apart = math.log(SQUARE), math.log(ratio)
        if abs(math.log(exchanged)) < square and abs(apart) > 3 * square:
            return down, across
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        pass  # absent, or refused where they are read
    return across, down


def _focal(focal: float | None, angle: float | None, length: int, where: str) -> float | None:
    if focal is not None:
        return focal
    if angle is None:
        return None
    if not 0 < angle < math.pi:
        raise InputError(f"{where}: the camera angle is {angle:g}, it must lie between 0 and π; correct it")
    return 0.5 * length / math.tan(0.5 * angle)


def _lens(shared: Mapping[str, Any], entry: Mapping[str, Any], value: Any, where: str) -> tuple[str, tuple[float, ...]]:
    name = entry.get("camera_model", shared.get("camera_model"))
    fisheye = bool(entry.get("is_fisheye", shared.get("is_fisheye", False)))
    if name is None:
        name = "OPENCV_FISHEYE" if fisheye else "OPENCV"
    if not isinstance(name, str) or name.upper() not in MODELS:
        if isinstance(name, str) and name.upper() in PANORAMAS:
            raise InputError(f"{where}: {PANORAMA}")
        raise InputError(f"{where}: the camera model {str(name)[:40]!r} is not known; undistort the pictures to PINHOLE or OPENCV first")
    k1, k2, k3, k4, k5, k6, p1, p2 = (value(key) or 0.0 for key in ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2"))
    if MODELS[name.upper()] == FISHEYE:
        return FISHEYE, (k1, k2, k3, k4)
    if name.upper() == "FULL_OPENCV":
        return OPENCV, (k1, k2, p1, p2, k3, k4, k5, k6)
    if k4:  # here an r⁸ term; OpenCV's fourth radial coefficient is another thing
        raise InputError(f"{where}: the lens coefficient k4 of an {name} camera cannot be modelled; undistort the pictures first")
    distortion = (k1, k2, p1, p2, k3) if k3 else (k1, k2, p1, p2)
    return (OPENCV, distortion) if any(distortion) else (PINHOLE, ())
