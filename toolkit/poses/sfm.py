"""Poses from the images alone. This side talks to the child process (`worker.py`) that runs pycolmap."""

from __future__ import annotations

import os
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fieldfuse import errors, memory
from fieldfuse.camera import Intrinsics
from fieldfuse.capture.archive import read_bytes
from fieldfuse.capture.headers import read_header
from fieldfuse.capture.prepare import target_size
from fieldfuse.capture.types import Capture
from fieldfuse.config import PosesSettings
from fieldfuse.errors import FieldfuseError, InputError, PoseError
from fieldfuse.files import read_json, remove
from fieldfuse.poses.child import run_child
from fieldfuse.poses.health import doubts, failure, fold, shortfalls, standing
from fieldfuse.poses.job import GONE_FAR, GONE_ON, IN_PARTS, PART, SIFT, STRICT, XFEAT, Job, plan
from fieldfuse.poses.result import SFM, PoseResult, scale_to_depth
from fieldfuse.progress import SILENT, Progress

WORKER = "fieldfuse.poses.worker"
SIFT_BYTES = 240  # that OpenCV takes for a pixel of an image in which it looks for features, whatever the image's size
MAX_RESULT_BYTES = 2 * 2**30


def find_poses(
    capture: Capture,
    out: Path,
    settings: PosesSettings | None = None,
    seed: int = 0,
    threads: int | None = None,
    progress: Progress = SILENT,
    address: str | None = None,
) -> PoseResult:
    """Structure from motion over the capture's images; poses and intrinsics that it brings are not used.

    COLMAP's database, log and model stay in `out/sparse`; features and matches there are used again when the images and
    settings are the same. With the same seed the result repeats; up to `job.REPEATABLE` images that of the incremental
    mapper does bit for bit, whatever the threads. A capture with depth maps gets the depth's scale.

    Args:
        address: of a Ray cluster that finds features and matches where these are many: "auto" or HOST:PORT.

    Raises:
        PoseError: no usable poses, and why; or the child process crashed.
        InputError: an image cannot be read, there is too little memory, or the cluster cannot be used.
        Interrupted: the user asked to stop.
    """
    settings = settings or PosesSettings()
    if len(capture.frames) < 2:
        raise PoseError(
            f"{capture.root}: {len(capture.frames)} picture is not enough to find poses, at least 3 from different "
            f"places are needed; add photos that overlap"
        )
    wanted = max(1, threads or os.cpu_count() or 1)
    pixels = _pixels(capture, settings.image_size)
    workers = memory.workers(
        wanted, SIFT_BYTES * pixels, f"finding features in {pixels / 1e6:.1f} million pixels", "lower poses.image_size"
    )
    first, second, notes = _features(settings.features)
    job = plan(capture, Path(out).resolve() / "sparse", settings, seed, workers, first, second)
    job = replace(job, address=address, feature_bytes=SIFT_BYTES * pixels)
    seconds: dict[str, float] = {}
    began = time.monotonic()
    facts = _run(job, seconds, progress)
    reason = failure(facts)
    if reason is not None:
        raise PoseError(f"{capture.root}: {'; '.join([reason, *standing(facts)])}")
    result = _result(capture, job, facts)
    result.warnings += notes
    if capture.has_depth:
        result = scale_to_depth(result, capture)
    result.seconds = {**seconds, "total": time.monotonic() - began}
    return result


def _features(wanted: str) -> tuple[str, str | None, list[str]]:
    """The features to begin with, those to try where these are not enough, and warnings; an InputError where learned ones are wanted and
    not there."""
    if wanted == SIFT:
        return SIFT, None, []
    from fieldfuse.poses import xfeat

    try:
        network = xfeat.installed()
    except InputError as error:
        if wanted == XFEAT:
            raise
        return SIFT, None, [f"learned features were not tried: {error}"]
    if wanted == XFEAT:
        if network is None:
            raise InputError(f"poses.features=xfeat needs weights that are not installed; {xfeat.INSTALL}, or choose poses.features=auto")
        return XFEAT, None, []
    return SIFT, None if network is None else XFEAT, []


def _pixels(capture: Capture, long_side: int) -> int:
    """Of the first image, as it is looked at for features."""
    frame = capture.frames[0]
    if frame.video_index is not None:
        width, height = int(capture.extra.get("width") or long_side), int(capture.extra.get("height") or long_side)
    else:
        header = read_header(read_bytes(frame.image), frame.image)
        width, height = header.width, header.height
    width, height = target_size(max(1, width), max(1, height), long_side)
    return width * height


def _run(job: Job, seconds: dict[str, float], progress: Progress) -> dict[str, Any]:
    """The facts that the child leaves, and the seconds of its steps."""
    folder = Path(job.folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        remove(job.log)
    except OSError as error:
        raise errors.OutputError(f"cannot write {folder}: {error.strerror or error}; free space or choose another --out folder") from error
    remove(job.result)
    job.save(folder / "job.json")
    refusals: list[FieldfuseError] = []

    def hear(message: dict[str, Any]) -> None:
        event = message.get("event")
        if event == "progress":
            progress.update(float(message["done"]), float(message["total"]), str(message["note"]))
        elif event == "step":
            seconds[str(message["name"])] = float(message["seconds"])
        elif event == "error":
            kind = getattr(errors, str(message["kind"]), PoseError)
            refusals.append(kind(str(message["message"])))

    # BLAS and OpenMP start a thread a core each by default; COLMAP's own threads are set by the worker.
    counts = {name: str(job.threads) for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}
    run_child(WORKER, [str(folder / "job.json")], job.log, hear, progress, counts)
    if refusals:
        raise refusals[0]
    try:
        facts: dict[str, Any] = read_json(job.result, max_bytes=MAX_RESULT_BYTES)
    except InputError as error:
        raise PoseError(f"the process that finds poses left no result; see {job.log}") from error
    return facts


def _result(capture: Capture, job: Job, facts: dict[str, Any]) -> PoseResult:
    model = facts["model"]
    names = [image.name for image in job.images]
    placed = [names[i] for i in model["pictures"]]
    known = set(placed)
    sizes = next(attempt["models"] for attempt in facts["attempts"] if attempt["attempt"] == model["attempt"])
    warnings = [*standing(facts), *shortfalls(facts), *doubts(facts), *fold(facts, job.sequential)]
    tried = facts["attempts"]
    if tried[0]["attempt"] == IN_PARTS:
        whole = any(attempt["attempt"] == STRICT for attempt in tried)
        parts = f"parts of {PART} images were mapped side by side on one machine"
        warnings.append(
            f"{parts}, and left too many without a place: all were mapped in one piece" if whole else f"{parts} and put together"
        )
        tried = tried[1:] if whole else tried
    strict = max(tried[0]["models"], default=0)
    if model["attempt"] in (GONE_ON, GONE_FAR):
        warnings.append(f"{len(placed) - strict} of {len(placed)} frames were placed by fewer matches and smaller angles than the others")
    elif model["attempt"] != tried[0]["attempt"]:
        warnings.append(
            f"poses come from a fallback ({model['attempt']} mapping), the strict attempt registered {strict} of {len(names)} frames"
        )
    return PoseResult(
        source=SFM,
        registered=len(placed),
        total=len(capture.frames),
        names=placed,
        intrinsics=[replace(Intrinsics.from_dict(camera)) for camera in model["intrinsics"]],
        world_from_camera=np.array(model["world_from_camera"], dtype=np.float64),
        models=[int(size) for size in sizes],
        missing=[name for name in names if name not in known],
        points=np.array(model["points"], dtype=np.float64).reshape(-1, 3),
        point_errors=np.array(model["point_errors"], dtype=np.float64),
        warnings=warnings,
    )
