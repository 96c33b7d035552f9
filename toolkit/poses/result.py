"""What finding (or reading) camera poses gives: plain data that is also `poses.json`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.capture.poses import checked_pose
from fieldfuse.capture.types import Capture
from fieldfuse.errors import InputError, first_line

GIVEN = "given"
SFM = "sfm"


@dataclass
class PoseResult:
    """Poses of the registered frames, in the input's frame (`given`) or structure from motion's own (`sfm`)."""

    source: str  # "given" or "sfm"
    registered: int
    total: int
    names: list[str]  # of the registered frames, in the capture's order
    intrinsics: list[Intrinsics]  # one a registered frame
    world_from_camera: Array  # (N, 4, 4) float64
    models: list[int] = field(default_factory=list)  # frames in each model that was found, largest first
    missing: list[str] = field(default_factory=list)  # names without a pose
    points: Array | None = None  # (P, 3) float64
    point_errors: Array | None = None  # (P,) mean reprojection error, pixels of the picture
    warnings: list[str] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)  # by step
    metric: bool = False  # one unit is one metre
    agreement: dict[str, Any] | None = None  # of given poses with the images: `share`, `matches`, `pairs`, `reading`; None: not measured

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON. Points are kept to float32's seven digits, poses in full."""
        return {
            "source": self.source,
            "registered": self.registered,
            "total": self.total,
            "models": list(self.models),
            "missing": list(self.missing),
            "names": list(self.names),
            "intrinsics": [camera.to_dict() for camera in self.intrinsics],
            "world_from_camera": np.asarray(self.world_from_camera, dtype=np.float64).tolist(),
            "points": None if self.points is None else _short(self.points, 7),
            "point_errors": None if self.point_errors is None else _short(self.point_errors, 4),
            "warnings": list(self.warnings),
            "seconds": {key: round(float(value), 3) for key, value in self.seconds.items()},
            "metric": self.metric,
            "agreement": self.agreement,
        }

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> PoseResult:
        """The reverse of `to_dict`.

        Raises:
            InputError: the data does not hold what `to_dict` writes.
        """
        try:
            names = [str(name) for name in data["names"]]
            poses = [
                checked_pose(np.array(pose, dtype=np.float64), f"poses.json, {name}")
                for name, pose in zip(names, data["world_from_camera"], strict=True)
            ]
            cameras = [Intrinsics.from_dict(camera) for camera in data["intrinsics"]]
            if len(cameras) != len(names):
                raise ValueError("as many cameras as names are needed")
            points, errors = data.get("points"), data.get("point_errors")
            return cls(
                source=str(data["source"]),
                registered=int(data["registered"]),
                total=int(data["total"]),
                names=names,
                intrinsics=cameras,
                world_from_camera=np.array(poses, dtype=np.float64).reshape(-1, 4, 4),
                models=[int(count) for count in data["models"]],
                missing=[str(name) for name in data["missing"]],
                points=None if points is None else np.array(points, dtype=np.float64).reshape(-1, 3),
                point_errors=None if errors is None else np.array(errors, dtype=np.float64).reshape(-1),
                warnings=[str(text) for text in data["warnings"]],
                seconds={str(key): float(value) for key, value in data["seconds"].items()},
                metric=bool(data.get("metric", False)),
                agreement=data.get("agreement"),
            )
        except (KeyError, TypeError, ValueError, OverflowError, AttributeError) as error:
            raise InputError(f"poses.json is not what the poses stage writes ({first_line(error)}); remove it and run again") from error

    def apply(self, capture: Capture) -> Capture:
        """`capture` with its registered frames only, each with pose and intrinsics, and with the points.

        Poses from structure from motion live in a frame of their own, so the up-direction and the points that the
        source brought in its frame are dropped.

        Raises:
            InputError: a registered frame is not in the capture.
        """
        by_name = {frame.name: frame for frame in capture.frames}
        absent = [name for name in self.names if name not in by_name]
        if absent:
            raise InputError(
                f"the poses hold {len(absent)} frames that the capture does not ({absent[0]} first); remove poses.json and run again"
            )
        frames = [
            replace(by_name[name], intrinsics=camera, world_from_camera=np.array(pose, dtype=np.float64))
            for name, camera, pose in zip(self.names, self.intrinsics, self.world_from_camera, strict=True)
        ]
        posed = capture.with_frames(frames, *self.warnings)
        if self.source == SFM:
            return replace(posed, up=None, points=self.points, metric=self.metric)
        return replace(posed, points=self.points)


def _short(values: Array, digits: int) -> Any:
    array = np.asarray(values, dtype=np.float64)
    flat = [float(f"{value:.{digits}g}") for value in array.ravel()]
    return np.array(flat).reshape(array.shape).tolist()


def listed(names: Sequence[str], most: int = 8) -> str:
    """Names for a sentence, runs of neighbours not resolved: `a, b, c and 12 more`."""
    if len(names) <= most:
        return ", ".join(names)
    return f"{', '.join(names[:most])} and {len(names) - most} more"
