"""OpenSfM's and OpenDroneMap's `reconstruction.json`, alone or in a project's `opensfm/`, with the photos in `images/`.

The file is a list of reconstructions that were not joined; the one with most images is used. A shot's `rotation` (axis times angle) and
`translation` are camera_from_world in OpenCV axes. Focal lengths and principal points are shares of the image's longer side, the latter
from the image's middle. The world has z up; with GPS its units are metres, x east and y north of `reference_lla`.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from fieldfuse.camera import FISHEYE, Array, Intrinsics, invert
from fieldfuse.capture.calibration import panorama, usable_size
from fieldfuse.capture.lenses import with_brown_lens
from fieldfuse.capture.listing import is_file, number, numbers, read_object, require_folder
from fieldfuse.capture.posed_list import Listed, listed_capture
from fieldfuse.capture.types import Capture
from fieldfuse.errors import InputError
from fieldfuse.files import read_json

NAME = "reconstruction.json"
PLACES = (f"opensfm/{NAME}", NAME, f"opensfm/undistorted/{NAME}")
MAX_BYTES = 2**28  # it holds the points, too
SPHERES = ("spherical", "equirectangular")
SAME_PLACE = 1e-9  # degrees


def opensfm_file(folder: Path) -> Path | None:
    return next((folder / place for place in PLACES if is_file(folder / place)), None)


def looks_like_opensfm(path: Path) -> bool:
    return opensfm_file(path) is not None


def read_opensfm(path: Path | str) -> Capture:
    """The shots of the largest reconstruction with an image, and its points; `path` is the project, its `opensfm/`, or the file.

    Raises:
        InputError: no reconstruction, a camera that cannot be modelled, or no image exists.
    """
    source = Path(path).absolute()
    file = source if source.is_file() else opensfm_file(require_folder(source))
    if file is None:
        raise InputError(f"{source} holds no {NAME}; reconstruct the photos with OpenSfM or OpenDroneMap first")
    data = read_json(file, MAX_BYTES)
    parts = [part for part in data if isinstance(part, dict) and isinstance(part.get("shots"), dict)] if isinstance(data, list) else []
    if not any(part["shots"] for part in parts):
        raise InputError(f"{file} holds no reconstruction with shots; reconstruct the photos again")
    part = max(parts, key=lambda one: len(one["shots"]))
    remarks = []
    if len(parts) > 1:
        used, all_of_them = len(part["shots"]), sum(len(one["shots"]) for one in parts)
        remarks.append(f"of {len(parts)} reconstructions the largest is used, with {used} of {all_of_them} images")
    root = next((above for above in (file.parent, *file.parents[1:3]) if above.name not in ("opensfm", "undistorted")), file.parent)
    cameras = {**_shared_cameras(root), **(part["cameras"] if isinstance(part.get("cameras"), dict) else {})}
    lenses: dict[str, Intrinsics] = {}
    entries = []
    for name, shot in part["shots"].items():
        where = f"{file.name}, shot {name[:80]!r}"
        if not isinstance(shot, dict):
            raise InputError(f"{where} is no shot; check how the file was written")
        key = str(shot.get("camera"))
        if key not in lenses:
            if not isinstance(cameras.get(key), dict):
                raise InputError(f"{where} uses the camera {key[:80]!r}, which {file.name} does not hold; reconstruct again")
            lenses[key] = _lens(cameras[key], f"{file.name}, camera {key[:80]!r}")
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_rotvec(numbers(shot.get("rotation"), f"{where}: 'rotation'", 3).reshape(3)).as_matrix()
        pose[:3, 3] = numbers(shot.get("translation", [0.0, 0.0, 0.0]), f"{where}: 'translation'", 3).reshape(3)
        entries.append(Listed(name, invert(pose), lenses[key], where))
    place = _reference(part, file)
    facts: dict[str, Any] = {"extra": {"reference_lla": place}, "metric": True} if place else {}
    return listed_capture("opensfm", file, entries, root, up=(0.0, 0.0, 1.0), points=_points(part, file), warnings=remarks, **facts)


def _shared_cameras(root: Path) -> dict[str, Any]:
    """OpenDroneMap's `cameras.json`, which has the calibrated cameras of a project."""
    with suppress(InputError):
        return read_object(root / "cameras.json")
    return {}


def _reference(part: Mapping[str, Any], file: Path) -> dict[str, float] | None:
    """Latitude, longitude (degrees) and altitude (metres) of the world's origin, if the photos had GPS."""
    place = part.get("reference_lla")
    if place is None and is_file(file.parent / "reference_lla.json"):
        place = read_object(file.parent / "reference_lla.json")
    if not isinstance(place, dict):
        return None
    out = {key: number(place, key, f"{file.name}: 'reference_lla'") for key in ("latitude", "longitude", "altitude")}
    given = {key: value for key, value in out.items() if value is not None}
    return given if len(given) == 3 and max(abs(given["latitude"]), abs(given["longitude"])) > SAME_PLACE else None


def _points(part: Mapping[str, Any], file: Path) -> Array | None:
    listed = part.get("points")
    if not isinstance(listed, dict) or not listed:
        return None
    places = [point.get("coordinates") if isinstance(point, dict) else None for point in listed.values()]
    return numbers(places, f"{file.name}: 'points'", 3 * len(places)).reshape(-1, 3)


def _lens(data: Mapping[str, Any], where: str) -> Intrinsics:
    """https://opensfm.org/docs/geometry.html, "Camera Models"."""

    def value(key: str, default: float = 0.0) -> float:
        found = number(data, key, where)
        return default if found is None else found

    kind = str(data.get("projection_type", "perspective"))
    width, height = usable_size(value("width"), value("height"), where)
    if kind in SPHERES:
        return panorama(width, height, where)
    side = max(width, height)
    fx, fy = (value(key, value("focal")) * side for key in ("focal_x", "focal_y"))
    camera = Intrinsics(width, height, fx, fy, width / 2 + value("c_x") * side, height / 2 + value("c_y") * side).checked(where)
    if kind in ("perspective", "simple_radial", "radial", "brown"):
        return with_brown_lens(camera, [value(key) for key in ("k1", "k2", "k3")], (value("p1"), value("p2")), where)
    if kind in ("fisheye", "fisheye_opencv"):
        return replace(camera, lens=FISHEYE, distortion=tuple(value(key) for key in ("k1", "k2", "k3", "k4"))).checked(where)
    raise InputError(f"{where}: the camera model {kind[:40]!r} is not supported; reconstruct with brown or fisheye_opencv")
