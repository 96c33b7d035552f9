"""Rendering a field along a path of cameras, into a video or a folder of pictures."""

from __future__ import annotations

import math
import os
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.capture import nerf_json
from fieldfuse.capture.calibration import usable_size
from fieldfuse.capture.listing import number, numbers
from fieldfuse.errors import InputError
from fieldfuse.files import read_json, remove
from fieldfuse.memory import require_pictures
from fieldfuse.pipelines.console import make_progress
from fieldfuse.pipelines.fields import finished_field
from fieldfuse.pipelines.job import open_job
from fieldfuse.pipelines.pictures import camera_of, orbit_cameras, pictures
from fieldfuse.pipelines.prepare import prepare
from fieldfuse.pipelines.rendered import file_name, write_png
from fieldfuse.pipelines.stages import BEFORE

if TYPE_CHECKING:
    from fieldfuse.capture.types import Views
    from fieldfuse.pipelines.options import Place
    from fieldfuse.pipelines.render import CameraPath

VIDEO = (".mp4",)
NUMBERED = re.compile(r"\d{4,}_.*\.png")
MAX_CAMERAS = 100_000
PATH = "camera_path"  # the key of nerfstudio's camera paths
FPS, MOST_FPS = 30.0, 1000


def render_run(place: Place, path: CameraPath, options: dict[str, Any], baked: bool, quiet: bool) -> dict[str, Any]:
    """Render along a path of cameras; the field of a run's folder is taken as it is.

    Returns:
        how many `pictures` of which `width` and `height`, the `seconds` it took, the path `to`, and how many `others` lie there besides.

    Raises:
        InputError: an unknown path of cameras, cameras that cannot be used, a folder without a field and without its source.
        OutputError: the result cannot be written.
    """
    if path.views not in ("orbit", "test"):
        raise InputError(f"--views is {path.views!r}; it must be orbit or test")
    if path.to is not None and path.to.suffix and path.to.suffix.lower() not in VIDEO:
        raise InputError(f"--to {path.to} must be an .mp4 file or a folder")
    given, own_fps = (read_cameras(path.cameras), path_fps(path.cameras)) if path.cameras is not None else (None, None)
    fps = next(value for value in (path.fps, own_fps, FPS) if value is not None)
    if not 1 <= fps <= MOST_FPS:
        raise InputError(f"{path.cameras}: 'fps' is {fps:g}, it must lie between 1 and {MOST_FPS}; correct it, or give --fps")
    with open_job(place, options, make_progress(quiet), (*BEFORE, "field")) as job:
        ready = prepare(job)
        scene, views, field = ready.scene, ready.views, finished_field(job, ready).field
        if given is not None:
            own, (names, lenses, poses) = "cameras" if own_fps is None else "path.mp4", given
            poses = scene.working_from_input.poses(poses)
        elif path.views == "test":
            own, (names, lenses, poses) = "test", test_cameras(views)
        else:
            own, (names, lenses, poses) = "orbit.mp4", orbit_cameras(views, scene, path.frames)
        lenses = [sized(lens, path.image_size) for lens in lenses]
        target = path.to or job.folder / "renders" / own
        require_pictures(lenses, kept=False)
        start = time.monotonic()
        job.progress.begin("render")
        frames = pictures(camera_of(job, field, views, scene, baked), lenses, poses, job.progress)
        others = 0
        if target.suffix.lower() in VIDEO:
            from fieldfuse.export.video import write_video

            if len({(lens.width, lens.height) for lens in lenses}) > 1:
                raise InputError("a video needs pictures of one size and these cameras differ; give a folder with --to, or --image-size")
            write_video(target, frames, fps)
        else:
            # The command's own folder: its pictures take the place of those that an earlier command left there, when all are rendered.
            with _replacing(target) if path.to is None else nullcontext(target) as folder:
                stems = (f"{index:04d}_{file_name(Path(name).stem)}" for index, name in enumerate(names))
                written = {write_png(folder / f"{stem}.png", frame).name for stem, frame in zip(stems, frames, strict=True)}
            others = sum(found.name not in written for found in target.glob("*.png"))
        seconds = time.monotonic() - start
        job.progress.finish("render", seconds, False)
    size = {"width": lenses[0].width, "height": lenses[0].height}
    return {"pictures": len(names), **size, "seconds": round(seconds, 3), "to": str(target), "others": others}


@contextmanager
def _replacing(place: Path) -> Iterator[Path]:
    """A folder beside `place`, whose pictures take the place of the numbered ones there at the end; whatever else is there stays."""
    temporary = place.with_name(f".tmp-{os.getpid()}-{place.name}")
    try:
        yield temporary
        place.mkdir(parents=True, exist_ok=True)
        for path in place.iterdir():
            if NUMBERED.fullmatch(path.name):
                remove(path)
        for path in temporary.iterdir():
            path.replace(place / path.name)
    finally:
        remove(temporary)


def sized(lens: Intrinsics, long_side: int | None) -> Intrinsics:
    """The camera for pictures with this long side, pinhole."""
    lens = lens.pinhole()
    if long_side is None:
        return lens
    factor = long_side / max(lens.width, lens.height)
    return lens.scaled(max(1, round(lens.width * factor)), max(1, round(lens.height * factor)))


def test_cameras(views: Views) -> tuple[list[str], list[Intrinsics], Array]:
    """The held-out views.

    Raises:
        InputError: there is none.
    """
    indices = np.flatnonzero(views.test)
    if len(indices) == 0:
        raise InputError("this run has no held-out views to render; use --views orbit, or run again with --holdout 8")
    return [views.names[i] for i in indices], [views.intrinsics[i] for i in indices], views.world_from_camera[indices]


def read_cameras(path: Path) -> tuple[list[str], list[Intrinsics], Array]:
    """Cameras of a `transforms.json` (as nerfstudio and instant-ngp write it; its pictures need not exist), or of a camera path as
    nerfstudio's viewer and `field.html` write it. Poses have OpenGL axes in the file, and are in the capture's frame.

    Raises:
        InputError: neither of them, no camera, or an unusable one.
    """
    data = read_json(path)
    kind = PATH if isinstance(data, dict) and PATH in data else "frames"
    frames = data.get(kind) if isinstance(data, dict) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise InputError(
            f"{path} lists no cameras; it must have `frames`, each with a `transform_matrix`, as a transforms.json has, "
            f"or a `{PATH}` with a `camera_to_world` each"
        )
    if len(frames) > MAX_CAMERAS:
        raise InputError(f"{path} lists {len(frames)} cameras, more than the {MAX_CAMERAS} that are rendered; split it")
    names, lenses, poses = [], [], []
    for index, frame in enumerate(frames):
        where = f"{path}, camera {index}"
        names.append(str(frame.get("file_path", f"camera_{index:04d}")))
        if kind == PATH:
            lenses.append(_path_lens(data, frame, where))
            frame = {"transform_matrix": numbers(frame.get("camera_to_world"), f"{where}: 'camera_to_world'", 16).reshape(4, 4)}
        else:
            lenses.append(nerf_json.camera(data, frame, (0, 0), where).pinhole())
        poses.append(nerf_json.pose(frame, where))
    return names, lenses, np.array(poses)


def _path_lens(data: dict[str, Any], frame: dict[str, Any], where: str) -> Intrinsics:
    """Of a camera path: `fov` is the vertical angle in degrees, the principal point is in the middle."""
    if data.get("camera_type") not in (None, "perspective"):
        raise InputError(f"{where}: a path of {str(data['camera_type'])[:40]!r} cameras cannot be rendered; make it with perspective ones")
    width, height, fov = (number(*one, where) for one in ((data, "render_width"), (data, "render_height"), (frame, "fov")))
    if width is None or height is None or fov is None:
        raise InputError(f"{where}: 'render_width', 'render_height' and its 'fov' must be given; write the path again")
    if not 0 < fov < 180:
        raise InputError(f"{where}: 'fov' is {fov:g}, it must lie between 0 and 180 degrees; correct it")
    across, down = usable_size(width, height, where)
    focal = 0.5 * down / math.tan(math.radians(fov) / 2)
    return Intrinsics(across, down, focal, focal, across / 2, down / 2).checked(where)


def path_fps(path: Path) -> float | None:
    """Pictures a second of a camera path; None where the file names none, or is a transforms.json."""
    data = read_json(path)
    return number(data, "fps", str(path)) if isinstance(data, dict) and PATH in data else None
