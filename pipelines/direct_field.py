"""The field that the shipped networks give directly, without any fitting, for benchmarks and sweeps."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from fieldfuse import steps
from fieldfuse.files import fingerprint

if TYPE_CHECKING:
    from fieldfuse.capture.types import Views
    from fieldfuse.config import Settings
    from fieldfuse.nerfusion.keyframes import KeyFrames
    from fieldfuse.poses.scene import Scene
    from fieldfuse.progress import Progress
    from fieldfuse.render.field import Field


@dataclass(frozen=True)
class DirectField:
    """What direct inference gave.

    Attributes:
        key_frames: that were fused.
        voxel_size: of the networks' finest lattice, working units; the field's is finer where colours are.
    """

    field: Field
    key_frames: int
    voxel_size: float


def weights_state(settings: Settings) -> str:
    """Changes with the weights, so that results of earlier ones are not reused."""
    return fingerprint(steps.network_weights(settings))


def training_key_frames(views: Views, scene: Scene, settings: Settings) -> KeyFrames:
    """Key frames among the training views, as a run chooses them but for sharpness."""
    return steps.key_frames(views, scene, settings, sharp=False)


def direct_field(
    settings: Settings, views: Views, scene: Scene, progress: Progress, share: float = 1.0, voxel_factor: float = 1.0
) -> DirectField:
    """Fuse the key frames (about `share` of them, evenly spread) of the training views into a field.

    Args:
        voxel_factor: voxels this many times as large as those of `network.voxels`.

    Raises:
        InputError: there is no training view, or no weights.
        Interrupted: the user asked to stop.
    """
    from fieldfuse.nerfusion.keyframes import KeyFrames
    from fieldfuse.training.from_network import voxels_to_median

    keys = training_key_frames(views, scene, settings)
    if share < 1:
        some = np.unique(np.linspace(0, len(keys.indices) - 1, max(1, round(share * len(keys.indices)))).round().astype(int))
        keys = KeyFrames(keys.indices[some], keys.neighbours[some])
    network = settings.network
    voxels = (network.voxels or voxels_to_median(views, network.depth_from == "sensor")) / voxel_factor
    inference = steps.direct_inference(views, scene, keys, replace(settings, network=replace(network, voxels=voxels)))
    for _ in inference.frames(progress):
        pass
    return DirectField(inference.result(progress, settings.engine), len(keys.indices), inference.lattice.voxel_size)
