"""Depth maps by matching at the size of an image, and as a file."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.errors import InputError, first_line
from fieldfuse.files import atomic_path
from fieldfuse.stereo.match import StereoDepth

LEAST_CONFIDENCE = 0.5  # two other views confirm a depth for each one that sees through it
SMOOTH = 0.05  # share by which depths side by side may differ, to be interpolated, besides their noise


def depth_at(found: StereoDepth, width: int, height: int) -> Array:
    """(height, width) float32 depth of a view on more or fewer pixels than it was found on, 0 where it is unknown, not confident enough,
    or beside an edge, where it would lie between two surfaces."""
    depth = np.where(found.confidence >= LEAST_CONFIDENCE, found.depth, np.float32(0))
    if depth.shape == (height, width):
        return np.ascontiguousarray(depth, dtype=np.float32)
    return _interpolated(depth, width, height, found.noise)


def enlarged(depth: Array, width: int, height: int) -> Array:
    """(height, width) float32 a depth map on more pixels, 0 or not finite = unknown; beside an edge each has the nearest depth there is."""
    known = np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float32)
    between = _interpolated(known, width, height)
    return np.where(between > 0, between, cv2.resize(known, (width, height), interpolation=cv2.INTER_NEAREST))


def _interpolated(depth: Array, width: int, height: int, noise: float = 0.0) -> Array:
    """(height, width) float32, linear in inverse depth, 0 beside what is unknown and beside edges; inverse depths that differ by no more
    than `noise` make none."""
    inverse: Array = np.where(depth > 0, 1 / np.maximum(depth, np.float32(1e-12)), 0).astype(np.float32)
    window = np.ones((3, 3), np.uint8)
    nearest, farthest = cv2.dilate(inverse, window), cv2.erode(inverse, window)
    smooth: Array = ((farthest > 0) & (nearest - farthest <= np.maximum(SMOOTH * farthest, np.float32(noise)))).astype(np.uint8)
    inverse = cv2.resize(inverse, (width, height), interpolation=cv2.INTER_LINEAR)
    smooth = cv2.resize(smooth, (width, height), interpolation=cv2.INTER_NEAREST)
    return np.where(smooth > 0, 1 / np.maximum(inverse, np.float32(1e-12)), np.float32(0)).astype(np.float32)


def save_stereo(path: Path | str, names: Sequence[str], depths: Sequence[StereoDepth]) -> None:
    """Write the depth maps of the views `names` in full, their confidences in 8 bits.

    Raises:
        OutputError: the file cannot be written.
    """
    tensors = {}
    for index, found in enumerate(depths):
        tensors[f"depth.{index}"] = np.ascontiguousarray(found.depth, dtype=np.float32)
        tensors[f"confidence.{index}"] = np.round(found.confidence * 255).astype(np.uint8)
    cameras, noises = [found.intrinsics.to_dict() for found in depths], [found.noise for found in depths]
    about = {"names": list(names), "cameras": cameras, "noise": noises}
    with atomic_path(path) as temporary:
        save_file(tensors, temporary, metadata={"stereo": json.dumps(about)})


def load_stereo(path: Path | str) -> tuple[list[str], list[StereoDepth]]:
    """What `save_stereo` wrote: names and depth maps.

    Raises:
        InputError: missing or damaged.
    """
    with opened(path, "stereo") as (file, about):
        names, cameras = [str(name) for name in about["names"]], [Intrinsics.from_dict(camera) for camera in about["cameras"]]
        noises = [float(noise) for noise in about.get("noise", [0.0] * len(cameras))]  # older files have none
        if len(noises) != len(cameras) or not all(0 <= noise < np.inf for noise in noises):
            raise ValueError("the noise of the depth maps cannot be")
        out = []
        for index, (camera, noise) in enumerate(zip(cameras, noises, strict=True)):
            depth, confidence = file.get_tensor(f"depth.{index}"), file.get_tensor(f"confidence.{index}")
            shape = (camera.height, camera.width)
            if depth.shape != shape or confidence.shape != shape or depth.dtype != np.float32 or not np.isfinite(depth).all():
                raise ValueError(f"the depth map {index} does not fit its camera")
            out.append(StereoDepth(depth, confidence.astype(np.float32) / 255, camera, noise))
        if len(names) != len(out):
            raise ValueError("there are not as many names as depth maps")
        return names, out


@contextmanager
def opened(path: Path | str, key: str) -> Iterator[tuple[Any, Any]]:
    """A safetensors file and what stands as JSON under `key` in its header; whatever is wrong with either while it is read is refused.

    Raises:
        InputError: missing or damaged.
    """
    try:
        with safe_open(str(path), framework="numpy") as file:
            yield file, json.loads(file.metadata()[key])
    except (InputError, SafetensorError, OSError, KeyError, TypeError, ValueError, AttributeError, OverflowError, RecursionError) as error:
        raise InputError(f"{path} cannot be read ({first_line(error)}); remove it and run the command again") from error
