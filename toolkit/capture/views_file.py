"""`Views` as one safetensors file: pixels as tensors, names and cameras as JSON in its metadata."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from fieldfuse.camera import PINHOLE, Array, Intrinsics
from fieldfuse.capture.types import Views
from fieldfuse.errors import InputError, OutputError, first_line
from fieldfuse.files import atomic_path
from fieldfuse.tone import Tone

VERSION = 1
_OPTIONAL: dict[str, type] = {"valid": np.bool_, "alpha": np.uint8, "depth": np.float32, "photo": np.uint8}


def save_views(path: Path, views: Views) -> None:
    """Write `views` atomically.

    Raises:
        OutputError: the folder is not writable or the disk is full.
    """
    tensors: dict[str, Array] = {
        "world_from_camera": np.ascontiguousarray(views.world_from_camera, dtype=np.float64),
        "test": np.ascontiguousarray(views.test, dtype=np.bool_),
    }
    for index in range(len(views)):
        tensors[f"image.{index}"] = np.ascontiguousarray(views.images[index], dtype=np.uint8)
        for name, values in (("valid", views.valid), ("alpha", views.alpha), ("depth", views.depths), ("photo", views.photos)):
            value = values[index] if values else None
            if value is not None:
                tensors[f"{name}.{index}"] = np.ascontiguousarray(value, dtype=_OPTIONAL[name])
    facts = {
        "names": views.names,
        "intrinsics": [intrinsics.to_dict() for intrinsics in views.intrinsics],
        "background": views.background,
        "weight": views.weight,
        "tones": [None if tone is None else tone.to_dict() for tone in views.tones],
    }
    with atomic_path(path) as temporary:
        try:
            save_file(
                tensors,
                temporary,
                metadata={"format": "fieldfuse-views", "version": str(VERSION), "views": json.dumps(facts, allow_nan=False)},
            )
        except SafetensorError as error:  # a full disk arrives as this, not as an OSError
            raise OutputError(f"cannot write {path}: {first_line(error)}; free space or choose another --out folder") from error


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
            known = metadata.get("format") == "fieldfuse-views" and metadata.get("version") == str(VERSION)
            if known:
                return _assemble(json.loads(metadata["views"]), set(file.keys()), file)
    except (InputError, SafetensorError, OSError, KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
        raise InputError(f"the prepared views {path} are damaged ({first_line(error)}); remove the file and run the job again") from error
    raise InputError(f"{path} does not hold prepared views of version {VERSION}; remove it and run the job again")


def _assemble(facts: dict[str, Any], keys: set[str], file: Any) -> Views:
    names = [str(name) for name in facts["names"]]
    cameras = [Intrinsics.from_dict(entry).checked(f"camera {index}") for index, entry in enumerate(facts["intrinsics"])]
    count = len(names)
    _require(len(cameras) == count, f"{count} names and {len(cameras)} cameras")
    _require(len(set(names)) == count, "a name stands for two views")
    poses = _tensor(file, "world_from_camera", np.float64, (count, 4, 4))
    _require(bool(np.isfinite(poses).all()), "a pose is not finite")
    views = Views(names, [], cameras, poses, _tensor(file, "test", np.bool_, (count,)))
    for index, camera in enumerate(cameras):
        _require(camera.lens == PINHOLE and not camera.distorted, f"camera {index} has a lens")
        views.images.append(_tensor(file, f"image.{index}", np.uint8, (camera.height, camera.width, 3)))
        for name, values in (("valid", views.valid), ("alpha", views.alpha), ("depth", views.depths), ("photo", views.photos)):
            key, shape = f"{name}.{index}", (camera.height, camera.width, *((3,) if name == "photo" else ()))
            values.append(_tensor(file, key, _OPTIONAL[name], shape) if key in keys else None)
    if facts["background"] is not None:
        red, green, blue = (float(value) for value in facts["background"])
        _require(all(math.isfinite(value) and 0 <= value <= 1 for value in (red, green, blue)), "the background is no colour")
        views.background = (red, green, blue)
    views.weight = [float(value) for value in facts.get("weight", [])]
    views.tones = [None if entry is None else Tone.from_dict(entry) for entry in facts.get("tones", [])]
    _require(len(views.tones) in (0, count), "a picture's tone is missing")
    if all(photo is None for photo in views.photos):
        views.photos = []
    _require(bool(views.tones) or not views.photos, "there are photos in other colours, and nothing tells in which")
    _require(len(views.weight) in (0, count) and all(0 <= value <= 1 for value in views.weight), "a weight is no share, or one is missing")
    return views


def _tensor(file: Any, key: str, kind: type, shape: tuple[int, ...]) -> Array:
    value = np.asarray(file.get_tensor(key))
    _require(value.dtype == kind and value.shape == shape, f"{key} is {value.dtype} {value.shape}, expected {np.dtype(kind)} {shape}")
    return value


def _require(fine: bool, reason: str) -> None:
    if not fine:
        raise ValueError(reason)
