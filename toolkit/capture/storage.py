"""What a run's folder holds of a capture: `capture.json` (the capture as plain data) and prepared `Views` as one safetensors file."""

from __future__ import annotations

import json
import math
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from fieldfuse.camera import PINHOLE, Array, Intrinsics
from fieldfuse.capture.types import Capture, Frame, Views
from fieldfuse.errors import InputError, first_line
from fieldfuse.files import atomic_path
from fieldfuse.tone import Tone

VERSION = 1
PATHS, CAMERAS = ("image", "depth", "mask", "confidence"), ("intrinsics", "depth_intrinsics")
POSES = ("world_from_camera", "depth_pose", "source_from_view")
FLAGS = ("mask_excludes", "mask_is_alpha", "as_stored")
OPTIONAL: tuple[tuple[str, str, type, tuple[int, ...]], ...] = (  # lists of `Views`, and the name, type and channels in the file
    ("valid", "valid", np.bool_, ()),
    ("alpha", "alpha", np.uint8, ()),
    ("depths", "depth", np.float32, ()),
    ("photos", "photo", np.uint8, (3,)),
)


def capture_to_dict(capture: Capture) -> dict[str, Any]:
    """Plain data (numbers, strings, lists) that `capture_from_dict` turns back into an equal capture."""
    return {
        "version": VERSION,
        "kind": capture.kind,
        "root": str(capture.root),
        "ordered": capture.ordered,
        "metric": capture.metric,
        "depth_scale": float(capture.depth_scale),
        "alpha": capture.alpha,
        "up": None if capture.up is None else [float(value) for value in capture.up],
        "warnings": list(capture.warnings),
        "extra": capture.extra,
        "film": capture.film,
        "points": None if capture.points is None else np.asarray(capture.points, dtype=np.float64).tolist(),
        "frames": [{one.name: _plain(getattr(frame, one.name)) for one in fields(frame)} for frame in capture.frames],
    }


def capture_from_dict(data: dict[str, Any]) -> Capture:
    """The capture that `capture_to_dict` described.

    Raises:
        InputError: `data` is not such a description.
    """
    try:
        if data["version"] != VERSION:
            raise InputError(
                f"the stored capture has version {data['version']}, this program reads version {VERSION}; run the job again in a new folder"
            )
        return Capture(
            kind=str(data["kind"]),
            root=Path(data["root"]),
            frames=tuple(_frame(frame) for frame in data["frames"]),
            ordered=bool(data["ordered"]),
            metric=bool(data["metric"]),
            depth_scale=float(data["depth_scale"]),
            alpha=bool(data["alpha"]),
            up=None if data["up"] is None else (float(data["up"][0]), float(data["up"][1]), float(data["up"][2])),
            points=None if data["points"] is None else np.array(data["points"], dtype=np.float64).reshape(-1, 3),
            warnings=tuple(str(warning) for warning in data["warnings"]),
            extra=dict(data["extra"]),
            film=bool(data.get("film", False)),
        )
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError) as error:
        raise InputError(
            f"the stored capture is not usable ({type(error).__name__}: {first_line(error)}); run the job again in a new folder"
        ) from error


def _plain(value: Any) -> Any:
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Intrinsics):
        return value.to_dict()
    return np.asarray(value, dtype=np.float64).tolist() if isinstance(value, np.ndarray) else value


def _frame(data: dict[str, Any]) -> Frame:
    given = {key: value for key, value in data.items() if value is not None}
    values: dict[str, Any] = {key: given.get(key) for key in ("split", "video_index", "focal_prior", "instant")}
    values |= {key: Path(given[key]) for key in PATHS if key in given}
    values |= {key: Intrinsics.from_dict(given[key]).checked("the stored capture") for key in CAMERAS if key in given}
    values |= {key: np.array(given[key], dtype=np.float64).reshape(4, 4) for key in POSES if key in given}
    values |= {key: bool(given.get(key, False)) for key in FLAGS}
    values |= {"white": float(given["white"])} if "white" in given else {}
    values |= {"linear": bool(given["linear"])} if "linear" in given else {}
    if "balance" in given:
        red, green, blue = (float(value) for value in given["balance"])
        values["balance"] = (red, green, blue)
    return Frame(name=str(data["name"]), **values)


# ------------------------------------------------------------------------------------------------ views


def save_views(path: Path, views: Views) -> None:
    """Write `views` atomically: pixels as tensors, names and cameras as JSON in the file's metadata.

    Raises:
        OutputError: the folder is not writable or the disk is full.
    """
    tensors: dict[str, Array] = {
        "world_from_camera": np.ascontiguousarray(views.world_from_camera, dtype=np.float64),
        "test": np.ascontiguousarray(views.test, dtype=np.bool_),
    }
    for index in range(len(views)):
        tensors[f"image.{index}"] = np.ascontiguousarray(views.images[index], dtype=np.uint8)
        for attribute, name, kind, _ in OPTIONAL:
            values = getattr(views, attribute)
            if values and values[index] is not None:
                tensors[f"{name}.{index}"] = np.ascontiguousarray(values[index], dtype=kind)
    facts = {
        "names": views.names,
        "intrinsics": [intrinsics.to_dict() for intrinsics in views.intrinsics],
        "background": views.background,
        "weight": views.weight,
        "tones": [None if tone is None else tone.to_dict() for tone in views.tones],
    }
    metadata = {"format": "fieldfuse-views", "version": str(VERSION), "views": json.dumps(facts, allow_nan=False)}
    with atomic_path(path) as temporary:
        save_file(tensors, temporary, metadata=metadata)


def load_views(path: Path) -> Views:
    """Read views back, checking that every part has the size that the others promise.

    Raises:
        InputError: missing, of another kind or version, damaged or tampered with.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"there are no prepared views {path}; run the job again to make them")
    try:
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            if metadata.get("format") == "fieldfuse-views" and metadata.get("version") == str(VERSION):
                return _views(json.loads(metadata["views"]), set(file.keys()), file)
    except (InputError, SafetensorError, OSError, KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
        raise InputError(f"the prepared views {path} are damaged ({first_line(error)}); remove the file and run the job again") from error
    raise InputError(f"{path} does not hold prepared views of version {VERSION}; remove it and run the job again")


def _views(facts: dict[str, Any], keys: set[str], file: Any) -> Views:
    def require(fine: bool, reason: str) -> None:
        if not fine:
            raise ValueError(reason)

    def tensor(key: str, kind: type, shape: tuple[int, ...]) -> Array:
        value = np.asarray(file.get_tensor(key))
        require(value.dtype == kind and value.shape == shape, f"{key} is {value.dtype} {value.shape}, expected {np.dtype(kind)} {shape}")
        return value

    names = [str(name) for name in facts["names"]]
    cameras = [Intrinsics.from_dict(entry).checked(f"camera {index}") for index, entry in enumerate(facts["intrinsics"])]
    count = len(names)
    require(len(cameras) == count, f"{count} names and {len(cameras)} cameras")
    require(len(set(names)) == count, "a name stands for two views")
    poses = tensor("world_from_camera", np.float64, (count, 4, 4))
    require(bool(np.isfinite(poses).all()), "a pose is not finite")
    views = Views(names, [], cameras, poses, tensor("test", np.bool_, (count,)))
    for index, camera in enumerate(cameras):
        require(camera.lens == PINHOLE and not camera.distorted, f"camera {index} has a lens")
        size = camera.height, camera.width
        views.images.append(tensor(f"image.{index}", np.uint8, (*size, 3)))
        for attribute, name, kind, channels in OPTIONAL:
            key = f"{name}.{index}"
            getattr(views, attribute).append(tensor(key, kind, (*size, *channels)) if key in keys else None)
    if facts["background"] is not None:
        red, green, blue = (float(value) for value in facts["background"])
        require(all(math.isfinite(value) and 0 <= value <= 1 for value in (red, green, blue)), "the background is no colour")
        views.background = (red, green, blue)
    views.weight = [float(value) for value in facts.get("weight", [])]
    views.tones = [None if entry is None else Tone.from_dict(entry) for entry in facts.get("tones", [])]
    require(len(views.tones) in (0, count), "an image's tone is missing")
    if all(photo is None for photo in views.photos):
        views.photos = []
    require(bool(views.tones) or not views.photos, "there are photos in other colours, and their tones are missing")
    require(len(views.weight) in (0, count) and all(0 <= value <= 1 for value in views.weight), "a weight is no share, or one is missing")
    return views
