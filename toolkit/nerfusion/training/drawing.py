"""From a scene to a sample: frames are chosen, their pictures fetched, and the space laid around what they show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from fieldfuse.errors import InputError
from fieldfuse.nerfusion.training.region import draw_voxel, lattice_resolution, region_around, surface_points
from fieldfuse.nerfusion.training.samples import Sample, TrainingScene, choose_views
from fieldfuse.nerfusion.training.settings import PictureSettings, VolumeSettings

Tensor = torch.Tensor


def draw_sample(
    scene: TrainingScene, rng: np.random.Generator, pictures_settings: PictureSettings, volume: VolumeSettings, key_frames: int
) -> Sample:
    """A sample of a scene.

    The frame of reference is moved to the first key frame's place in float64 before anything becomes float32.

    Raises:
        InputError: too few frames, or nothing that tells how deep the scene is.
    """
    wanted = pictures_settings
    choice = choose_views(
        scene.world_from_camera,
        scene.ordered,
        scene.kind,
        rng,
        views=wanted.views,
        key_frames=key_frames,
        targets=wanted.targets,
        depth=scene.depth_hint or 1.0,
    )
    used, places = np.unique(np.concatenate([choice.references.ravel(), choice.targets.ravel()]), return_inverse=True)
    pictures = scene.pictures([int(i) for i in used])
    split = choice.references.size
    references = torch.from_numpy(places[:split].reshape(choice.references.shape)).long()
    targets = torch.from_numpy(places[split:].reshape(choice.targets.shape)).long()
    poses = np.array(scene.world_from_camera[used], dtype=np.float64)
    poses[:, :3, 3] -= scene.world_from_camera[choice.references[0, 0], :3, 3]
    pictures = replace(pictures, world_from_camera=torch.from_numpy(poses.astype(np.float32)).to(pictures.images.device))
    near, middle, far = depth_range(pictures.depths[references.unique()], scene.depth_hint, scene.name)
    key = int(references[0, 0])
    ahead = poses[key, :3, 3] + middle * poses[key, :3, 2]
    space = region_around(
        surface_points(pictures, references.unique()),
        (ahead, 0.6 * middle),
        part=float(rng.uniform(*_pair(volume.region))),
        closed=bool(rng.random() < volume.closed),
    )
    voxel = draw_voxel(rng, middle, volume.voxels_to_median)
    resolution = lattice_resolution(space, voxel, volume.most)
    return Sample(scene.name, pictures, references, targets, space, resolution, 0.7 * near, max(1.1 * far, 1.5 * middle))


def _pair(values: list[float]) -> tuple[float, float]:
    return float(values[0]), float(values[1])


def depth_range(depths: Tensor, hint: float | None, where: str) -> tuple[float, float, float]:
    """Nearest, median and farthest depth (1st, 50th, 99th percentile) of (V, H, W) depths, or guesses around `hint` without them.

    Raises:
        InputError: neither depth nor a hint.
    """
    known = depths[depths > 0]
    if len(known) < 16:
        if hint is None:
            raise InputError(f"{where}: neither depth pictures nor cameras tell how deep the scene is; leave it out")
        return 0.5 * hint, hint, 2.0 * hint
    part = known[:: max(1, len(known) // 20000)].double()
    near, middle, far = torch.quantile(part, part.new_tensor([0.01, 0.5, 0.99])).tolist()
    return near, middle, far
