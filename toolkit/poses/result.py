"""What finding (or reading) camera poses gives: plain data that is also `poses.json`. And poses that the capture brings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from fieldfuse.camera import Array, Intrinsics, project
from fieldfuse.capture.images import load_depth
from fieldfuse.capture.poses import checked_pose
from fieldfuse.capture.types import Capture
from fieldfuse.errors import InputError, PoseError, first_line
from fieldfuse.georeference import Georeference

GIVEN, SFM = "given", "sfm"
FEW, SHARE = 6, 0.1  # images with poses, and their share of all, below which the model is a failed one, or of other images
DEPTH_FRAMES = 12  # depth maps that a scale is taken from
MIN_POINTS = 50  # points with depth that make a scale believable
SPREAD = 0.25  # relative spread (half the 20–80% range) of depth ratios above which sensor and model disagree
ADDED = ("up", "georeference", "scaling")


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
    point_errors: Array | None = None  # (P,) mean reprojection error, pixels of the image
    warnings: list[str] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)  # by step
    metric: bool = False  # one unit is one metre
    up: tuple[float, float, float] | None = None  # of structure from motion's frame, where it was placed on earth
    georeference: Georeference | None = None  # where the frame lies on earth; None: not known
    scaling: dict[str, Any] | None = None  # what gave the unit of length: `source`, `factor`, `error` (relative), `text`; None: nothing did
    agreement: dict[str, Any] | None = None  # of given poses with the images: `share`, `matches`, `pairs`, `reading`; None: not measured

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON, without what `scaling.Scaling` adds. Points have float32's seven digits, poses all."""
        return {
            **{entry.name: getattr(self, entry.name) for entry in fields(self) if entry.name not in ADDED},
            "intrinsics": [camera.to_dict() for camera in self.intrinsics],
            "world_from_camera": np.asarray(self.world_from_camera, dtype=np.float64).tolist(),
            "points": None if self.points is None else _short(self.points, 7),
            "point_errors": None if self.point_errors is None else _short(self.point_errors, 4),
            "seconds": {key: round(float(value), 3) for key, value in self.seconds.items()},
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
        posed = replace(capture.with_frames(frames, *self.warnings), points=self.points)
        return replace(posed, up=self.up, metric=self.metric) if self.source == SFM else posed

    def warned(self, text: str) -> PoseResult:
        """With one more warning."""
        return replace(self, warnings=[*self.warnings, text])


def _short(values: Array, digits: int) -> Any:
    array = np.asarray(values, dtype=np.float64)
    return np.array([float(f"{value:.{digits}g}") for value in array.ravel()]).reshape(array.shape).tolist()


def listed(names: Sequence[str], most: int = 8) -> str:
    """Names for a sentence, runs of neighbours not resolved: `a, b, c and 12 more`."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def given_poses(capture: Capture) -> PoseResult:
    """The frames that come with pose and intrinsics, as they are.

    Raises:
        PoseError: fewer than two frames have both, hardly any of many images do, or all cameras stand on one spot.
    """
    posed = [frame for frame in capture.frames if frame.world_from_camera is not None and frame.intrinsics is not None]
    missing = [frame.name for frame in capture.frames if frame.world_from_camera is None or frame.intrinsics is None]
    if len(posed) < 2:
        raise PoseError(
            f"{capture.root}: {len(posed)} of {len(capture.frames)} frames come with a pose and intrinsics, at least 2 "
            f"are needed; use --set poses.source=sfm to find them"
        )
    every = len(posed) + int(capture.extra.get("unregistered") or 0)
    if len(posed) < FEW and len(posed) < SHARE * every:
        raise PoseError(
            f"{capture.root}: the poses that come with it are of {len(posed)} of {every} images only, so they hardly are of "
            f"these images; find poses of all with --poses sfm"
        )
    poses = np.array([frame.world_from_camera for frame in posed], dtype=np.float64)
    centres = poses[:, :3, 3]
    spread = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())
    if not spread > 1e-9 * max(1.0, float(np.abs(centres).max())):
        raise PoseError(
            f"{capture.root}: all {len(posed)} given cameras stand on one spot, so depth cannot be estimated; record while "
            f"moving sideways, or correct the poses"
        )
    without = f"{len(missing)} of {len(capture.frames)} frames come without a pose and are left out: {listed(missing)}"
    return PoseResult(
        source=GIVEN,
        registered=len(posed),
        total=len(capture.frames),
        names=[frame.name for frame in posed],
        intrinsics=[frame.intrinsics.checked(f"{capture.root}, {frame.name}") for frame in posed if frame.intrinsics is not None],
        world_from_camera=poses,
        models=[len(posed)],
        missing=missing,
        points=None if capture.points is None else np.asarray(capture.points, dtype=np.float64),
        warnings=[without] if missing else [],
        metric=capture.metric,
    )


def scale_to_depth(result: PoseResult, capture: Capture) -> PoseResult:
    """`result` scaled so that its points' depths agree with the capture's depth maps (median ratio over points and frames): structure from
    motion has no metres, a depth camera has.

    Unchanged but for a warning when they disagree among themselves or there is too little to compare.
    """
    by_name = {frame.name: frame for frame in capture.frames}
    ratios = [np.zeros(0)]
    for i in range(0, len(result.names), max(1, len(result.names) // DEPTH_FRAMES)):
        frame = by_name[result.names[i]]
        if frame.depth is None or result.points is None:
            continue
        depth = load_depth(frame, capture)
        camera = (frame.depth_intrinsics or result.intrinsics[i]).scaled(depth.shape[1], depth.shape[0])
        pixels, z = project(camera, result.world_from_camera[i], result.points)
        inside = (z > 0) & np.all(pixels >= 0, axis=1) & (pixels[:, 0] < depth.shape[1]) & (pixels[:, 1] < depth.shape[0])
        sensed = depth[pixels[inside, 1].astype(int), pixels[inside, 0].astype(int)]
        ratios.append(sensed[sensed > 0] / z[inside][sensed > 0])
    found = np.concatenate(ratios)
    if len(found) < MIN_POINTS:
        text = "the depth maps share too few points with the poses found, so the scale stays unknown and depth is of no use here"
        return result.warned(text)
    low, scale, high = np.percentile(found, [20, 50, 80])
    if (high - low) / (2 * scale) > SPREAD:
        return result.warned(
            f"the depth maps and the poses found disagree on scale (ratios from {low:.3g} to {high:.3g}); "
            f"check the depth's unit and alignment"
        )
    poses = result.world_from_camera.copy()
    poses[:, :3, 3] *= scale
    points = None if result.points is None else result.points * scale
    return replace(result, world_from_camera=poses, points=points, metric=capture.metric or capture.has_depth)
