"""Scene files: YAML with what is filmed, by which camera, along which path, and through which effects."""

from __future__ import annotations

from dataclasses import dataclass
from dataclasses import field as default
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from fieldfuse import camera as lenses
from fieldfuse.camera import Intrinsics
from fieldfuse.config import checked, one_of, read_yaml
from fieldfuse.errors import InputError
from fieldfuse.simulate.paths import PathSettings
from fieldfuse.simulate.survey import GpsSettings, MarkerSettings

WIDEST_PINHOLE = 140
MAX_BYTES = 2**20
OUTPUTS = ("frames", "photos", "video")
Point = Annotated[list[float], Field(min_length=3, max_length=3)]


PINHOLE, FISHEYE, PANORAMA = "pinhole", "fisheye", "panorama"


@dataclass
class CameraSettings:
    kind: Annotated[str, one_of(PINHOLE, FISHEYE, PANORAMA)] = PINHOLE  # fisheye: equidistant; panorama: 360°, equirectangular
    width: Annotated[int, Field(ge=16, le=4096)] = 640  # pixels
    height: Annotated[int, Field(ge=16, le=4096)] = 480
    fov: Annotated[float, Field(ge=5, le=220)] = 65.0  # degrees across the width, without lens distortion; a pinhole's are 140 at most

    def intrinsics(self) -> Intrinsics:
        """The camera, its principal point in the middle."""
        if self.kind == PANORAMA:
            return Intrinsics.equirectangular(self.width, self.height)
        if self.kind == FISHEYE:
            focal = self.width / float(np.deg2rad(self.fov))
            return Intrinsics(self.width, self.height, focal, focal, 0.5 * self.width, 0.5 * self.height, lenses.FISHEYE)
        focal = 0.5 * self.width / float(np.tan(0.5 * np.deg2rad(self.fov)))
        return Intrinsics(self.width, self.height, focal, focal, 0.5 * self.width, 0.5 * self.height)


@dataclass
class MeshSettings:
    up: Annotated[str, one_of("z", "y")] = "z"  # which axis of the file points up: z or y
    scale: Annotated[float, Field(ge=1e-9, le=1e9)] = 1.0  # metres a unit of the file
    # Low and high corner of where the camera may be; None: inside the bounding box
    free: Annotated[list[Point], Field(min_length=2, max_length=2)] | None = None
    focus: Point | None = None  # what is looked at; None: the middle


@dataclass
class SceneFile:
    """A scene file with its defaults."""

    scene: str = "room"  # a procedural kind, or the path of a GLB, OBJ or PLY
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    camera: CameraSettings = default(default_factory=CameraSettings)
    path: PathSettings = default(default_factory=PathSettings)
    output: Annotated[str, one_of(*OUTPUTS)] = "frames"  # frames (with transforms.json), photos (images alone) or video
    depth: bool = False  # a depth camera beside the colour camera
    side: Annotated[int, Field(ge=1, le=8)] = 2  # pixels that hold an edge are the mean of side × side rays
    mesh: MeshSettings = default(default_factory=MeshSettings)
    markers: Annotated[list[MarkerSettings], Field(max_length=100)] = default(default_factory=list)  # ArUco markers, in procedural scenes
    gps: GpsSettings | None = None  # in the images' EXIF; None: they have none
    effects: Any = None


def read_scene_file(path: Path | str) -> SceneFile:
    """Defaults with a scene file's values over them.

    Raises:
        InputError: not readable, a key that does not exist (with the nearest that does), or a value that does not fit.
    """
    path = Path(path)
    try:
        if path.stat().st_size > MAX_BYTES:
            raise InputError(f"{path} holds more than a megabyte; it is no scene file")
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read the scene file {path}: {getattr(error, 'strerror', None) or error}") from error
    return scene_file(read_yaml(text, str(path)), str(path))


def scene_file(data: dict[str, Any], where: str) -> SceneFile:
    """A scene file's content from plain data.

    Raises:
        InputError: as for `read_scene_file`.
    """
    settings = checked(SceneFile, {key: value for key, value in data.items() if key != "effects"}, where)
    settings.effects = data.get("effects")
    kind = settings.camera.kind
    if kind == PINHOLE and settings.camera.fov > WIDEST_PINHOLE:
        raise InputError(f"{where}: a pinhole's fov is at most {WIDEST_PINHOLE} degrees; lower camera.fov, or set camera.kind: fisheye")
    if kind == PANORAMA and settings.camera.width != 2 * settings.camera.height:
        raise InputError(f"{where}: a panorama is twice as wide as high; correct camera.width and camera.height")
    if kind != PINHOLE and settings.depth:
        raise InputError(f"{where}: the depth camera is a pinhole; leave out `depth: true`, or camera.kind: {kind}")
    if settings.depth and settings.output != "frames":
        raise InputError(f"{where}: depth needs `output: frames`; {settings.output} have nowhere to put it")
    if settings.gps is not None and settings.output == "video":
        raise InputError(f"{where}: gps needs `output: frames` or `photos`; a video's frames have no place for it")
    if settings.output == "video" and (settings.camera.width % 2 or settings.camera.height % 2):
        raise InputError(f"{where}: videos need an even width and height; correct camera.width and camera.height")
    return settings
