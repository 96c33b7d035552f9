"""How many key frames a second the networks fuse on a machine: a walk through a made-up room, drawn anew, so that no data is needed."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.capture.types import Views
from fieldfuse.errors import InputError
from fieldfuse.nerfusion.extras.keyframe_depth import beside
from fieldfuse.nerfusion.fusion import FusionOptions, fuse_views, fusion_lattice
from fieldfuse.nerfusion.keyframes import KeyFrames, select_keyframes
from fieldfuse.nerfusion.lattice import Lattice
from fieldfuse.nerfusion.model import NerfusionModel
from fieldfuse.nerfusion.training.paths import hand_held
from fieldfuse.nerfusion.weights import SHIPPED, load_model
from fieldfuse.progress import SILENT, Progress
from fieldfuse.simulate.materials import texture_bank
from fieldfuse.simulate.procedural import random_scene
from fieldfuse.simulate.scene import Scene
from fieldfuse.volume.space import Space

EVERY = 2  # frames to a key frame: a key frame's neighbours are others' as well, as in a video
WALKS = 20  # tries to find a clear one
FOCAL = 0.82  # of the picture's width
TEXTURE = 256  # pixels of the bank's sides
NEAR = 0.3  # metres


@dataclass(frozen=True)
class Walk:
    """Views along a walk, the key frames among them with their witnesses, and the finest lattice."""

    views: Views
    keys: KeyFrames
    witnesses: list[list[int]]
    lattice: Lattice


def walk(key_frames: int, width: int, voxel: float, levels: int, seed: int, device: torch.device) -> Walk:
    """A walk through a furnished room.

    Args:
        width: of the pictures, three quarters as high.
        voxel: side of the finest voxels, metres.

    Raises:
        InputError: no clear walk was found, or the lattice cannot be made.
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
    keys = select_keyframes(poses, views.intrinsics, median, method="uniform", every=EVERY, most=key_frames)
    low, high = free.min(0) - 1.0, free.max(0) + 1.0
    half = float((high - low).max() / 2)
    middle, box = (low + high) / 2, (high - low) / 2 / half
    space = Space((float(middle[0]), float(middle[1]), float(middle[2])), half, 0.0, (float(box[0]), float(box[1]), float(box[2])))
    return Walk(views, keys, beside(keys, poses, views.intrinsics, median), fusion_lattice(space, voxel, levels))


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
    """A row for each time that all key frames are fused, encoding, sweeps and witnesses included: key frames a second, milliseconds of
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
    for step in fuse_views(model, walk.views, walk.keys, walk.lattice, options, progress, witnesses=walk.witnesses):
        now = time.perf_counter()
        seconds.append(now - before)
        before, volume = now, step.volume if len(seconds) == len(walk.keys.indices) else None
    if model.device.type == "cuda":
        torch.cuda.synchronize(model.device)
    return volume, len(seconds), seconds
