"""The working frame and what is worth modelling in it. Everything after this stage lives in the working frame."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from fieldfuse.camera import Array, Similarity
from fieldfuse.capture.types import Capture
from fieldfuse.errors import InputError, PoseError, first_line
from fieldfuse.poses.cloud import Cloud, cloud_of_depth, cloud_of_points, silhouette_cloud
from fieldfuse.poses.points import Features, triangulate
from fieldfuse.poses.region import FORWARD, ROOM, Layout, box, camera_frame, layout, points_of_interest, tight_turn, turn_about_z
from fieldfuse.progress import SILENT, Progress

MEDIAN_DEPTH = 1.5  # working units, for captures without scale
BEYOND = 0.05  # share of observations outside the region that makes a background
SURFACE = 1.2  # times the region: what stands out of it is part of what is looked at, and has few points (noses, rims)
FEW_POINTS = 30  # fewer cannot describe a scene


@dataclass
class Scene:
    """The working frame (z up, recentred on the region, metres or median depth 1.5) and the region of interest in it."""

    working_from_input: Similarity
    centre: Array  # (3,) of the region of interest
    half_size: Array  # (3,) along the working axes
    median_depth: float  # median over frames of the median depth
    near: float  # closest depth that matters to a camera
    far: float  # farthest depth seen, background included
    background_share: float  # share of observations that lie beyond the region
    has_background: bool  # whether space beyond the region has to be modelled
    metric: bool
    layout: str = "object"  # object (cameras look inwards) | room (around) | forward (one way)
    up_reason: str = ""
    points_source: str = ""  # source | depth | triangulated | silhouettes
    points: int = 0  # of these
    warnings: list[str] = field(default_factory=list)

    def surface_box(self) -> tuple[Array, Array]:
        """(3,) lowest and (3,) highest corner of the box in which a surface is taken from a field: the region, and for what is looked at
        from around or from one side a margin. In a room the region holds the walls."""
        half = self.half_size * (1.0 if self.layout == ROOM else SURFACE)
        return self.centre - half, self.centre + half

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON."""
        plain = {entry.name: getattr(self, entry.name) for entry in fields(self)}
        return {
            **plain,
            "working_from_input": self.working_from_input.to_dict(),
            "centre": self.centre.tolist(),
            "half_size": self.half_size.tolist(),
            "warnings": list(self.warnings),
        }

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Scene:
        """The reverse of `to_dict`.

        Raises:
            InputError: the data does not hold what `to_dict` writes.
        """
        try:
            if not 0 <= float(data["near"]) < float(data["far"]):
                raise ValueError(f"depths from {data['near']} to {data['far']}")
            kinds = {"float": float, "bool": bool, "str": str, "int": int}
            return cls(
                working_from_input=Similarity.from_dict(data["working_from_input"]),
                centre=np.array(data["centre"], dtype=np.float64).reshape(3),
                half_size=np.array(data["half_size"], dtype=np.float64).reshape(3),
                warnings=[str(text) for text in data["warnings"]],
                **{entry.name: kinds[str(entry.type)](data[entry.name]) for entry in fields(cls) if entry.type in kinds},
            )
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise InputError(f"scene.json is not what the poses stage writes ({first_line(error)}); remove it and run again") from error


def describe_scene(capture: Capture, progress: Progress = SILENT, known: dict[str, Features] | None = None) -> Scene:
    """Working frame, region of interest and depth range of a posed capture.

    Args:
        known: features of images by name, found before.

    Raises:
        PoseError: the capture is not posed, or too few points can be found to place the scene.
    """
    if not capture.posed:
        raise PoseError(f"{capture.root}: not every frame has a pose and intrinsics; run the poses stage first")
    # Inputs may lie far from their origin (6000 km in earth-centred frames), and turned in any way: all that follows happens near zero,
    # in a frame that the cameras decide.
    given = np.array([frame.world_from_camera for frame in capture.frames if frame.world_from_camera is not None])
    rotation, reason = camera_frame(given, capture.up)
    near_zero = Similarity(1.0, rotation, -(rotation @ given[0, :3, 3]))
    local = _moved(capture, near_zero)
    poses = np.array([frame.world_from_camera for frame in local.frames], dtype=np.float64)
    cloud = find_cloud(local, progress, known)
    if len(cloud.points) < FEW_POINTS or len(cloud.point) == 0:
        raise PoseError(
            f"{capture.root}: only {len(cloud.points)} points could be triangulated with the given poses: they or their axis convention "
            f"do not fit the images, or these show too little that is recognised in others; check the poses, use --set poses.source=sfm, "
            f"or add pictures with more texture"
        )
    depth = cloud.median_depth()
    scale = 1.0 if capture.metric else MEDIAN_DEPTH / depth
    upright = Similarity(scale, np.eye(3), np.zeros(3))
    found = layout(upright.poses(poses), with_depth=cloud.source == "depth")
    points = upright.points(cloud.points)
    bounded = cloud.source in ("silhouettes", "depth")
    turn = turn_about_z(_turn(found, upright.poses(poses), points, cloud, bounded))
    centre, half, inside = _region(Layout(found.kind, turn @ found.focus, found.distance, found.nearest), points @ turn.T, cloud, bounded)
    working = Similarity(scale, turn, -centre)
    views = cloud.views
    beyond = float((views * ~inside).sum() / max(views.sum(), 1))
    depths = cloud.depth * scale
    reach = float(np.linalg.norm(working.poses(poses)[:, :3, 3], axis=1).max() + np.linalg.norm(half))
    return Scene(
        working_from_input=working.after(near_zero),
        centre=np.zeros(3),
        half_size=half,
        median_depth=depth * scale,
        near=0.7 * float(np.percentile(depths, 0.5)),
        far=float(max(1.2 * np.percentile(depths, 99.5), reach)),
        background_share=beyond,
        # Without alpha or depth, images are full to the rim, and what has no texture left no points to count.
        has_background=not bounded or beyond > BEYOND,
        metric=capture.metric,
        layout=found.kind,
        up_reason=reason,
        points_source=cloud.source,
        points=len(cloud.points),
    )


def find_cloud(capture: Capture, progress: Progress = SILENT, known: dict[str, Features] | None = None) -> Cloud:
    """Points of a posed capture in the input's frame, from the best there is: silhouettes, depth, the source's own points, or
    triangulated."""
    if capture.alpha and len((cloud := silhouette_cloud(capture, progress)).points) >= FEW_POINTS:
        return cloud
    if capture.has_depth and len((cloud := cloud_of_depth(capture, progress)).points) >= FEW_POINTS:
        return cloud
    if capture.points is not None and len(capture.points) >= FEW_POINTS:
        cloud = cloud_of_points(capture, np.asarray(capture.points, dtype=np.float64), "source")
        if len(cloud.point) >= FEW_POINTS:
            return cloud
    return triangulate(capture, progress, known)


def _moved(capture: Capture, move: Similarity) -> Capture:
    """The capture in another frame."""
    frames = [
        replace(frame, world_from_camera=move.poses(frame.world_from_camera))
        for frame in capture.frames
        if frame.world_from_camera is not None
    ]
    points = None if capture.points is None else move.points(capture.points)
    return replace(capture, frames=tuple(frames), points=points)


def _turn(found: Layout, poses: Array, points: Array, cloud: Cloud, bounded: bool) -> float:
    """Degrees about z that make the region's box fit: along the view when cameras look one way, else tight around the points."""
    if found.kind == FORWARD and not bounded:
        ahead = poses[:, :2, 2].mean(axis=0)
        if np.linalg.norm(ahead) > 0.3:
            return float(90 - np.degrees(np.arctan2(ahead[1], ahead[0])))  # looking along +y
        return 0.0
    chosen, _, _ = points_of_interest(found, points, cloud.views, bounded)
    return tight_turn(points[chosen]) if np.count_nonzero(chosen) >= FEW_POINTS else 0.0


def _region(found: Layout, points: Array, cloud: Cloud, bounded: bool) -> tuple[Array, Array, Array]:
    """Centre, half size, and which points lie inside. Silhouettes span it whole: they have no outliers."""
    if cloud.source == "silhouettes":
        low, high = points.min(axis=0), points.max(axis=0)
        centre, half = 0.5 * (low + high), 0.5 * (high - low) * 1.04
    else:
        chosen, weights, percents = points_of_interest(found, points, cloud.views, bounded)
        centre, half = box(points[chosen], weights[chosen], percents)
    return centre, half, np.all(np.abs(points - centre) <= half, axis=1)
