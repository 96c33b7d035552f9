"""Scene files: YAML that tells what is filmed, by which camera, along which path, and through which effects."""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from dataclasses import field as default
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from fieldfuse.camera import Intrinsics
from fieldfuse.config import refuse_traps
from fieldfuse.errors import InputError, first_line
from fieldfuse.simulate.paths import PathSettings

MAX_BYTES = 2**20
OUTPUTS = ("frames", "photos", "video")


@dataclass
class CameraSettings:
    width: int = 640  # pixels
    height: int = 480
    fov: float = 65.0  # degrees across the width, without lens distortion

    def intrinsics(self) -> Intrinsics:
        """The pinhole camera, its principal point in the middle."""
        focal = 0.5 * self.width / float(np.tan(0.5 * np.deg2rad(self.fov)))
        return Intrinsics(self.width, self.height, focal, focal, 0.5 * self.width, 0.5 * self.height)


@dataclass
class MeshSettings:
    up: str = "z"  # which axis of the file points up: z or y
    scale: float = 1.0  # metres a unit of the file
    free: list[list[float]] | None = None  # low and high corner of where the camera may be; None: inside the bounding box
    focus: list[float] | None = None  # what is looked at; None: the middle


@dataclass
class SceneFile:
    """A scene file with its defaults."""

    scene: str = "room"  # a procedural kind, or the path of a GLB, OBJ or PLY
    seed: int = 0
    camera: CameraSettings = default(default_factory=CameraSettings)
    path: PathSettings = default(default_factory=PathSettings)
    output: str = "frames"  # frames (with transforms.json), photos (pictures alone) or video
    depth: bool = False  # a depth camera beside the colour camera
    side: int = 2  # pixels that hold an edge are the mean of side × side rays
    mesh: MeshSettings = default(default_factory=MeshSettings)
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
    try:
        refuse_traps(text, str(path))
        data = OmegaConf.to_container(OmegaConf.create(text or "{}"), resolve=False)
    except InputError:
        raise
    except Exception as error:  # the YAML parser raises its own family
        raise InputError(f"{path} is not valid YAML: {first_line(error)}") from error
    if not isinstance(data, dict):
        raise InputError(f"{path} must hold `key: value` pairs")
    return scene_file({str(key): value for key, value in data.items()}, str(path))


def scene_file(data: dict[str, Any], where: str) -> SceneFile:
    """A scene file's content from plain data.

    Raises:
        InputError: as for `read_scene_file`.
    """
    base: DictConfig = OmegaConf.structured(SceneFile)
    effects = data.get("effects")
    rest = {key: value for key, value in data.items() if key != "effects"}
    _check_keys(rest, base, where, "")
    try:
        merged = OmegaConf.to_object(OmegaConf.merge(base, rest))
    except (OmegaConfBaseException, ValueError) as error:
        key = getattr(error, "full_key", None) or "a value"
        raise InputError(f"{where}: {key} does not fit ({first_line(error)})") from error
    assert isinstance(merged, SceneFile)
    merged.effects = effects
    _check(merged, where)
    return merged


def _check_keys(data: dict[str, Any], known: DictConfig, where: str, prefix: str) -> None:
    for key, value in data.items():
        if key not in known:
            near = difflib.get_close_matches(str(key), [str(name) for name in known], n=1, cutoff=0.4)
            hint = f"; did you mean {prefix + near[0]!r}?" if near else ""
            raise InputError(f"{where}: there is no setting {prefix + str(key)!r}{hint}")
        if isinstance(known.get(key), DictConfig):
            if not isinstance(value, dict):
                raise InputError(f"{where}: {prefix}{key} must hold `key: value` pairs")
            _check_keys(value, known[key], where, f"{prefix}{key}.")


def _check(settings: SceneFile, where: str) -> None:
    ranges: dict[str, tuple[float, float, float]] = {
        "seed": (settings.seed, 0, 2**32 - 1),
        "camera.width": (settings.camera.width, 16, 4096),
        "camera.height": (settings.camera.height, 16, 4096),
        "camera.fov": (settings.camera.fov, 5, 140),
        "path.frames": (settings.path.frames, 1, 100_000),
        "path.fps": (settings.path.fps, 1e-3, 1e4),
        "path.speed": (settings.path.speed, 0, 100),
        "path.turn": (settings.path.turn, 0, 1000),
        "path.shake": (settings.path.shake, 0, 1000),
        "side": (settings.side, 1, 8),
        "mesh.scale": (settings.mesh.scale, 1e-9, 1e9),
    }
    for name, (value, low, high) in ranges.items():
        if not low <= value <= high:
            raise InputError(f"{where}: {name} is {value:g}; it must lie between {low:g} and {high:g}")
    if settings.output not in OUTPUTS:
        raise InputError(f"{where}: output is {settings.output!r}; it must be one of {', '.join(OUTPUTS)}")
    if settings.depth and settings.output != "frames":
        raise InputError(f"{where}: depth needs `output: frames`; {settings.output} have nowhere to put it")
    if settings.output == "video" and (settings.camera.width % 2 or settings.camera.height % 2):
        raise InputError(f"{where}: videos need an even width and height; correct camera.width and camera.height")
    if settings.mesh.up not in ("y", "z"):
        raise InputError(f"{where}: mesh.up is {settings.mesh.up!r}; it must be y or z")
    if settings.mesh.free is not None and [len(corner) for corner in settings.mesh.free] != [3, 3]:
        raise InputError(f"{where}: mesh.free takes two corners of three numbers each")
    if settings.mesh.focus is not None and len(settings.mesh.focus) != 3:
        raise InputError(f"{where}: mesh.focus takes three numbers")
