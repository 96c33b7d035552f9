"""A key frame's local volume on CUDA without gradients (`NerfusionModel.local_volume`): the device is asked once, how many corners it sees
and in which blocks; all else is decided by the processor, which knows the blocks' keys, or happens behind it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from torch import Tensor

from fieldfuse.backends.dispatch import to_device_async
from fieldfuse.backends.triton.observe import Observer
from fieldfuse.backends.triton.volumes import settle
from fieldfuse.nerfusion.cameras import Cameras
from fieldfuse.nerfusion.extras.plane_sweep import DepthDistribution
from fieldfuse.nerfusion.lattice import Lattice, LocalVolume
from fieldfuse.nerfusion.unproject import EncodedView
from fieldfuse.nerfusion.volume_net import LocalReconstruction
from fieldfuse.volume.topology import Topology


def local_volume(
    local: LocalReconstruction,
    views: Sequence[EncodedView],
    cameras: Cameras,
    lattice: Lattice,
    topology: Topology,
    wanted: Tensor | None,
    near: float,
    far: float,
    swept: DepthDistribution,
    numbers: tuple[float, ...],
    sizes: tuple[int, bool, int],
) -> LocalVolume:
    """See `NerfusionModel.local_volume`.

    Args:
        local: the network.
        numbers: of `Observer`.
        sizes: channels of the encoder's that are compared, whether variance is asked for, and channels of a latent.
    """
    observer = Observer(views, cameras, near, far, swept, numbers)
    found = observer.choose(lattice, topology.keys, wanted)
    filled, busy = (of.nonzero()[0].astype(np.int32) for of in (found.filled, found.busy))
    slots = np.full((2, topology.blocks), -1, np.int32)
    slots[0, filled], slots[1, busy] = (np.arange(len(of), dtype=np.int32) for of in (filled, busy))
    keys = topology.host
    filled_keys, busy_keys = keys[filled], keys[busy]
    # All that the processor has to say goes there in one piece.
    parts: list[Any] = [slots, filled_keys, busy_keys, slots[1, filled], slots[0, busy], busy]
    whole = to_device_async(np.concatenate([part.reshape(-1) for part in parts]), topology.device).split([part.size for part in parts])
    kept = topology.alike(whole[1].view(-1, 3), filled_keys)
    # Beside which blocks they lie is read in a table that others need as well.
    given = whole[2].view(-1, 3), busy_keys
    few = kept.some(*given, whole[4], whole[3]) if wanted is None else topology.some(*given, whole[5], whole[0][topology.blocks :])
    sampled, variance, channels = sizes
    known = observer.observe(lattice, topology.keys, found, whole[0], local.project, sampled, variance, channels)
    learned = local.learned(known.latent, few, known.seen) if len(busy) else known.start
    raw, rows = settle(known.start, learned, whole[3])
    return LocalVolume(lattice, kept, rows, known.count, raw, known.weight, few, whole[4])

