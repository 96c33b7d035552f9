"""Rendering a field along a path of cameras, into a video or a folder of pictures."""

from __future__ import annotations

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
from fieldfuse.errors import InputError
from fieldfuse.files import read_json, remove
from fieldfuse.memory import require_pictures
from fieldfuse.pipelines.console import make_progress
from fieldfuse.pipelines.fields import finished_field
from fieldfuse.pipelines.job import Job, open_job
from fieldfuse.pipelines.pictures import Camera, camera_of, orbit_cameras, pictures
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


def render_run(place: Place, path: CameraPath, options: dict[str, Any], baked: bool, quiet: bool) -> dict[str, Any]:
    """Render what is asked for; the field of a run's folder is taken as it is.

    Returns:
        how many `pictures` of which `width` and `height`, the `seconds` it took, the path `to`, and how many `others` lie there besides.

    Raises:
        InputError: an unknown path of cameras, cameras that cannot be used, a folder without a field and without its source.
        OutputError: the result cannot be written.
    """
    views, cameras, to = path.views, path.cameras, path.to
    if views not in ("orbit", "test"):
        raise InputError(f"--views is {views!r}; it must be orbit or test")
    if to is not None and to.suffix and to.suffix.lower() not in VIDEO:
        raise InputError(f"--to {to} must be an .mp4 file or a folder")
    given = read_cameras(cameras) if cameras is not None else None
    with open_job(place, options, make_progress(quiet), (*BEFORE, "field")) as job:
        prepared = prepare(job)
        scene, ready = prepared.scene, prepared.views
        field = finished_field(job, prepared).field
        if given is not None:
            names, lenses, poses = given[0], given[1], scene.working_from_input.poses(given[2])
        elif views == "test":
            names, lenses, poses = test_cameras(ready)
        else:
            names, lenses, poses = orbit_cameras(ready, scene, path.frames)
        lenses = [sized(lens, path.image_size) for lens in lenses]
        own = job.folder / "renders" / (
            "orbit.mp4" if given is None and views == "orbit" else "cameras" if given is not None else "test"
        )
        target = to or own
        require_pictures(lenses, kept=False)
        start = time.monotonic()
        job.progress.begin("render")
        others = write(job, camera_of(job, field, ready, scene, baked), names, lenses, poses, target, path.fps, alone=to is None)
        seconds = time.monotonic() - start
        job.progress.finish("render", seconds, False)
    size = {"width": lenses[0].width, "height": lenses[0].height}
    return {"pictures": len(names), **size, "seconds": round(seconds, 3), "to": str(target), "others": others}


def write(
    job: Job, camera: Camera, names: list[str], lenses: list[Intrinsics], poses: Array, to: Path, fps: float, alone: bool = False
) -> int:
    """Render every camera and write it as it comes.

    Args:
        alone: the pictures take the place of those that an earlier command left in the folder, when all are rendered.

    Returns:
        how many other pictures lie in the folder.
    """
    frames = pictures(camera, lenses, poses, job.progress)
    if to.suffix.lower() in VIDEO:
        from fieldfuse.export.video import write_video

        if len({(lens.width, lens.height) for lens in lenses}) > 1:
            raise InputError("a video needs pictures of one size and these cameras differ; give a folder with --to, or --image-size")
        write_video(to, frames, fps)
        return 0
    with _replacing(to) if alone else nullcontext(to) as folder:
        written = {
            write_png(folder / f"{index:04d}_{file_name(Path(name).stem)}.png", frame).name
            for index, (name, frame) in enumerate(zip(names, frames, strict=True))
        }
    return sum(path.name not in written for path in to.glob("*.png"))


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
    """Cameras of a `transforms.json` (OpenGL axes, as nerfstudio and instant-ngp write it); its pictures need not exist.

    Raises:
        InputError: not such a file, no camera, or an unusable one.
    """
    data = read_json(path)
    frames = data.get("frames") if isinstance(data, dict) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise InputError(f"{path} lists no cameras; it must have `frames`, each with a `transform_matrix`, as a transforms.json has")
    if len(frames) > MAX_CAMERAS:
        raise InputError(f"{path} lists {len(frames)} cameras, more than the {MAX_CAMERAS} that are rendered; split it")
    names, lenses, poses = [], [], []
    for index, frame in enumerate(frames):
        where = f"{path}, camera {index}"
        names.append(str(frame.get("file_path", f"camera_{index:04d}")))
        poses.append(nerf_json.pose(frame, where))
        lenses.append(nerf_json.camera(data, frame, (0, 0), where).pinhole())
    return names, lenses, np.array(poses)
