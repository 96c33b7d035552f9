"""Metres and a place on earth for poses: by measured distances, markers, or the GPS of images. All of it moves the poses' frame, which is
that of exports; where poses came with the capture, its depth maps are scaled along."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from fieldfuse.camera import Array, Similarity
from fieldfuse.capture.gps import gps_of_images
from fieldfuse.capture.listing import images_in
from fieldfuse.capture.photos import FOLDERS
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.config import PosesSettings
from fieldfuse.errors import InputError, first_line
from fieldfuse.georeference import Georeference, usable_similarity
from fieldfuse.measures import parse_marker, parse_scale
from fieldfuse.poses.clicked import check_marks, scale_by_marks
from fieldfuse.poses.gps import LEAST, SHARE, Placed, fit_gps
from fieldfuse.poses.markers import Sized, scale_by_markers
from fieldfuse.poses.result import SFM, PoseResult
from fieldfuse.progress import SILENT, Progress

REFERENCE = "reference_lla"  # in `Capture.extra`: degrees north, degrees east, metres of the origin of a frame that is east, north, up
GPS, MARKS, MARKERS = "gps", "scale", "marker"
FACTS = ("source", "factor", "error", "text")
DIFFERS = 3.0  # standard deviations by which two sources of scale may differ
LOOKED_AT = 12  # images whose GPS decides whether all are looked at


@dataclass(frozen=True)
class Scaling:
    """How poses are to be moved, and what gave it."""

    move: Similarity = field(default_factory=Similarity.identity)  # frame of the result from that in which poses were found
    metric: bool = False
    georeference: Georeference | None = None
    facts: dict[str, Any] | None = None  # `source`, `factor`, `error` (relative), `text`
    warnings: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON."""
        return {
            "move": self.move.to_dict(),
            "metric": self.metric,
            "georeference": None if self.georeference is None else self.georeference.to_dict(),
            "facts": self.facts,
            "warnings": list(self.warnings),
        }

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Scaling:
        """The reverse of `to_dict`.

        Raises:
            InputError: the data does not hold what `to_dict` writes.
        """
        try:
            place = data["georeference"]
            return cls(
                move=usable_similarity(data["move"]),
                metric=bool(data["metric"]),
                georeference=None if place is None else Georeference.from_dict(place),
                facts=None if data["facts"] is None else _facts(*(data["facts"][name] for name in FACTS)),
                warnings=tuple(str(text) for text in data["warnings"]),
            )
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise InputError(f"scaling.json is not what a run writes ({first_line(error)}); remove it and run again") from error

    def apply(self, capture: Capture, poses: PoseResult) -> tuple[Capture, PoseResult]:
        """Capture and poses in the new frame: depth maps, and the capture's own poses, have its unit."""
        if self.facts is None and self.georeference is None:
            return capture, replace(poses, warnings=[*poses.warnings, *self.warnings])
        moved = replace(
            poses,
            world_from_camera=self.move.poses(poses.world_from_camera),
            points=None if poses.points is None else self.move.points(poses.points),
            metric=self.metric or poses.metric,
            up=(0.0, 0.0, 1.0) if self.georeference is not None and poses.source == SFM else poses.up,
            georeference=self.georeference,
            scaling=self.facts,
            warnings=[*poses.warnings, *self.warnings],
        )
        capture = capture if self.move.scale == 1.0 else rescaled(capture, self.move.scale, moved.metric)
        if self.georeference is not None and poses.source != SFM and capture.up is None:
            east, north, up = (float(value) for value in self.georeference.enu_from_input.rotation[2])
            capture = replace(capture, up=(east, north, up))
        return capture, moved


def rescaled(capture: Capture, factor: float, metric: bool) -> Capture:
    """The capture with lengths `factor` times as long: poses, points, depth, and where the depth camera stands."""

    def longer(pose: Array | None) -> Array | None:
        return None if pose is None else Similarity(factor, np.eye(3), np.zeros(3)).poses(pose)

    def moved(frame: Frame) -> Frame:
        return replace(frame, world_from_camera=longer(frame.world_from_camera), depth_pose=longer(frame.depth_pose))

    points = None if capture.points is None else factor * np.asarray(capture.points)
    frames = tuple(moved(frame) for frame in capture.frames)
    return replace(capture, frames=frames, points=points, depth_scale=capture.depth_scale / factor, metric=metric)


def check_measures(capture: Capture, settings: PosesSettings) -> None:
    """Refuse measured distances in images that are not there, before anything long is started.

    Raises:
        InputError: naming the image.
    """
    if settings.scale is not None:
        check_marks(capture, parse_scale(settings.scale))


def wanted(capture: Capture, settings: PosesSettings, estimated: bool) -> bool:
    """Whether there is anything to look at; `estimated`: poses are those of structure from motion."""
    stated = settings.scale is not None or settings.marker is not None
    return stated or (_by_gps(capture, settings) if estimated else REFERENCE in capture.extra)


def _by_gps(capture: Capture, settings: PosesSettings) -> bool:
    """Whether images have GPS that may place structure from motion."""
    if settings.gps == "off" or capture.frames[0].video_index is not None:
        return False
    some = capture.frames[:: max(1, len(capture.frames) // LOOKED_AT)]
    places = gps_of_images(originals(capture, some))
    return bool(np.isfinite(places[:, :2]).all(axis=1).sum() > SHARE * len(some)) and len(capture.frames) >= LEAST


def originals(capture: Capture, frames: Sequence[Frame]) -> list[Path]:
    """The images' files as the camera wrote them: a JPEG that was made of a HEIF photo has no GPS."""
    if all(frame.image.is_relative_to(capture.root) for frame in frames):
        return [frame.image for frame in frames]
    by_stem = {path.stem: path for folder in FOLDERS for path in images_in(capture.root / folder)} if capture.root.is_dir() else {}
    return [frame.image if frame.image.is_relative_to(capture.root) else by_stem.get(frame.image.stem, frame.image) for frame in frames]


def find_scaling(capture: Capture, poses: PoseResult, settings: PosesSettings, progress: Progress = SILENT) -> Scaling:
    """What makes the poses metric and places them on earth; see the module.

    Raises:
        InputError: measured distances or markers that are named cannot be found in the images.
    """
    estimated, warnings = poses.source == SFM, list[str]()
    placed: Placed | None = None
    if estimated and _by_gps(capture, settings):
        placed = _placed(capture, poses, warnings)
    sized: Sized | None = None
    posed = poses.apply(capture)
    if settings.scale is not None:
        sized = scale_by_marks(posed, parse_scale(settings.scale))
    elif settings.marker is not None:
        sized = scale_by_markers(posed, parse_marker(settings.marker), progress)
    source = MARKS if settings.scale is not None else MARKERS
    if placed is None:
        reference = None if estimated else _reference(capture)
        if sized is None:
            return Scaling(metric=poses.metric, georeference=reference, warnings=tuple(warnings))
        if not estimated:
            unit = "metres already" if capture.metric else "no known unit"
            warnings.append(f"the poses that came with the capture were in {unit}; all lengths were multiplied by {sized.metres:.6g}")
        if reference is not None:
            scale = Similarity(1 / sized.metres, np.eye(3), np.zeros(3))
            reference = replace(reference, enu_from_input=reference.enu_from_input.after(scale))
        move = Similarity(sized.metres, np.eye(3), np.zeros(3))
        return Scaling(move, True, reference, _facts(source, sized.metres, sized.error, sized.text), tuple(warnings))
    return _on_earth(placed, sized, source, poses, warnings)


def _on_earth(placed: Placed, sized: Sized | None, source: str, poses: PoseResult, warnings: list[str]) -> Scaling:
    """By GPS; lengths are those of `sized`, or of a depth camera, where there are such."""
    move, factor, error = placed.enu_from_centres, placed.enu_from_centres.scale, placed.scale_error
    count = len(poses.names)
    text = (
        f"the GPS of {placed.used} of {count} images places the scene at {placed.origin.latitude:.5f}°, {placed.origin.longitude:.5f}°; "
        f"cameras lie {placed.error:.2g} m from theirs, lengths are right to ±{100 * error:.2g}%, the vertical to ±{placed.turn_error:.2g}°"
    )
    if sized is not None:
        ratio = sized.metres / factor
        if abs(np.log(ratio)) > DIFFERS * np.hypot(error, sized.error):
            warnings.append(f"lengths by --{source} are {ratio:.4g} times those by GPS, more than both should be off; --{source} is used")
        # About the middle of the cameras, which stays where GPS has it.
        middle = move.points(poses.world_from_camera[:, :3, 3]).mean(axis=0)
        move = Similarity(ratio, np.eye(3), middle - ratio * middle).after(move)
        factor, error, text = sized.metres, sized.error, f"{sized.text}; {text.replace('lengths are', 'its lengths would be')}"
    elif poses.metric:  # a depth camera measures better than GPS
        ratio = 1 / factor
        middle = move.points(poses.world_from_camera[:, :3, 3]).mean(axis=0)
        move, factor = Similarity(ratio, np.eye(3), middle - ratio * middle).after(move), 1.0
    place = replace(placed.origin, source=GPS, error=placed.error)
    return Scaling(move, True, place, _facts(GPS if sized is None else source, factor, error, text), tuple(warnings))


def _facts(source: str, factor: float, error: float, text: str) -> dict[str, Any]:
    if not (0 < float(factor) < np.inf and 0 <= float(error) < np.inf):
        raise ValueError("a factor must be positive, its error at least 0")
    return dict(zip(FACTS, (str(source), float(factor), float(error), str(text)), strict=True))


def _placed(capture: Capture, poses: PoseResult, warnings: list[str]) -> Placed | None:
    """By the images' GPS, or a warning on why not."""
    by_name = {frame.name: frame for frame in capture.frames}
    places = gps_of_images(originals(capture, [by_name[name] for name in poses.names]))
    found = fit_gps(poses.world_from_camera[:, :3, 3], places)
    if isinstance(found, Placed):
        return found
    warnings.append(f"the images' GPS is not used: {found}")
    return None


def _reference(capture: Capture) -> Georeference | None:
    """Of a source that has one: its frame is east, north and up of that place."""
    values: Sequence[Any] | dict[str, Any] | None = capture.extra.get(REFERENCE)
    if isinstance(values, dict):
        values = [values.get(name) for name in ("latitude", "longitude", "altitude")]
    try:
        latitude, longitude, altitude = (float(value) for value in values or ())
        return Georeference(latitude, longitude, altitude, source="reference")
    except (TypeError, ValueError, InputError):
        return None
