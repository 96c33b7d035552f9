"""The first half of a run: capture → frames → poses → scene → key frames → views."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fieldfuse.errors import InputError
from fieldfuse.files import read_json, write_json
from fieldfuse.memory_limits import require_file
from fieldfuse.pipelines.job import Job
from fieldfuse.pipelines.source_state import pixel_state, source_state
from fieldfuse.steps import camera_poses, key_frames, needs_frames, prepared, read_capture, set_seeds, uses_given_poses, write_frames

if TYPE_CHECKING:
    from fieldfuse.capture.types import Capture, Frame, Views
    from fieldfuse.effects.correct import Corrections
    from fieldfuse.nerfusion.keyframes import KeyFrames
    from fieldfuse.poses.result import PoseResult
    from fieldfuse.poses.scene import Scene


def find_capture(job: Job) -> Capture:
    """Detect what the source is, read what it says, look at every picture once (at those that `choose_frames` writes, then)."""
    from fieldfuse.capture.photos import with_unposed
    from fieldfuse.capture.storage import capture_from_dict, capture_to_dict

    path = job.folder / "capture.json"
    masks = job.settings.capture.masks
    state = source_state(job.source, job.folder.path)

    def save(capture: Capture) -> list[Path]:
        write_json(path, capture_to_dict(capture))
        return [path]

    found = job.stages.run(
        "capture",
        make=lambda: read_capture(job.source, job.settings, job.progress),
        save=save,
        load=lambda: capture_from_dict(read_json(path)),
        uses=state if masks == "auto" else [state, masks],
    )
    return with_unposed(found) if job.settings.poses.source == "sfm" else found


def choose_frames(job: Job, capture: Capture) -> Capture:
    """Pictures of a video or a film, and JPEGs of HEIF and mirrored pictures; other captures pass as they are."""
    from fieldfuse.capture.storage import capture_from_dict, capture_to_dict

    if not needs_frames(capture):
        return capture
    folder = job.folder / "frames"
    path = folder / "capture.json"

    def make() -> Capture:
        set_seeds(job.settings.seed)
        return write_frames(capture, job.folder.path, job.settings, job.progress)

    def save(chosen: Capture) -> list[Path]:
        write_json(path, capture_to_dict(chosen))
        written = (file for frame in chosen.frames for file in (frame.image, frame.depth) if file is not None)
        return [*(file for file in written if file.is_relative_to(folder.resolve())), path]

    return job.stages.run(
        "frames",
        make=make,
        save=save,
        load=lambda: at_home(capture_from_dict(read_json(path)), folder),
        uses=job.settings.capture.max_frames if capture.filmed else pixel_state(capture),
        after=["capture"],
        in_place=True,
    )


def at_home(chosen: Capture, folder: Path) -> Capture:
    """The capture with what was written to a run's `frames` where that is now: the run's folder may have been moved."""
    from fieldfuse.capture.film import DEPTH

    def here(frame: Frame) -> Frame:
        if not (frame.image.parent.name == folder.name and (folder / frame.image.name).is_file()):
            return frame
        depth = frame.depth
        if depth is not None and depth.parent == frame.image.parent / DEPTH:
            depth = folder / DEPTH / depth.name
        return replace(frame, image=folder / frame.image.name, depth=depth)

    return chosen.with_frames([here(frame) for frame in chosen.frames])


def last_of(job: Job, *names: str) -> list[str]:
    """Those of the stages that this run has; `frames`, for one, exists only for videos and HEIF pictures."""
    return [name for name in names if name in job.stages.records]


def find_camera_poses(job: Job, capture: Capture) -> PoseResult:
    """Poses that the capture brings, as its images confirm them, or structure from motion."""
    from fieldfuse.poses.check_given import VERSION as CHECKED
    from fieldfuse.poses.job import VERSION
    from fieldfuse.poses.result import PoseResult

    settings = job.settings
    given = uses_given_poses(capture, settings)
    path = job.folder / "poses.json"

    def make() -> PoseResult:
        set_seeds(settings.seed)
        return camera_poses(capture, job.folder.path, settings, job.progress, job.features)

    def save(result: PoseResult) -> list[Path]:
        write_json(path, result.to_dict())
        return [path]

    uses: list[Any] = [given]
    if given:
        uses += [CHECKED, settings.poses.convention]  # the stages before know the files
    else:
        found = {name: value for name, value in asdict(settings.poses).items() if name != "convention"}
        uses += [VERSION, found, settings.seed, pixel_state(capture)]
    return job.stages.run(
        "poses",
        make=make,
        save=save,
        load=lambda: PoseResult.from_dict(read_json(path)),
        uses=uses,
        after=last_of(job, "capture", "frames"),
        in_place=True,
        rounded=True,
    )


def measure_scene(job: Job, posed: Capture) -> Scene:
    """Working frame, region of interest, depth range."""
    from fieldfuse.poses.scene import Scene, describe_scene

    path = job.folder / "scene.json"

    def save(scene: Scene) -> list[Path]:
        write_json(path, scene.to_dict())
        return [path]

    def make() -> Scene:
        set_seeds(job.settings.seed)
        return describe_scene(posed, job.progress, job.features)

    uses = limit_of(job)
    after = last_of(job, "poses", "effects")
    scene = job.stages.run("scene", make=make, save=save, load=lambda: Scene.from_dict(read_json(path)), uses=uses, after=after)
    job.features.clear()
    return scene


def limit_of(job: Job) -> list[int] | None:
    """What decides which pictures take part at all."""
    limit = job.settings.views.limit
    return None if limit is None else [limit, job.settings.capture.holdout]


def choose_keyframes(job: Job, scene: Scene, views: Views) -> KeyFrames:
    """Key frames among the training views and their neighbours, as indices into the training views; the file has their names."""
    import numpy as np

    from fieldfuse.nerfusion.keyframes import KeyFrames

    if job.keys is not None:
        return job.keys
    path = job.folder / "keyframes.json"
    names = [views.names[int(index)] for index in np.flatnonzero(~np.asarray(views.test))]

    def save(keys: KeyFrames) -> list[Path]:
        chosen = [names[int(index)] for index in keys.indices]
        write_json(path, {"keyframes": chosen, "neighbours": [[names[int(index)] for index in row] for row in keys.neighbours]})
        return [path]

    def load() -> KeyFrames:
        data, place = read_json(path), {name: index for index, name in enumerate(names)}
        try:
            neighbours = [[place[name] for name in row] for row in data["neighbours"]]
            return KeyFrames.from_dict({"indices": [place[name] for name in data["keyframes"]], "neighbours": neighbours})
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{path} does not fit the views of this run; remove it and run the command again") from error

    job.keys = job.stages.run(
        "keyframes",
        make=lambda: key_frames(views, scene, job.settings),
        save=save,
        load=load,
        uses=asdict(job.settings.keyframes),
        after=["scene", "views"],
        version=2,
    )
    return job.keys


def make_views(job: Job, posed: Capture, scene: Scene, corrections: Corrections | None = None) -> Views:
    """Pictures undistorted and resized once, in the working frame, test views marked, with `corrections` of colour."""
    from fieldfuse.capture.storage import load_views, save_views

    path = job.folder / "views.safetensors"

    def save(views: Views) -> list[Path]:
        save_views(path, views)
        return [path]

    settings = job.settings.capture

    def load() -> Views:
        require_file(path, f"the prepared pictures of {posed.root}")
        return load_views(path)

    return job.stages.run(
        "views",
        make=lambda: prepared(posed, scene, job.settings, job.progress, corrections),
        save=save,
        load=load,
        uses=[settings.image_size, settings.holdout, limit_of(job), pixel_state(posed)],
        after=last_of(job, "poses", "effects", "scene"),
    )
