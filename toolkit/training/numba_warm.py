"""Compiles, or loads from numba's cache, every kernel that a fit and its pictures need, by using them on a field of a few voxels."""

from __future__ import annotations

import numpy as np
import torch

from fieldfuse.camera import Intrinsics
from fieldfuse.capture.types import Views
from fieldfuse.nerfusion.decoder import make_decoder
from fieldfuse.render.numba_per_sample import PerSampleRenderer
from fieldfuse.render.numba_renderer import NumbaRenderer
from fieldfuse.training.levels import finer, first_field, visible
from fieldfuse.training.numba_engine import NumbaOptimiser
from fieldfuse.training.numba_per_sample import NumbaPerSampleOptimiser
from fieldfuse.training.rays import PixelPool
from fieldfuse.training.step import Rates
from fieldfuse.volume.host import TorchHost
from fieldfuse.volume.space import Space

_ready: set[tuple[str, int, int]] = set()
RATES = Rates(0.01, 0.01, 0.001, 0.01, 0.01)


def ready(decoder: str, channels: int, hidden: int) -> bool:
    """Whether `run` was done in this process for fields with this decoder, so many channels and so wide hidden layers."""
    return (decoder, channels, hidden) in _ready


def run(kind: str, channels: int, hidden: int) -> None:
    """Use every kernel once, for the decoder `kind` (deferred | per_sample). The process's random numbers are left as they were."""
    state = torch.get_rng_state()
    line = torch.arange(8)
    places = torch.cartesian_prod(line, line, line)
    decoder = make_decoder(kind, channels, hidden)
    background, generator = torch.zeros(3), torch.Generator().manual_seed(0)
    space = Space((0.0, 0.0, 0.0), 1.0, 1.0)
    field = first_field(space, 8, places, channels, 0.0, decoder, background, 0.0, 4, TorchHost(), generator)
    pose = np.eye(4)
    pose[2, 3] = -3
    picture = np.zeros((4, 4, 3), np.uint8)
    pool = PixelPool(Views(["one"], [picture], [Intrinsics(4, 4, 4, 4, 2, 2)], pose[None], np.zeros(1, bool)))
    engine = NumbaOptimiser(field, pool) if kind == "deferred" else NumbaPerSampleOptimiser(field, pool)
    engine.step(8, RATES)
    field = finer(field, visible(field, engine.seen, engine.visits, 0.05), 16, TorchHost())
    engine.renew_rows(field)
    engine.step(8, RATES)
    engine.go_on_with(field)
    origins, directions = torch.zeros(3, 3), torch.eye(3)
    engine.colours(origins, directions)
    renderer = NumbaRenderer if kind == "deferred" else PerSampleRenderer
    renderer(engine.sync()).render(origins, directions)
    torch.set_rng_state(state)
    _ready.add((kind, channels, hidden))
