"""Meshroom's (AliceVision's) scenes as JSON: `cameras.sfm`, `sfm.sfm`, … beside the photos, or in `MeshroomCache/StructureFromMotion/`.

A view names an image, an intrinsic and a pose. A pose's `rotation` is camera_from_world column by column, in OpenCV axes, `center` the
camera's place. Numbers stand in quotes. The focal length is in pixels (`pxFocalLength`) until version 1.2.1 of the format, later in mm
of `sensorWidth`; the principal point is a pixel until 1.2.0, later an offset from the image's middle. Lens and camera are one `type`
until 1.2.7 (`radial3`, `brown`, `fisheye4`), later `type` and `distortionType` (`radialk3`, `brown`, `fisheye`). Format:
aliceVision/sfmDataIO/jsonIO.cpp.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fieldfuse.camera import FISHEYE, Array, Intrinsics
from fieldfuse.capture.calibration import usable_size
from fieldfuse.capture.lenses import with_brown_lens, with_fitted_lens
from fieldfuse.capture.listing import counted, files_in, natural_key, numbers, read_object, require_folder
from fieldfuse.capture.posed_list import Listed, exported, listed_capture
from fieldfuse.capture.types import Capture
from fieldfuse.errors import InputError

PLACES = ("MeshroomCache/StructureFromMotion/*", "MeshroomCache/*SfM*/*", "StructureFromMotion/*")
MOST_FILES = 20
BEST_NAMES = ("cameras.sfm", "sfm.sfm")
ALEMBIC = (
    "is an Alembic file of Meshroom, which cannot be read; write it as JSON with the node ConvertSfMFormat (SfM File Format: sfm, or json) "
    "and put the .sfm file beside the photos"
)
OLD_TYPES = {  # of camera and lens in one, and the lens
    "pinhole": "none",
    "radial1": "radialk1",
    "radial3": "radialk3",
    "brown": "brown",
    "fisheye4": "fisheye",
    "fisheye1": "fisheye1",
}


def scenes_of(folder: Path, suffix: str = ".sfm") -> list[Path]:
    """Files that may hold a scene, the likeliest first."""
    folders = [folder, *(below for place in PLACES for below in sorted(folder.glob(place)))]
    return [file for below in folders for file in _files(below, suffix)][:MOST_FILES]


def _files(folder: Path, suffix: str) -> list[Path]:
    if not folder.is_dir():
        return []
    return sorted(files_in(folder, f"*{suffix}"), key=lambda file: (file.name not in BEST_NAMES, natural_key(file.name)))


def looks_like_meshroom(path: Path) -> bool:
    return bool(exported(path, scenes_of))


def read_meshroom(path: Path | str) -> Capture:
    """The views that have a pose and an image, and the points if the file has them; of several files the one with most poses.

    Raises:
        InputError: no poses, a lens that cannot be modelled, or no image exists.
    """
    source = Path(path).absolute()
    files = [source] if source.is_file() else exported(require_folder(source), scenes_of)
    if not files:
        raise InputError(f"{source} holds no .sfm file of Meshroom; write one there with the node ConvertSfMFormat")
    scenes = [(file, read_object(file)) for file in files]
    file, data = max(scenes, key=lambda one: len(_list(one[1], "poses")))
    poses = {str(entry.get("poseId")): entry for entry in _list(data, "poses")}
    if not poses:
        raise InputError(f"{file} holds no poses; compute the node StructureFromMotion, and give its cameras.sfm")
    version = _version(data, file)
    lenses: dict[str, Intrinsics] = {}
    intrinsics = {str(entry.get("intrinsicId")): entry for entry in _list(data, "intrinsics")}
    views = [view for view in _list(data, "views") if str(view.get("poseId")) in poses]
    entries = []
    for view in views:
        name = str(view.get("path") or "")
        where = f"{file.name}, view {name[-80:]!r}"
        key = str(view.get("intrinsicId"))
        if key not in lenses:
            if key not in intrinsics:
                raise InputError(f"{where} has the intrinsic {key[:40]!r}, which {file.name} does not hold; write the file again")
            lenses[key] = _lens(intrinsics[key], version, f"{file.name}, intrinsic {key[:40]!r}")
        if view.get("rigId") is None:
            entries.append(Listed(name, _pose(poses[str(view["poseId"])], where), lenses[key], where))
    in_rigs, without = len(views) - len(entries), len(_list(data, "views")) - len(views)
    remarks = [f"{counted(without, 'view')} of {file.name} without a pose {'is' if without == 1 else 'are'} not used"] if without else []
    remarks += [f"{counted(in_rigs, 'view')} of camera rigs {'is' if in_rigs == 1 else 'are'} not used"] if in_rigs else []
    if not entries:
        raise InputError(f"{file} holds no view with a pose of its own; compute the node StructureFromMotion without rigs")
    root = source if source.is_dir() else file.parent
    return listed_capture("meshroom", file, entries, root, points=_points(data, file), warnings=remarks)


def _list(data: Mapping[str, Any], key: str) -> list[dict[str, Any]]:
    found = data.get(key)
    return [entry for entry in found if isinstance(entry, dict)] if isinstance(found, list) else []


def _version(data: Mapping[str, Any], file: Path) -> tuple[int, ...]:
    return tuple(int(value) for value in numbers(data.get("version", [1, 0, 0]), f"{file}: 'version'", 3))


def _pose(entry: Mapping[str, Any], where: str) -> Array:
    """world_from_camera; in files before version 1.0 there is no `transform` around the numbers."""
    pose = entry.get("pose")
    transform = pose.get("transform", pose) if isinstance(pose, dict) else None
    if not isinstance(transform, dict):
        raise InputError(f"{where}: its pose has no 'transform'; write the file again")
    out = np.eye(4)
    out[:3, :3] = numbers(transform.get("rotation"), f"{where}: 'rotation'", 9).reshape(3, 3)  # by column, so that it is the inverse by row
    out[:3, 3] = numbers(transform.get("center"), f"{where}: 'center'", 3)
    return out


def _lens(data: Mapping[str, Any], version: tuple[int, ...], where: str) -> Intrinsics:
    def value(key: str, default: float | None = None) -> float:
        if data.get(key) is None and default is not None:
            return default
        return float(numbers([data.get(key)], f"{where}: {key!r}")[0])

    width, height = usable_size(value("width"), value("height"), where)
    px, py = numbers(data.get("principalPoint"), f"{where}: 'principalPoint'", 2).tolist()
    if version < (1, 2, 1):
        px, py = px - width / 2, py - height / 2
    if version < (1, 2, 0):
        fx = fy = value("pxFocalLength")
    elif version < (1, 2, 2):
        fx, fy = numbers(data.get("pxFocalLength"), f"{where}: 'pxFocalLength'", 2).tolist()
    else:
        sensor = value("sensorWidth", 36.0)
        if not sensor > 0:
            raise InputError(f"{where}: the sensor's width is {sensor:g} mm, it must be positive; correct it")
        side = max(width, height) if version >= (1, 2, 11) else width  # as the program's own writer has it
        fx, ratio = value("focalLength") / sensor * side, value("pixelRatio", 1.0)
        if not ratio > 0:
            raise InputError(f"{where}: the pixels' ratio is {ratio:g}, it must be positive; correct it")
        if version >= (1, 2, 11):
            fx, fy = fx / ratio, fx
        else:
            fy = fx / ratio if version < (1, 2, 5) else fx * ratio
    camera = Intrinsics(width, height, fx, fy, width / 2 + px, height / 2 + py).checked(where)
    kind = str(data.get("type", "pinhole")).lower()
    bent = str(data.get("distortionType", "none")).lower() if version >= (1, 2, 8) else OLD_TYPES.get(kind, kind)
    undistorted = str(data.get("undistortionType", "none")).lower()
    if (version >= (1, 2, 8) and kind != "pinhole") or undistorted != "none":
        bent = kind if kind != "pinhole" else undistorted
    listed = data.get("distortionParams") or []
    factors = numbers(listed, f"{where}: 'distortionParams'").ravel().tolist() if listed else []
    return _bent(camera, bent, factors, where)


def _bent(camera: Intrinsics, kind: str, factors: list[float], where: str) -> Intrinsics:
    if kind == "none" or not any(factors):
        if kind in ("none", "radialk1", "radialk3", "brown"):
            return camera
    elif kind in ("radialk1", "radialk3") and len(factors) <= 3:
        return with_brown_lens(camera, factors, (0.0, 0.0), where)
    elif kind == "brown" and len(factors) == 5:
        return with_brown_lens(camera, factors[:3], (factors[3], factors[4]), where)
    elif kind == "fisheye1" and len(factors) == 1:
        k = factors[0]
        return with_fitted_lens(camera, lambda r: np.asarray(np.arctan(2 * r * np.tan(k / 2)) / k), where)
    if kind == "fisheye" and len(factors) in (0, 4):
        return replace(camera, lens=FISHEYE, distortion=tuple(factors or [0.0] * 4)).checked(where)
    raise InputError(
        f"{where}: the lens {kind[:40]!r} with {counted(len(factors), 'coefficient')} is not supported; "
        "export undistorted images with the node PrepareDenseScene, or choose radial3, brown or fisheye4 in CameraInit"
    )


def _points(data: Mapping[str, Any], file: Path) -> Array | None:
    listed = [entry.get("X") for entry in _list(data, "structure")]
    return numbers(listed, f"{file.name}: 'structure'", 3 * len(listed)).reshape(-1, 3) if listed else None
