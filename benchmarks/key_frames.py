"""`python -m benchmarks.key_frames`: how many key frames a second the networks fuse on this machine.

They are of a walk through a made-up room, drawn anew, so that no data is needed.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import torch
import typer

from benchmarks.experiment import Experiment, Folder, Row, application, markdown, program, section, show
from fieldfuse.camera import Array, Intrinsics
from fieldfuse.capture.types import Views
from fieldfuse.config import KeyframesSettings
from fieldfuse.errors import InputError
from fieldfuse.nerfusion.extras.keyframe_depth import overlapping
from fieldfuse.nerfusion.fusion import FusionOptions, fuse_views
from fieldfuse.nerfusion.keyframes import KeyFrames, select_keyframes
from fieldfuse.nerfusion.lattice import Lattice
from fieldfuse.nerfusion.model import NerfusionModel
from fieldfuse.nerfusion.training.procedural import hand_held
from fieldfuse.nerfusion.weights import SHIPPED, load_model
from fieldfuse.pipelines.console import make_progress
from fieldfuse.pipelines.job import set_threads
from fieldfuse.pipelines.options import Device, Quiet, Seed, Threads
from fieldfuse.progress import SILENT, Progress
from fieldfuse.simulate.materials import texture_bank
from fieldfuse.simulate.procedural import random_scene
from fieldfuse.simulate.scene import Scene
from fieldfuse.steps import choose_device
from fieldfuse.volume.space import Space

EVERY = 2  # frames to a key frame: a key frame's neighbours are others' as well, as in a video
WALKS = 20  # tries to find a clear one
FOCAL = 0.82  # of the picture's width
TEXTURE = 256  # pixels of the bank's sides
NEAR, FAR = 0.3, 3.0  # metres, the latter as in the paper
TITLES = {
    "time": "time", "rate": "key frames/s", "mean_ms": "ms each", "late_ms": "95% within, ms", "known": "voxels known", "peak_mb": "MB",
}  # fmt: skip


def key_frames(
    key_frames: Annotated[int, typer.Option("--key-frames", min=2, max=500, help="Key frames of the walk.")] = 30,
    width: Annotated[int, typer.Option(min=64, max=4096, help="Pixels of an image's long side.")] = 640,
    voxel: Annotated[float, typer.Option(min=0.005, max=1.0, help="Side of the finest voxels, metres.")] = 0.04,
    levels: Annotated[int, typer.Option(min=1, max=4, help="Lattices, each finer than the one before; 1: the paper's single one.")] = 2,
    repetitions: Annotated[int, typer.Option(min=1, help="Times that all are fused; the first has loading and compiling in it.")] = 3,
    device: Device = None,
    threads: Threads = None,
    seed: Seed = None,
    out: Folder = None,
    quiet: Quiet = False,
) -> None:
    """Fuse key frames of a walk through a made-up room, and count them by the second: encoding, depth distributions included."""
    set_threads(threads or os.cpu_count() or 1)
    where = torch.device(choose_device(device or "auto"))
    progress = make_progress(quiet)
    plan = [{"key_frames": key_frames, "width": width, "voxel": voxel, "levels": levels, "seed": seed or 0}]

    def run(entry: Row) -> Row:
        way = walk(key_frames, width, voxel, levels, entry["seed"], where)
        return {"times": list(key_frame_rates(way, FusionOptions(levels, NEAR, FAR), where, repetitions, progress))}

    data = Experiment("key_frames", plan, run, table).conduct(out, progress, threads, str(where))
    show(section(data, table), quiet)


def table(data: Row) -> str:
    """Markdown: a line for each time that all were fused."""
    rows = [each for row in data["rows"] for each in row["times"]]
    columns = [name for name in TITLES if name in rows[0]]
    return markdown([TITLES[name] for name in columns], ([f"{row[name]:,}" for name in columns] for row in rows))


@dataclass(frozen=True)
class Walk:
    """Views along a walk, the key frames among them with others that overlap, and the finest lattice."""

    views: Views
    keys: KeyFrames
    others: list[list[int]]
    lattice: Lattice


def walk(key_frames: int, width: int, voxel: float, levels: int, seed: int, device: torch.device) -> Walk:
    """A walk through a furnished room.

    Args:
        width: of the pictures, three quarters as high.
        voxel: side of the finest voxels, metres.

    Raises:
        InputError: no clear walk was found.
    """
    random = np.random.default_rng(seed)
    scene = random_scene("room", random, texture_bank(0, TEXTURE))
    free = np.asarray(scene.free)
    poses = _path(scene, random, EVERY * key_frames)
    lens = Intrinsics(width, width * 3 // 4, FOCAL * width, FOCAL * width, width / 2, width * 3 / 8)
    images, depths, drawn = [], [], scene.to(device)
    for pose in poses:
        shown = drawn.render(lens, pose, side=1)
        images.append((shown.rgb.clamp(0, 1) * 255).round().byte().cpu().numpy())
        depths.append(shown.depth[::9, ::9].cpu().numpy())
    views = Views([f"{n:04d}" for n in range(len(images))], images, [lens] * len(images), poses, np.zeros(len(images), bool))
    seen = np.concatenate([depth[depth > 0] for depth in depths])
    median = float(np.median(seen))
    keys = select_keyframes(poses, views.intrinsics, median, KeyframesSettings("uniform", EVERY, key_frames))
    low, high = free.min(0) - 1.0, free.max(0) + 1.0
    half = float((high - low).max() / 2)
    middle, box = (low + high) / 2, (high - low) / 2 / half
    space = Space((float(middle[0]), float(middle[1]), float(middle[2])), half, 0.0, (float(box[0]), float(box[1]), float(box[2])))
    unit = 8 * 2 ** (levels - 1)
    lattice = Lattice(space, max(round(2 * space.extent * space.half / voxel / unit), 1) * unit)
    return Walk(views, keys, overlapping(keys, poses, views.intrinsics, median), lattice)


def _path(scene: Scene, random: np.random.Generator, count: int) -> Array:
    for _ in range(WALKS):
        poses = hand_held(
            random,
            count,
            np.asarray(scene.free),
            np.asarray(scene.focus, np.float64),
            lambda points: scene.clearance(torch.from_numpy(points)).numpy().astype(np.float64),
        )
        if poses is not None:
            return poses
    raise InputError("no clear walk was found in this room; choose another --seed")


def key_frame_rates(
    walk: Walk, options: FusionOptions, device: torch.device, repetitions: int, progress: Progress = SILENT
) -> Iterator[dict[str, Any]]:
    """A row for each time that all key frames are fused, encoding, depth distributions included: key frames a second, milliseconds of
    one in the mean and at the 95th percentile, and how much became known. The first row has loading and compiling in it."""
    model = load_model(SHIPPED, device)
    for number in range(repetitions):
        if device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(device)
        begin = time.perf_counter()
        last, count, seconds = _fused(model, walk, options, progress)
        took = time.perf_counter() - begin
        row: dict[str, Any] = {"time": number + 1, "key_frames": count, "seconds": round(took, 3), "rate": round(count / took, 2)}
        row |= {"mean_ms": round(1000 * took / count, 2), "late_ms": round(1000 * float(np.percentile(seconds, 95)), 2)}
        row |= {"resolution": walk.lattice.resolution, "blocks": last.topology.blocks, "known": int(last.known.sum())}
        if device.type == "cuda":
            row["peak_mb"] = round(torch.cuda.max_memory_allocated(device) / 1e6)
        yield row


def _fused(model: NerfusionModel, walk: Walk, options: FusionOptions, progress: Progress) -> tuple[Any, int, list[float]]:
    seconds, volume = list[float](), None
    before = time.perf_counter()
    for step in fuse_views(model, walk.views, walk.keys, walk.lattice, options, progress, others=walk.others):
        now = time.perf_counter()
        seconds.append(now - before)
        before, volume = now, step.volume if len(seconds) == len(walk.keys.indices) else None
    if model.device.type == "cuda":
        torch.cuda.synchronize(model.device)
    return volume, len(seconds), seconds


app = application(key_frames)
if __name__ == "__main__":
    program(app)
