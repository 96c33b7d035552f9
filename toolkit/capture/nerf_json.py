"""The pieces of instant-ngp's, nerfstudio's and Blender's JSON: cameras, poses and listed files, all checked."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from fieldfuse.camera import FISHEYE, OPENCV, PINHOLE, Array, Intrinsics, unproject, world_from_opengl
from fieldfuse.capture.calibration import fitted, panorama, usable_size
from fieldfuse.capture.headers import UNREADABLE, image_header
from fieldfuse.capture.images import read_image, spread
from fieldfuse.capture.listing import counted, number
from fieldfuse.capture.poses import checked_pose
from fieldfuse.capture.resolve import CaptureFiles
from fieldfuse.capture.types import Frame
from fieldfuse.errors import InputError

PANORAMAS = ("EQUIRECTANGULAR", "SPHERICAL")
STEREO = ("VR180_L", "VR180_R", "OMNIDIRECTIONALSTEREO_L", "OMNIDIRECTIONALSTEREO_R")
# nerfstudio and instant-ngp apply coefficients of pinhole cameras too, so a file that has some was made for that.
FISHEYES = ("OPENCV_FISHEYE", "FISHEYE")
MODELS = ("OPENCV", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV", "PERSPECTIVE", "PINHOLE", "SIMPLE_PINHOLE", *FISHEYES)
SAME_FACTOR = 0.1  # how far a principal point may lie from a larger image's centre to be taken for it
SQUARE = 1.15  # ratio of the focal lengths up to which pixels are nearly square
FOCALS = (0.1, 50.0)  # of an image's longer side: focal lengths that cameras have
OTHER_KEYS = (("f1_x", "f1_y", "c1_x", "c1_y"), ("fx", "fy", "cx", "cy"), ("f_x", "f_y", "c_x", "c_y"), ("focal_x", "focal_y", "cx", "cy"))
LOOKED_AT, SIDE, FEATURES = 10, 640, 3000
NEAR = 0.005  # of the focal length, from the epipolar line: about three pixels
RATIO = 0.8  # of the distances of the nearest and the second descriptor
MIN_MATCHES, CLEAR = 40, 2.5  # matches on their lines, and how many times as many as for any other axes
AXES = {
    "all camera axes": np.diag([-1.0, -1.0, -1.0, 1.0]),
    "the cameras' x axis": np.diag([-1.0, 1.0, 1.0, 1.0]),
    "the cameras' y axis": np.diag([1.0, -1.0, 1.0, 1.0]),
    "the cameras' z axis": np.diag([1.0, 1.0, -1.0, 1.0]),
}
WORLD, OPPOSITE = np.diag([1.0, 1.0, -1.0, 1.0]), np.diag([-1.0, -1.0, -1.0, 1.0])
Listed = tuple[Mapping[str, Any], Mapping[str, Any], str]  # what all frames share, an entry, and where it stands (for messages)
REMARKS = {
    "scaled": "{} of another size than in the json; intrinsics were scaled to fit",
    "bent": "{} with a PINHOLE camera and lens coefficients (k1, …), which are applied as in nerfstudio; "
    "remove them from the json if the images are undistorted already",
    "others": "the intrinsics of {} were read from other keys than 'fl_x', 'fl_y', 'cx', 'cy'",
    "swapped": "'camera_angle_x' and 'camera_angle_y' of {} were exchanged: as they stand, pixels would be far from square",
    "centred": "the principal point of {} is given as (0, 0); the middle of the image is used",
}


def matrix(value: Any, where: str) -> Array:
    """A (4, 4) float64 matrix from nested lists of 3×4 or 4×4 numbers. Its values are not judged."""
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
    """The entries of `frames`, each with a `file_path`."""
    frames = data.get("frames")
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{path} lists no frames; a list named 'frames' is expected")
    for index, entry in enumerate(frames):
        if not isinstance(entry, dict) or not isinstance(entry.get("file_path"), str) or not entry["file_path"].strip():
            raise InputError(f"{path}: frame {index} has no 'file_path'; correct it")
    return frames


def listed_names(entries: Sequence[Mapping[str, Any]], keys: Sequence[str], path: Path) -> list[str | None]:
    """What each entry lists under the first of `keys` that it has; None where it has none of them."""
    out: list[str | None] = []
    for index, entry in enumerate(entries):
        listed = next((entry[key] for key in keys if entry.get(key) is not None), None)
        if listed is not None and not isinstance(listed, str):
            raise InputError(f"{path}, frame {index}: a file's name is expected, not {str(listed)[:40]!r}; correct it")
        out.append(listed)
    return out


def read_listed(folder: CaptureFiles, listed: Sequence[Listed], source: str, base: str = "") -> tuple[list[int], list[Frame], list[str]]:
    """Of the entries whose images are there: their places in `listed`, their frames (without names), and remarks."""
    found = folder.find([entry["file_path"] for _, entry, _ in listed], source=source, base=base)
    if not found.count:
        raise folder.none_exists(source, len(listed), found)
    there = [index for index, path in enumerate(found.files) if path is not None]
    entries, images = [listed[index] for index in there], [path for path in found.files if path is not None]
    sizes = [image_header(image).size for image in images]
    usual = next((size for size in sizes if size != UNREADABLE.size), UNREADABLE.size)
    cameras, seen = [], Counter[str]()
    for (shared, entry, where), size, image in zip(entries, sizes, images, strict=True):
        described, flags = _image_camera(shared, entry, usual if size == UNREADABLE.size else size, where)
        cameras.append(fitted(described, usual if size == UNREADABLE.size else size, where, image))
        seen.update({*flags, *(["scaled"] if cameras[-1] is not described else [])})
    poses = [_pose_matrix(entry, where) for _, entry, where in entries]
    remarks = [text.format(counted(seen[flag], "image")) for flag, text in REMARKS.items() if seen[flag]]
    if len(poses) > 2 and all(map(mirrors, poses)) and (mended := unmirrored(poses, images, cameras)) is not None:
        poses = mended[0]
        remarks.append(mended[1])
    missing = len(listed) - len(images)
    if missing:
        where = " (of some the paths lead outside the capture folder, where nothing is read)" if found.outside else ""
        remarks.insert(0, f"{missing} of the {len(listed)} listed images do not exist{where}; the other {len(images)} are used")
    frames = [
        Frame(name="", image=image, intrinsics=intrinsics, world_from_camera=checked_pose(pose, where))
        for image, intrinsics, pose, (*_, where) in zip(images, cameras, poses, entries, strict=True)
    ]
    return there, frames, [*found.remarks, *remarks]


def once_each(frames: Sequence[Frame]) -> tuple[list[Frame], list[str]]:
    """Frames without those that list an image once more with the same pose and camera."""
    first: dict[Path, Frame] = {}
    for frame in frames:
        other = first.setdefault(frame.image, frame)
        one, two = other.world_from_camera, frame.world_from_camera
        same = one is not None and two is not None and np.allclose(one, two, atol=1e-9)
        if other is not frame and (other.intrinsics != frame.intrinsics or not same):
            raise InputError(f"{frame.image} is listed twice, with different poses or cameras; keep the entry that is right")
    copies = len(frames) - len(first)
    return list(first.values()), [f"{counted(copies, 'image')} listed once more with the same pose, used once"] if copies else []


def pose(entry: Mapping[str, Any], where: str) -> Array:
    """world_from_camera (4, 4) in OpenCV axes from an entry's OpenGL `transform_matrix`.

    Raises:
        InputError: absent, not finite, singular or not rigid.
    """
    return checked_pose(_pose_matrix(entry, where), where)


def _pose_matrix(entry: Mapping[str, Any], where: str) -> Array:
    if entry.get("transform_matrix") is None:
        raise InputError(f"{where} has no 'transform_matrix'; remove this frame or add its pose")
    return world_from_opengl(matrix(entry["transform_matrix"], f"{where}: 'transform_matrix'"))


def camera(shared: Mapping[str, Any], entry: Mapping[str, Any], size: tuple[int, int], where: str) -> Intrinsics:
    """The camera that the JSON describes, for the image size that it has (or `size` when it has none).

    What stands in the frame's entry goes before what all frames share. Focal lengths `fl_x`, `fl_y` go before
    `camera_angle_x`, `camera_angle_y` (full angles, radians): f = (w / 2) / tan(angle / 2).

    Raises:
        InputError: no focal length, a value that is not usable, or a lens that cannot be modelled.
    """
    return _camera(shared, entry, size, where)[0]


def _camera(shared: Mapping[str, Any], entry: Mapping[str, Any], size: tuple[int, int], where: str) -> tuple[Intrinsics, list[str]]:
    """The same, and the `REMARKS` that hold of it."""

    def value(key: str) -> float | None:
        own = number(entry, key, where)
        return number(shared, key, where) if own is None else own

    def focal(given: float | None, angle: float | None, length: int) -> float | None:
        if given is not None or angle is None:
            return given
        if not 0 < angle < math.pi:
            raise InputError(f"{where}: the camera angle is {angle:g}, it must lie between 0 and π; correct it")
        return 0.5 * length / math.tan(0.5 * angle)

    flags = list[str]()
    width, height = usable_size(value("w") or size[0], value("h") or size[1], where)
    name = entry.get("camera_model", shared.get("camera_model"))
    if str(name).upper() in PANORAMAS:  # as in nerfstudio: the middle looks along the camera's axis; focal lengths mean nothing
        return panorama(width, height, where), flags
    fx, fy, cx, cy = value("fl_x"), value("fl_y"), value("cx"), value("cy")
    if fx is None and fy is None and (other := _other_keys(value, width, height)) is not None:
        fx, fy, cx, cy = other
        flags.append("others")
    else:
        angles = value("camera_angle_x"), value("camera_angle_y")
        across, down = _unswapped(*angles, width, height)
        flags += ["swapped"] if fx is None and fy is None and (across, down) != angles else []
        fx, fy = focal(fx, across, width), focal(fy, None if fx else down, height)
    fx, fy = (fy if fx is None else fx), (fx if fy is None else fy)
    if fx is None or fy is None:
        raise InputError(f"{where}: there is no focal length ('fl_x' or 'camera_angle_x'); add it, or use the images alone as photos")
    if cx == 0 and cy == 0:  # not filled in: no camera has its principal point in the very corner
        cx = cy = None
        flags.append("centred")
    cx, cy = (width / 2 if cx is None else cx), (height / 2 if cy is None else cy)
    if name is None:
        name = "OPENCV_FISHEYE" if entry.get("is_fisheye", shared.get("is_fisheye", False)) else "OPENCV"
    lens, distortion = _lens(str(name), value, where)
    flags += ["bent"] if lens != PINHOLE and str(name).upper() in ("PINHOLE", "SIMPLE_PINHOLE") else []
    return Intrinsics(width, height, fx, fy, cx, cy, lens, distortion).checked(where), flags


def _image_camera(
    shared: Mapping[str, Any], entry: Mapping[str, Any], size: tuple[int, int], where: str
) -> tuple[Intrinsics, list[str]]:
    """The same of an image that is there, `size` (width, height) large: its principal point has to lie in it."""
    described, flags = _camera(shared, entry, size, where)
    if all(data.get(key) is None for data in (shared, entry) for key in ("w", "h")):
        # Without 'w' and 'h' nothing else shows that the images were made smaller since.
        factor = round(2 * described.cx / described.width)
        offs = [2 * at / length - factor for at, length in ((described.cx, described.width), (described.cy, described.height))]
        if factor >= 2 and all(abs(off) < SAME_FACTOR * factor for off in offs):
            raise InputError(
                f"{where}: the principal point ({described.cx:g}, {described.cy:g}) is the centre of an image {factor} times as large as "
                f"the {described.width}×{described.height} one at hand; add 'w' and 'h', the size that the intrinsics are for"
            )
    return described.centred(where), flags


def _other_keys(value: Callable[[str], Any], width: int, height: int) -> tuple[float, float, float | None, float | None] | None:
    """fx, fy, cx, cy under names that other programs use; None where there are none, or they are no camera of such an image."""
    side = max(width, height)
    for keys in OTHER_KEYS:
        fx, fy, cx, cy = (value(key) for key in keys)
        if fx is None or fy is None or not all(FOCALS[0] * side < focal < FOCALS[1] * side for focal in (fx, fy)):
            continue
        if cx is None or cy is None:
            return fx, fy, None, None
        if 0 < cx < width and 0 < cy < height:
            return fx, fy, cx, cy
    return None


def _unswapped(across: float | None, down: float | None, width: int, height: int) -> tuple[float | None, float | None]:
    """Full angles (radians) of an image's width and height: exchanged where only so its pixels are nearly square."""
    if across is None or down is None or not all(0 < angle < math.pi for angle in (across, down)):
        return across, down  # refused where they are used
    ratio, exchanged = (
        (width * math.tan(0.5 * two)) / (height * math.tan(0.5 * one)) for one, two in ((across, down), (down, across))
    )
    square = math.log(SQUARE)
    return (down, across) if abs(math.log(exchanged)) < square and abs(math.log(ratio)) > 3 * square else (across, down)


def _lens(name: str, value: Callable[[str], float | None], where: str) -> tuple[str, tuple[float, ...]]:
    if name.upper() in STEREO:
        raise InputError(f"{where}: the camera model {name[:40]!r} is half of a stereo pair, which is not read; give plain panoramas")
    if name.upper() not in MODELS:
        raise InputError(f"{where}: the camera model {name[:40]!r} is not supported; undistort the images to PINHOLE or OPENCV first")
    k1, k2, k3, k4, k5, k6, p1, p2 = (value(key) or 0.0 for key in ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2"))
    if name.upper() in FISHEYES:
        return FISHEYE, (k1, k2, k3, k4)
    if name.upper() == "FULL_OPENCV":
        return OPENCV, (k1, k2, p1, p2, k3, k4, k5, k6)
    if k4:  # here an r⁸ term; OpenCV's fourth radial coefficient is another thing
        raise InputError(f"{where}: the lens coefficient k4 of an {name} camera cannot be modelled; undistort the images first")
    distortion = (k1, k2, p1, p2, k3) if k3 else (k1, k2, p1, p2)
    return (OPENCV, distortion) if any(distortion) else (PINHOLE, ())


# ------------------------------------------------------------------------------------------------ poses that mirror space
#
# One camera axis, all of them, or one of the world's points the wrong way. The matrices do not show which. Matches between images do: only
# for the right axes they lie on their epipolar lines.


def mirrors(pose: Array) -> bool:
    """Whether a (4, 4) matrix of finite numbers turns right-handed axes into left-handed ones."""
    return bool(np.isfinite(pose).all()) and np.abs(pose).max() < 1e12 and bool(np.linalg.det(pose[:3, :3]) < 0)


def unmirrored(poses: Sequence[Array], images: Sequence[Path], cameras: Sequence[Intrinsics]) -> tuple[list[Array], str] | None:
    """world_from_camera (4, 4) each, without the mirror, and a remark on what was turned; None where the images do not decide it.

    Args:
        poses: world_from_camera in OpenCV axes, all of them mirrored.
    """
    seen = [(poses[index], *_features(images[index], cameras[index])) for index in spread(range(len(poses)), LOOKED_AT)]
    votes, in_front = Counter(dict.fromkeys(AXES, 0)), Counter[str]()
    for (one, rays, some), (two, other_rays, others) in itertools.combinations(seen, 2):
        matches = [] if min(len(some), len(others)) < 2 else cv2.BFMatcher().knnMatch(some, others, k=2)
        pairs = [near for near, second in matches if near.distance < RATIO * second.distance]
        matched = rays[[pair.queryIdx for pair in pairs]], other_rays[[pair.trainIdx for pair in pairs]]
        for name, turn in AXES.items():
            on_line, before = _agreement(one @ turn, two @ turn, *matched)
            votes[name] += int(on_line.sum())
            in_front[name] += int((on_line & before).sum())
    (best, most), (_, second) = votes.most_common(2)
    if most < MIN_MATCHES or most < CLEAR * second:
        return None
    if 2 * in_front[best] >= most:
        remark = f"all poses mirror space; {best} were turned round, as matches between the images show"
        return [pose @ AXES[best] for pose in poses], remark
    remark = "all poses mirror space; the world's z axis was turned round, as matches between the images show: results are in that frame"
    return [WORLD @ pose @ AXES[best] @ OPPOSITE for pose in poses], remark


def _features(path: Path, camera: Intrinsics) -> tuple[Array, Array]:
    """Rays (N, 3) in camera axes with z = 1, and descriptors (N, 128); none of an image that cannot be read."""
    try:
        grey = cv2.cvtColor(np.ascontiguousarray(read_image(Frame("", path))[0][..., :3]), cv2.COLOR_RGB2GRAY)
    except InputError:
        return np.zeros((0, 3)), np.zeros((0, 128), np.float32)
    factor = min(1.0, SIDE / max(grey.shape))
    small = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    points, descriptors = cv2.SIFT.create(FEATURES).detectAndCompute(small, None)
    if descriptors is None:
        return np.zeros((0, 3)), np.zeros((0, 128), np.float32)
    pixels = np.array([point.pt for point in points]) + 0.5
    return unproject(camera.scaled(small.shape[1], small.shape[0]), np.eye(4), pixels, np.ones(len(pixels))), np.asarray(descriptors)


def _agreement(one: Array, two: Array, rays: Array, others: Array) -> tuple[Array, Array]:
    """(N,) bool whether rays (N, 3) of two cameras (4, 4) meet within NEAR, and whether they do so in front of both."""
    first, second = rays @ one[:3, :3].T, others @ two[:3, :3].T
    between = two[:3, 3] - one[:3, 3]
    length = float(np.linalg.norm(between))
    if not len(rays) or length == 0:
        return np.zeros(len(rays), bool), np.zeros(len(rays), bool)
    line = np.cross(first, between / length) @ two[:3, :3]  # of the plane through both cameras and the first ray, in the second image
    off = np.abs((line * others).sum(axis=1)) / np.maximum(np.linalg.norm(line[:, :2], axis=1), 1e-12)
    # The nearest points of the rays: depth along either.
    a, b, c = (first * first).sum(1), (first * second).sum(1), (second * second).sum(1)
    d, e = first @ between, second @ between
    apart = np.maximum(a * c - b * b, 1e-12)
    return off < NEAR, ((c * d - b * e) / apart > 0) & ((b * d - a * e) / apart > 0)
