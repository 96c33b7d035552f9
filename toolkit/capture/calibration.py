"""Cameras of captures: intrinsics in small files of their own, scaled to the images' sizes, and frames with camera and pose.

Sensors are calibrated with OpenCV or Open3D, whose pixel centres are whole numbers: half a pixel is added here.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.capture.headers import LYING, UNREADABLE, image_header, orientation_of
from fieldfuse.capture.listing import is_file, number, read_matrix, read_object
from fieldfuse.capture.poses import checked_pose
from fieldfuse.capture.types import Frame
from fieldfuse.errors import InputError

JSON_NAMES = (
    "camera_intrinsics.json",
    "camera_intrinsic.json",
    "camera.json",
    "intrinsics.json",
    "intrinsic.json",
    "camera_primesense.json",  # of Open3D's samples
)
MAX_SIDE = 1_000_000  # pixels
PANORAMA_SHAPE = 0.01  # by which a panorama's width may differ from twice its height
CENTRAL = 0.25  # how far twice the principal point of a sensor may lie from its image's size, as a share of that


def sensor(width: int, height: int, fx: float, fy: float, cx: float, cy: float) -> Intrinsics:
    """A pinhole camera from values with whole-number pixel centres."""
    return Intrinsics(width, height, fx, fy, cx + 0.5, cy + 0.5)


PRIMESENSE = sensor(640, 480, 525.0, 525.0, 319.5, 239.5)  # default of Open3D and of ROS


def usable_size(width: float, height: float, where: str) -> tuple[int, int]:
    """An image size as a file has it, in whole pixels."""
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
        raise InputError(f"{where}: the image size {width:g}×{height:g} is not usable; correct it")
    return round(width), round(height)


def panorama(width: int, height: int, where: str) -> Intrinsics:
    """The camera of a 360° panorama, whose middle looks along its axis.

    Raises:
        InputError: it is not twice as wide as high.
    """
    if abs(width / (2 * height) - 1) > PANORAMA_SHAPE:
        raise InputError(f"{where}: a 360° panorama is twice as wide as high, this one is {width}×{height}; correct its camera model")
    return Intrinsics.equirectangular(width, height)


def fits_shape(intrinsics: Intrinsics, size: tuple[int, int]) -> bool:
    """Whether an image of `size` (width, height) may be the camera's, made smaller or larger."""
    width, height = size
    return abs(intrinsics.height * width / intrinsics.width - height) <= max(2.0, 0.005 * height)


def fitted(intrinsics: Intrinsics, size: tuple[int, int], where: str, image: Path | None = None) -> Intrinsics:
    """The camera for an image of `size` (width, height): itself, or scaled when the aspect ratio agrees.

    Args:
        image: a file whose EXIF orientation may turn it by 90° into the camera's shape; then the camera is that of the upright image.

    Raises:
        InputError: the image has another shape (cropped, or turned).
    """
    width, height = size
    if size in ((intrinsics.width, intrinsics.height), UNREADABLE.size):
        return intrinsics
    if not fits_shape(intrinsics, size):
        if image is not None and fits_shape(intrinsics, (height, width)) and orientation_of(image) >= LYING:
            return fitted(intrinsics, (height, width), where)
        raise InputError(
            f"{where}: the image is {width}×{height} but its intrinsics are for {intrinsics.width}×{intrinsics.height}, which is another "
            "shape; give images that are neither cropped nor turned, or correct the intrinsics"
        )
    return intrinsics.scaled(width, height)


def posed_frame(
    name: str, image: Path, camera: Intrinsics, pose: Array, where: str, depth: Path | None = None, **more: Any
) -> Frame:
    """A frame with its pose (4, 4), its camera scaled to the image's size, and with depth by the same camera, whatever the sizes.

    Args:
        where: what errors call the pose.
        more: other fields of the frame; `depth_intrinsics` where depth has a camera of its own, `confidence` if that file exists.
    """
    size = image_header(image).size
    intrinsics = fitted(camera, size, str(image))
    by_header = depth is not None and depth.suffix.lower() != ".pfm"
    depth_size = image_header(depth).size if depth is not None and by_header else size
    own = more.pop("depth_intrinsics", None if depth_size == size else intrinsics)
    confidence = more.pop("confidence", None)
    return Frame(
        name=name,
        image=image,
        intrinsics=intrinsics,
        world_from_camera=checked_pose(pose, where),
        depth=depth,
        depth_intrinsics=None if depth is None or own is None else fitted(own, depth_size, str(depth)),
        confidence=confidence if depth is not None and confidence is not None and is_file(confidence) else None,
        **more,
    )


def from_matrix(matrix: Array, width: int, height: int, where: str, shift: float = 0.5) -> Intrinsics:
    """The camera of a 3×3 or 4×4 K whose pixel centres are at whole numbers (`shift` 0.5) or at +0.5 (`shift` 0).

    Raises:
        InputError: K is not the matrix of a camera.
    """
    fx, fy, cx, cy = (float(matrix[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    intrinsics = Intrinsics(width, height, fx, fy, cx + shift, cy + shift).checked(where)
    if not abs(matrix[0, 1]) <= 0.05 * intrinsics.fx:
        raise InputError(f"{where}: the camera matrix is skewed, which is not supported; undistort the images first")
    return intrinsics


def off_centre(camera: Intrinsics) -> float:
    """How far twice the principal point lies from the image's size, as a share of it."""
    return max(abs(2 * camera.cx / camera.width - 1), abs(2 * camera.cy / camera.height - 1))


def read_matrix_for(path: Path, size: tuple[int, int], usual: tuple[int, int], shift: float = 0.5) -> tuple[Intrinsics, bool]:
    """The camera in a text file with a 3×3, 4×4 or 3×4 matrix, for images of `size` (width, height), and whether it had to be scaled from
    the sensor's `usual` size: the file is for the one of the two whose centre is nearer to the principal point.
    """
    where = str(path)
    camera = from_matrix(read_matrix(path, (3, 3), (4, 4), (3, 4)), *size, where, shift)
    whole = replace(camera, width=usual[0], height=usual[1])
    scaled = size != usual and off_centre(whole) < min(off_centre(camera), CENTRAL)
    return (fitted(whole, size, where) if scaled else camera).centred(where), scaled


def find_json(root: Path) -> tuple[Intrinsics, dict[str, Any]] | None:
    """The camera in one of `JSON_NAMES` and the whole object, or None when there is no such file.

    Either Open3D's form (`width`, `height`, `intrinsic_matrix` of nine numbers, column by column) or `fx`, `fy`, `cx`, `cy`.
    """
    path = next((root / name for name in JSON_NAMES if (root / name).is_file()), None)
    if path is None:
        return None
    data, where = read_object(path), str(path)
    size = usable_size(number(data, "width", where) or 0, number(data, "height", where) or 0, where)
    nine, keys = data.get("intrinsic_matrix"), ("fx", "fy", "cx", "cy")
    entries = data
    if nine is not None:
        if not isinstance(nine, list) or len(nine) != 9:
            raise InputError(f"{where}: 'intrinsic_matrix' must be a list of nine numbers, column by column; correct it")
        entries = {key: nine[at] for key, at in zip(keys, (0, 4, 6, 7), strict=True)}
    values = [value for key in keys if (value := number(entries, key, where)) is not None]
    if len(values) < len(keys):
        raise InputError(f"{where} must hold 'fx', 'fy', 'cx', 'cy' or an 'intrinsic_matrix'; correct it")
    return sensor(*size, *values).checked(where).centred(where), data
