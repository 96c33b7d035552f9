"""A capture as plain JSON data and back, so that a run's folder can keep it (`capture.json`)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.errors import InputError, first_line

VERSION = 1


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
        "frames": [_frame_to_dict(frame) for frame in capture.frames],
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
            frames=tuple(_frame_from_dict(frame) for frame in data["frames"]),
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


def _frame_to_dict(frame: Frame) -> dict[str, Any]:
    return {
        "name": frame.name,
        "image": str(frame.image),
        "intrinsics": None if frame.intrinsics is None else frame.intrinsics.to_dict(),
        "world_from_camera": None if frame.world_from_camera is None else np.asarray(frame.world_from_camera, dtype=np.float64).tolist(),
        "depth": None if frame.depth is None else str(frame.depth),
        "depth_intrinsics": None if frame.depth_intrinsics is None else frame.depth_intrinsics.to_dict(),
        "mask": None if frame.mask is None else str(frame.mask),
        "mask_excludes": frame.mask_excludes,
        "mask_is_alpha": frame.mask_is_alpha,
        "split": frame.split,
        "video_index": frame.video_index,
        "focal_prior": frame.focal_prior,
        "as_stored": frame.as_stored,
        "white": frame.white,
        "confidence": None if frame.confidence is None else str(frame.confidence),
        "depth_pose": None if frame.depth_pose is None else np.asarray(frame.depth_pose, dtype=np.float64).tolist(),
    }


def _frame_from_dict(data: dict[str, Any]) -> Frame:
    return Frame(
        name=str(data["name"]),
        image=Path(data["image"]),
        intrinsics=_intrinsics(data["intrinsics"]),
        world_from_camera=_pose(data["world_from_camera"]),
        depth=None if data["depth"] is None else Path(data["depth"]),
        depth_intrinsics=_intrinsics(data["depth_intrinsics"]),
        mask=None if data["mask"] is None else Path(data["mask"]),
        mask_excludes=bool(data.get("mask_excludes", False)),
        mask_is_alpha=bool(data.get("mask_is_alpha", False)),
        split=data["split"],
        video_index=data["video_index"],
        focal_prior=data["focal_prior"],
        as_stored=bool(data.get("as_stored", False)),
        confidence=None if data.get("confidence") is None else Path(data["confidence"]),
        white=None if data.get("white") is None else int(data["white"]),
        depth_pose=_pose(data.get("depth_pose")),
    )


def _intrinsics(data: dict[str, Any] | None) -> Intrinsics | None:
    return None if data is None else Intrinsics.from_dict(data).checked("the stored capture")


def _pose(data: Any) -> Array | None:
    return None if data is None else np.array(data, dtype=np.float64).reshape(4, 4)
