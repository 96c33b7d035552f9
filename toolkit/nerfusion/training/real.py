"""Validation cases from real captures: held-out pictures to be predicted from key frames among the others. Nothing here trains.

The held-out convention is the project's: frames by name, every 8th is a test view. Working frame, depth range and key frames are found
just as for a run of `fieldfuse`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from fieldfuse.camera import Array
from fieldfuse.capture.detect import read_source
from fieldfuse.capture.prepare import prepare_views
from fieldfuse.capture.types import Views
from fieldfuse.config import CaptureSettings
from fieldfuse.errors import InputError
from fieldfuse.nerfusion.keyframes import select_keyframes
from fieldfuse.nerfusion.training.region import lattice_resolution
from fieldfuse.nerfusion.training.samples import Pictures, Sample, view_distance
from fieldfuse.nerfusion.training.settings import TrainSettings
from fieldfuse.poses.scene import Scene, describe_scene
from fieldfuse.training.start import make_space

MOST_KEY_FRAMES = 40


@dataclass(frozen=True)
class Case:
    """One held-out picture: `sample.targets` is it in every row; key frames from the farthest to the nearest one."""

    capture: str
    picture: str
    sample: Sample
    nearest: int  # the picture in `sample.pictures` that is nearest to the target, for the simplest baseline


def load_cases(folder: Path | str, settings: TrainSettings) -> list[Case]:
    """Evenly spread held-out pictures of one capture.

    Raises:
        InputError: the capture cannot be read, has no poses, or too few pictures.
        PoseError: its scene cannot be told from poses and pictures.
    """
    capture = read_source(Path(folder))
    scene = describe_scene(capture)
    size = CaptureSettings(image_size=settings.record.validation_side)
    views = prepare_views(capture, scene.working_from_input, size)
    if len({image.shape for image in views.images}) != 1:
        raise InputError(f"the pictures of {folder} differ in size; validation needs one size a capture")
    train = np.flatnonzero(~np.asarray(views.test))
    held = np.flatnonzero(np.asarray(views.test))
    if len(train) < settings.pictures.views or len(held) == 0:
        raise InputError(f"{folder} has {len(train)} training and {len(held)} held-out pictures; too few to validate on")
    wanted = held[np.unique(np.linspace(0, len(held) - 1, settings.record.validation_views).round().astype(int))]
    keys = select_keyframes(
        views.world_from_camera[train],
        [views.intrinsics[i] for i in train],
        scene.median_depth,
        views=settings.pictures.views,
        most=MOST_KEY_FRAMES,
    )
    apart = view_distance(views.world_from_camera, scene.median_depth)
    references = np.concatenate([train[keys.indices][:, None], train[keys.neighbours]], axis=1)  # (M, K)
    return [_case(Path(folder).name, views, scene, int(target), references, apart[target], train, settings) for target in wanted]


def _case(
    name: str, views: Views, scene: Scene, target: int, references: Array, apart: Array, train: Array, settings: TrainSettings
) -> Case:
    order = np.argsort(apart[references[:, 0]], kind="stable")[: settings.pictures.key_frames][::-1]
    chosen = references[order]  # (F, K), nearest last
    nearest = int(train[np.argmin(apart[train])])
    used, places = np.unique(np.concatenate([chosen.ravel(), [target, nearest]]), return_inverse=True)
    images = torch.stack([torch.from_numpy(views.images[i]).permute(2, 0, 1).float() / 255 for i in used]).contiguous()
    blank = np.zeros(views.images[0].shape[:2], np.float32)
    depths = [views.depths[i] if views.depths else None for i in used]
    cameras = [views.intrinsics[i] for i in used]
    pictures = Pictures(
        images=images,
        intrinsics=torch.tensor([[c.fx, c.fy, c.cx, c.cy] for c in cameras], dtype=torch.float32),
        world_from_camera=torch.from_numpy(views.world_from_camera[used].astype(np.float32)),
        depths=torch.from_numpy(np.stack([blank if depth is None else np.nan_to_num(depth) for depth in depths])).float(),
        background=views.background,
    )
    split = chosen.size
    space = make_space(scene, scene.has_background)
    low, high = settings.volume.voxels_to_median
    voxel = scene.median_depth / math.sqrt(low * high)
    sample = Sample(
        name=f"{name}/{views.names[target]}",
        pictures=pictures,
        references=torch.from_numpy(places[:split].reshape(chosen.shape)).long(),
        targets=torch.full((len(chosen), 1), int(places[split]), dtype=torch.int64),
        space=space,
        resolution=lattice_resolution(space, voxel, settings.volume.most),
        near=scene.near,
        far=scene.far,
    )
    return Case(name, views.names[target], sample, int(places[split + 1]))
