"""The first half of a run: capture → frames → poses → effects → scene → views → key frames."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from fieldfuse import steps
from fieldfuse.capture.photos import with_unposed
from fieldfuse.capture.prepare import limited
from fieldfuse.capture.sphere import SIDE, to_cut
from fieldfuse.capture.storage import PATHS, capture_from_dict, capture_to_dict, load_views, save_views
from fieldfuse.capture.types import Capture, Frame, Views
from fieldfuse.capture.unpack import SUFFIX, UNPACKED
from fieldfuse.effects.correct import Corrections
from fieldfuse.errors import InputError
from fieldfuse.files import read_json, write_json
from fieldfuse.memory import require_file
from fieldfuse.nerfusion.keyframes import KeyFrames
from fieldfuse.pipelines.job import Job
from fieldfuse.pipelines.schemas import Effects, read_checked
from fieldfuse.pipelines.source import pixel_state, source_state
from fieldfuse.pipelines.stages import InPlaceStage, Stage
from fieldfuse.poses import scaling
from fieldfuse.poses.check_given import VERSION as CHECKED
from fieldfuse.poses.job import VERSION
from fieldfuse.poses.points import Features
from fieldfuse.poses.result import SFM, PoseResult
from fieldfuse.poses.scaling import Scaling, wanted
from fieldfuse.poses.scene import Scene, describe_scene

EFFECTS_FILE = "effects.json"


@dataclass(frozen=True)
class Prepared:
    """What every result stands on.

    Attributes:
        capture: as it was read, with the frames that were chosen. posed: its frames that take part, with poses and lenses as they are used.
        poses: with what was refined. corrections: of camera and light.
        views: images, pinhole cameras and masks in the working frame of `scene`. keys: among the training views.
    """

    capture: Capture
    poses: PoseResult
    posed: Capture
    corrections: Corrections
    scene: Scene
    views: Views
    keys: KeyFrames

    @property
    def training(self) -> Views:
        """The views that are fitted to."""
        return self.views.subset(np.flatnonzero(~self.views.test))


def prepare(job: Job, capture: Capture | None = None) -> Prepared:
    """Everything up to the views; `capture`: from `find_capture`, where that was called before."""
    features: dict[str, Features] = {}  # of images by name, as they are extracted on the way
    capture = choose_frames(job, find_capture(job) if capture is None else capture)
    capture, poses = find_scaling(job, capture, find_camera_poses(job, capture, features))
    posed = limited(poses.apply(capture), job.settings.capture.holdout, job.settings.views.limit)
    corrections = find_effects(job, posed)
    poses, posed = steps.refined(poses, corrections), corrections.on_capture(posed)
    scene = measure_scene(job, posed, features)
    del features
    views = make_views(job, posed, scene, corrections)
    return Prepared(capture, poses, posed, corrections, scene, views, choose_keyframes(job, scene, views))


def find_capture(job: Job) -> Capture:
    """Detect what the source is, read it, look at every image once (at those that `choose_frames` writes, then)."""
    path = job.folder / "capture.json"
    masks, light, projection = job.settings.capture.masks, job.settings.capture.light, job.settings.capture.projection
    state = source_state(job.source, job.folder.path)
    given = [masks] if masks != "auto" else []
    given += [f"{name} {value}" for name, value in (("light", light), ("projection", projection)) if value != "auto"]
    given += [] if job.settings.capture.depth_scale is None else [f"depth_scale {job.settings.capture.depth_scale}"]
    found = job.run(
        Stage(
            "capture",
            make=lambda: steps.read_capture(job.source, job.folder.path, job.settings, job.progress),
            save=lambda capture: [*_files_below(job.folder / UNPACKED), _written(path, capture_to_dict(capture))],
            load=lambda: in_run(capture_from_dict(read_json(path)), job),
            settings=[state, *given] if given else state,
        )
    )
    return with_unposed(found) if job.settings.poses.source == "sfm" else found


def _written(path: Path, data: Any) -> Path:
    write_json(path, data)
    return path


def _files_below(folder: Path) -> list[Path]:
    return [path for path in sorted(folder.rglob("*")) if path.is_file()]


def in_run(capture: Capture, job: Job) -> Capture:
    """The capture of a zip file where its files are now: the run's folder, in which they were unpacked, may have been moved."""
    if job.source.suffix.lower() != SUFFIX or UNPACKED not in capture.root.parts or capture.root.is_relative_to(job.folder / UNPACKED):
        return capture
    at = max(index for index, part in enumerate(capture.root.parts) if part == UNPACKED)
    before, now = Path(*capture.root.parts[: at + 1]), job.folder / UNPACKED

    def here(path: Path) -> Path:
        return now / path.relative_to(before) if path.is_relative_to(before) else path

    def moved(frame: Frame) -> Frame:
        paths: dict[str, Any] = {name: here(path) for name in PATHS if (path := getattr(frame, name)) is not None}
        return replace(frame, **paths)

    return replace(capture, root=here(capture.root), frames=tuple(map(moved, capture.frames)))


def choose_frames(job: Job, capture: Capture) -> Capture:
    """Images of a video or a film, and JPEGs of HEIF and mirrored images; other captures pass as they are."""
    if not steps.needs_frames(capture):
        return capture
    folder = job.folder / "frames"
    path = folder / "capture.json"

    depends: Any = job.settings.capture.max_frames if capture.filmed else pixel_state(capture)
    if to_cut(capture) and (job.settings.capture.image_size or 0) > SIDE:
        depends = [depends, job.settings.capture.image_size]

    def make() -> Capture:
        steps.set_seeds(job.settings.seed)
        return steps.write_frames(capture, job.folder.path, job.settings, job.progress)

    def save(chosen: Capture) -> list[Path]:
        files = [file for frame in chosen.frames for file in (frame.image, frame.depth, frame.mask) if file is not None]
        return [*(file for file in files if file.is_relative_to(folder.resolve())), _written(path, capture_to_dict(chosen))]

    return job.run(
        InPlaceStage(
            "frames",
            make=make,
            save=save,
            load=lambda: in_folder(in_run(capture_from_dict(read_json(path)), job), folder),
            inputs=["capture"],
            settings=depends,
        )
    )


def in_folder(chosen: Capture, folder: Path) -> Capture:
    """The capture with what was written to a run's `frames` where that is now: the run's folder may have been moved."""
    def here(frame: Frame) -> Frame:
        before = frame.image.parent.parent if frame.instant else frame.image.parent  # the run's `frames`, where that was
        if before.name != folder.name or not (folder / frame.image.relative_to(before)).is_file():
            return frame

        def moved(path: Path | None) -> Path | None:
            return folder / path.relative_to(before) if path is not None and path.is_relative_to(before) else path

        return replace(frame, image=folder / frame.image.relative_to(before), depth=moved(frame.depth), mask=moved(frame.mask))

    return chosen.with_frames([here(frame) for frame in chosen.frames])


def find_camera_poses(job: Job, capture: Capture, features: dict[str, Features] | None = None) -> PoseResult:
    """Poses that the capture brings, as its images confirm them, or structure from motion; `features` gets those of images by name."""
    settings, path = job.settings, job.folder / "poses.json"
    given = steps.uses_given_poses(capture, settings)

    def make() -> PoseResult:
        steps.set_seeds(settings.seed)
        return steps.camera_poses(capture, job.folder.path, settings, job.progress, features)

    depends: list[Any] = [given]
    if given:
        depends += [CHECKED, settings.poses.convention]  # the files are in the stages before
    else:
        besides = ("convention", "scale", "marker", "gps")  # which change nothing of what is found here
        found = {name: value for name, value in asdict(settings.poses).items() if name not in besides}
        depends += [VERSION, found, settings.seed, pixel_state(capture)]
    return job.run(
        InPlaceStage(
            "poses",
            make=make,
            save=lambda result: [_written(path, result.to_dict())],
            load=lambda: PoseResult.from_dict(read_json(path)),
            inputs=job.stages.done("capture", "frames"),
            settings=depends,
        )
    )


def find_scaling(job: Job, capture: Capture, poses: PoseResult) -> tuple[Capture, PoseResult]:
    """Capture and poses in metres, and placed on earth, where measured distances, markers or the images' GPS allow it."""
    settings, path = job.settings.poses, job.folder / "scaling.json"
    scene = job.stages.record("scene")
    if scene is not None and "scene" in job.stages.trusted and scene.after.get("poses") == job.stages.records["poses"].made:
        there = "scaling" in scene.after  # what the folder's results stand on, whatever images and settings are now
    else:
        there = wanted(capture, settings, poses.source == SFM)
    if not there:
        return capture, poses
    found = job.run(
        Stage(
            "scaling",
            make=lambda: scaling.find_scaling(capture, poses, settings, job.progress),
            save=lambda found: [_written(path, found.to_dict())],
            load=lambda: Scaling.from_dict(read_json(path)),
            inputs=["poses"],
            settings=[settings.scale, settings.marker, settings.gps, pixel_state(capture)],
        )
    )
    return found.apply(capture, poses)


def find_effects(job: Job, posed: Capture) -> Corrections:
    """What is to be corrected; `effects.json` holds the evidence, the decisions and their seconds. With `effects: off` nothing is read."""
    settings, path = job.settings, job.folder / EFFECTS_FILE
    if not steps.looks_for_effects(settings) or _did_without(job):
        return Corrections()

    def make() -> dict[str, Any]:
        steps.set_seeds(settings.seed)
        return steps.find_effects(posed, settings, job.progress)

    data = job.run(
        Stage(
            "effects",
            make=make,
            save=lambda data: [_written(path, data)],
            load=partial(read_checked, path, Effects),
            inputs=job.stages.done("poses", "scaling"),
            settings=[asdict(settings.effects), settings.capture.holdout, [frame.name for frame in posed.frames], pixel_state(posed)],
            version=4,
        )
    )
    return steps.apply_effects(data, settings)


def _did_without(job: Job) -> bool:
    """Whether the folder's results were made without looking for effects, by settings that were not kept: a total budget may leave no time
    for it. Work on it goes on from there."""
    scene = job.stages.record("scene")
    return scene is not None and "effects" not in scene.after and "scene" in job.stages.trusted and job.stages.usable("scene")


def measure_scene(job: Job, posed: Capture, features: dict[str, Features] | None = None) -> Scene:
    """Working frame, region of interest, depth range; `features`: of images by name, as far as they are known."""
    path = job.folder / "scene.json"

    def make() -> Scene:
        steps.set_seeds(job.settings.seed)
        return describe_scene(posed, job.progress, features)

    return job.run(
        Stage(
            "scene",
            make=make,
            save=lambda scene: [_written(path, scene.to_dict())],
            load=lambda: Scene.from_dict(read_json(path)),
            inputs=job.stages.done("poses", "scaling", "effects"),
            settings=limit_of(job),
        )
    )


def limit_of(job: Job) -> list[int] | None:
    """What decides which images take part at all."""
    limit = job.settings.views.limit
    return None if limit is None else [limit, job.settings.capture.holdout]


def make_views(job: Job, posed: Capture, scene: Scene, corrections: Corrections | None = None) -> Views:
    """Images undistorted and resized once, in the working frame, test views marked, with `corrections` of colour."""
    path, settings = job.folder / "views.safetensors", job.settings.capture

    def save(views: Views) -> list[Path]:
        save_views(path, views)
        return [path]

    def load() -> Views:
        require_file(path, f"the prepared pictures of {posed.root}")
        return load_views(path)

    return job.run(
        Stage(
            "views",
            make=lambda: steps.prepared(posed, scene, job.settings, job.progress, corrections),
            save=save,
            load=load,
            inputs=job.stages.done("poses", "scaling", "effects", "scene"),
            settings=[settings.image_size, settings.holdout, limit_of(job), pixel_state(posed)],
        )
    )


def choose_keyframes(job: Job, scene: Scene, views: Views) -> KeyFrames:
    """Key frames among the training views and their neighbours, as indices into the training views; the file has their names."""
    path = job.folder / "keyframes.json"
    names = [views.names[int(index)] for index in np.flatnonzero(~np.asarray(views.test))]

    def save(keys: KeyFrames) -> list[Path]:
        chosen = [names[int(index)] for index in keys.indices]
        return [_written(path, {"keyframes": chosen, "neighbours": [[names[int(index)] for index in row] for row in keys.neighbours]})]

    def load() -> KeyFrames:
        data, place = read_json(path), {name: index for index, name in enumerate(names)}
        try:
            neighbours = [[place[name] for name in row] for row in data["neighbours"]]
            return KeyFrames.from_dict({"indices": [place[name] for name in data["keyframes"]], "neighbours": neighbours})
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{path} does not fit the views of this run; remove it and run the command again") from error

    return job.run(
        Stage(
            "keyframes",
            make=lambda: steps.key_frames(views, scene, job.settings),
            save=save,
            load=load,
            inputs=["scene", "views"],
            settings=asdict(job.settings.keyframes),
            version=2,
        )
    )
