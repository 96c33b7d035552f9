"""The field that the shipped networks give directly, without any fitting, for benchmarks and sweeps."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from toolkit.capture.types import Views
    from toolkit.config import Settings
    from toolkit.poses.scene import Scene
    from toolkit.progress import Progress
    from toolkit.render.field import Field


def direct_field(settings: Settings, views: Views, scene: Scene, progress: Progress, share: float = 1.0) -> tuple[Field, int]:
    """Fuse the key frames (about `share` of them, evenly spread) of the training views into a field; and how many they were.

    Raises:
        InputError: there is no training view, or no weights.
        Interrupted: the user asked to stop.
    """
    from toolkit.keyframes import KeyFrames, select_keyframes
    from toolkit.training.from_network import Inference, load_networks

    train = np.flatnonzero(~np.asarray(views.test))
    keys = select_keyframes(views.world_from_camera[train], [views.intrinsics[index] for index in train], scene.median_depth)
    if share < 1:
        kept = np.unique(np.linspace(0, len(keys.indices) - 1, max(1, round(share * len(keys.indices)))).round().astype(int))
        keys = KeyFrames(keys.indices[kept], keys.neighbours[kept])
    inference = Inference(load_networks(device=settings.device), views, scene, keys, settings.field.background)
    for _ in inference.frames(progress):
        pass
    return inference.field(), len(keys.indices)
