"""Compiles, or loads from Triton's cache, every kernel that a fit on CUDA and its pictures need, by using it on a few voxels."""

from __future__ import annotations

import numpy as np
import torch

from fieldfuse.backends.triton.march import RAYS
from fieldfuse.camera import Intrinsics
from fieldfuse.capture.types import Views
from fieldfuse.nerfusion.decoder import make_decoder
from fieldfuse.progress import Progress
from fieldfuse.render.triton_renderer import TritonRenderer
from fieldfuse.training.levels import finer, first_field, visible
from fieldfuse.training.rays import PixelPool
from fieldfuse.training.step import Rates
from fieldfuse.training.triton_engine import EAGER, TritonOptimiser
from fieldfuse.volume.host import TorchHost
from fieldfuse.volume.space import Space

_ready: set[tuple[int, int, torch.device]] = set()
RATES = Rates(0.01, 0.01, 0.001, 0.01, 0.01)


def run(channels: int, hidden: int, device: torch.device, progress: Progress) -> None:
    """Use every kernel once, with and without a background beyond the region of interest, known depth and masks."""
    if (channels, hidden, device) in _ready:
        return
    progress.update(0, 1, "compiling the fast engine, once on this machine, half a minute at most")
    state = torch.get_rng_state()
    line = torch.arange(8)
    places = torch.cartesian_prod(line, line, line)
    pose = np.eye(4)
    pose[2, 3] = -3
    for known in (False, True):
        space = Space((0.0, 0.0, 0.0), 1.0, 1.0 if known else 0.0)
        generator, decoder = torch.Generator().manual_seed(0), make_decoder("deferred", channels, hidden).to(device)
        host, background = TorchHost(device), torch.zeros(3, device=device)
        field = first_field(space, 8, places, channels, 0.0, decoder, background, 0.0, 4, host, generator)
        for some in (False, True):
            valid = np.ones((4, 4), bool)
            valid[0, 0] = not some
            one = Views(["one"], [np.zeros((4, 4, 3), np.uint8)], [Intrinsics(4, 4, 4, 4, 2, 2)], pose[None], np.zeros(1, bool), [valid])
            one.depths = [np.ones((4, 4), np.float32) if known else None]
            engine = TritonOptimiser(field, PixelPool(one, device, depth=known))
            for _ in range(EAGER + 2 if known and some else 1):  # the last two are recorded and replayed
                engine.step(RAYS, RATES)
        field = finer(field, visible(field, engine.seen, engine.visits, 0.05), 16, host)
        engine.renew_rows(field)
        engine.step(RAYS, RATES)
        engine.go_on_with(field)
        TritonRenderer(engine.sync())(torch.zeros(3, 3), torch.eye(3))
    torch.set_rng_state(state)
    _ready.add((channels, hidden, device))
