"""DTU as MVSNet rectified it for training: `Cameras/train/NNNNNNNN_cam.txt`, `Rectified/scanS_train/rect_VVV_L_r5000.png`, `Depths/…`.

Camera files hold the world-to-camera matrix and K for the picture at a quarter of its 640×512; view numbers count from 1 in picture
names and from 0 in camera and depth names; L is one of seven lights. Depth maps come at 160×128 (MVSNet's archive) or as the
1600×1200 originals, of which the pictures are the halved middle. Lengths are millimetres; a unit of ours is 200 of them.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fieldfuse.camera import Array, Intrinsics, invert
from fieldfuse.capture.calibration import from_matrix
from fieldfuse.capture.headers import image_header
from fieldfuse.capture.listing import assemble, natural_key, read_text, require_folder
from fieldfuse.capture.poses import checked_pose
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.errors import InputError, first_line
from fieldfuse.nerfusion.training.captured import CapturedScene
from fieldfuse.nerfusion.training.datasets.folders import listed

MILLIMETRES = 1 / 200
FULL, CROP = (1600, 1200), (80, 44)  # size of the originals; where the 640×512 picture begins in the halved original
NAME = re.compile(r"rect_([0-9]{3})_([0-9])_r5000$")
LISTS = ("train.txt", "dtu_train_all.txt")


@dataclass(frozen=True)
class DtuScene:
    """One scan under one light."""

    root: Path
    scan: str
    light: int


def dtu_scenes(root: Path | str) -> list[DtuScene]:
    """Every scan and light under `root` (or its `dtu/`, `mvs_training/dtu/`); a list of scans there chooses among them.

    Raises:
        InputError: there is none.
    """
    given = require_folder(root)
    places = (given, given / "dtu", given / "mvs_training" / "dtu")
    place = next((path for path in places if (path / "Rectified").is_dir() and (path / "Cameras").is_dir()), None)
    if place is None:
        raise InputError(f"{given} holds no Rectified/ and Cameras/ folders of DTU; give the folder that holds both, see docs/training.md")
    wanted = listed(place, LISTS)
    found = []
    for folder in sorted((place / "Rectified").iterdir(), key=lambda path: natural_key(path.name)):
        scan = folder.name.removesuffix("_train")
        if folder.is_dir() and (wanted is None or scan in wanted):
            lights = sorted({int(match[2]) for path in folder.glob("rect_*.png") if (match := NAME.match(path.stem))})
            found += [DtuScene(place, scan, light) for light in lights]
    if not found:
        raise InputError(f"{place / 'Rectified'} holds no pictures rect_001_0_r5000.png of a wanted scan; check how it was unpacked")
    return found


def read_camera(path: Path) -> tuple[Array, Array]:
    """MVSNet's camera file → world_from_camera (4, 4) and K (3, 3).

    Raises:
        InputError: not such a file.
    """
    words = read_text(path).split()
    try:
        start, middle = words.index("extrinsic"), words.index("intrinsic")
        world_to_camera = np.array([float(word) for word in words[start + 1 : start + 17]]).reshape(4, 4)
        matrix = np.array([float(word) for word in words[middle + 1 : middle + 10]]).reshape(3, 3)
    except ValueError as error:
        raise InputError(f"{path} is not a camera file of MVSNet ({first_line(error)}); unpack it again") from error
    return invert(checked_pose(world_to_camera, str(path))), matrix


def read_rectified(scene: DtuScene) -> Capture:
    """The pictures of one scan under one light, in millimetres.

    Raises:
        InputError: a camera is missing or not usable.
    """
    folder = next(path for path in _either(scene, "Rectified") if path.is_dir())
    cameras = next(path for path in (scene.root / "Cameras" / "train", scene.root / "Cameras") if path.is_dir())
    frames = []
    for picture in folder.glob("rect_*.png"):
        match = NAME.match(picture.stem)
        if match is None or int(match[2]) != scene.light:
            continue
        view = int(match[1]) - 1
        size = image_header(picture).size
        pose, matrix = read_camera(cameras / f"{view:08d}_cam.txt")
        intrinsics = _camera(matrix, size, f"{cameras / f'{view:08d}_cam.txt'}")
        depth = next((path for base in _either(scene, "Depths") if (path := base / f"depth_map_{view:04d}.pfm").is_file()), None)
        frames.append(
            Frame(
                name=f"{view:04d}",
                image=picture,
                intrinsics=intrinsics,
                world_from_camera=pose,
                depth=depth,
                depth_intrinsics=None if depth is None else _depth_camera(intrinsics, image_header(depth).size, str(depth)),
            )
        )
    return assemble("dtu", folder, frames, depth_scale=1.0)


def dtu_scene(scene: DtuScene, long_side: int) -> CapturedScene:
    """One scan under one light, in units of 200 mm.

    Raises:
        InputError: it cannot be read.
    """
    return CapturedScene(read_rectified(scene), "object", long_side, scale=MILLIMETRES)


def _either(scene: DtuScene, part: str) -> tuple[Path, Path]:
    return scene.root / part / f"{scene.scan}_train", scene.root / part / scene.scan


def _camera(matrix: Array, size: tuple[int, int], where: str) -> Intrinsics:
    """K of the file is for a quarter of the picture, or for the picture itself; which, its principal point tells.

    The files' K is that of the 1600×1200 originals, whose pixel centres are whole numbers, halved and cropped: half a pixel there
    is a quarter of one here.
    """
    quarter = abs(2 * 4 * matrix[0, 2] / size[0] - 1) < abs(2 * matrix[0, 2] / size[0] - 1)
    scaled = matrix * np.array([[4.0], [4.0], [1.0]]) if quarter else matrix
    return from_matrix(scaled, *size, where, shift=0.25 if quarter else 0.5)


def _depth_camera(picture: Intrinsics, size: tuple[int, int], where: str) -> Intrinsics:
    if size != FULL:
        if size[0] * picture.height != size[1] * picture.width:
            raise InputError(f"{where} is {size[0]}×{size[1]}, neither 1600×1200 nor of the picture's shape; unpack it again")
        return picture.scaled(*size)
    return Intrinsics(*FULL, 2 * picture.fx, 2 * picture.fy, 2 * (picture.cx + CROP[0]), 2 * (picture.cy + CROP[1]))
