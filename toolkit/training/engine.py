"""Three engines, one field: what a fit needs of each, and which one it gets.

`torch` is the reference and runs everywhere; `numba` is the fast path of the CPU, `triton` that of CUDA. They agree in values and gradients
(tests compare them), not in the random numbers that they draw.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
import torch

from fieldfuse.backends.dispatch import choose_engine
from fieldfuse.camera import Intrinsics
from fieldfuse.capture.types import Views
from fieldfuse.config import Settings
from fieldfuse.progress import Progress
from fieldfuse.render.field import Field
from fieldfuse.render.image import make_renderer
from fieldfuse.training.levels import NewField, all_places, finer, visible
from fieldfuse.training.losses import Rates
from fieldfuse.training.pixels import PixelPool
from fieldfuse.training.start import new_decoder
from fieldfuse.training.torch_engine import TorchEngine
from fieldfuse.volume.compiled import finer_blocks
from fieldfuse.volume.host import TorchHost
from fieldfuse.volume.space import Space

Tensor = torch.Tensor
_ready: set[tuple[object, ...]] = set()  # what kernels were made ready for in this process


class Engine(Protocol):
    """A field under optimisation."""

    @property
    def field(self) -> Field:
        """The field; its decoder is up to date after `sync` only."""
        ...

    @property
    def seen(self) -> Tensor:
        """(M · 512,) largest weight that each voxel was seen with since the last pruning."""
        ...

    @property
    def visits(self) -> Tensor:
        """(M · 512,) samples that fell into each voxel since then."""
        ...

    def step(self, rays: int, rates: Rates) -> tuple[float, int]:
        """One step on `rays` random pixels → mean squared colour error, samples looked up.

        Raises:
            NotFiniteError: the loss or a gradient is not finite; nothing was moved.
        """
        ...

    def renew_rows(self, field: Field) -> None:
        """Go on with another field of the same decoder: the rows' state starts afresh, the decoder's stays."""
        ...

    def release(self) -> None:
        """Free what belongs to the rows, before finer ones are made beside them; `renew_rows` must follow."""
        ...

    def go_on_with(self, field: Field) -> None:
        """Go on with the same rows after pruning; what was seen counts half from now on, so that it is forgotten within a few prunings."""
        ...

    def colours(self, origins: Tensor, directions: Tensor) -> Tensor:
        """(B, 3) colours that the field has now."""
        ...

    def sync(self) -> Field:
        """The field with everything that was learnt written into it."""
        ...


Make = Callable[[Field, PixelPool, int], Engine]


def chosen_engine(settings: Settings, device: torch.device) -> str:
    """numba, triton or torch: the backend of a fit with these settings on `device`."""
    return choose_engine(settings.engine, settings.field.decoder, device)


def make_engine(settings: Settings, field: Field, pool: PixelPool) -> Engine:
    """The engine of the settings, or for `auto` the fastest that there is."""
    return _kind(chosen_engine(settings, field.device))(field, pool, settings.seed)


def _kind(chosen: str) -> Make:
    """The class of an engine; its kernels are imported with it."""
    if chosen == "numba":
        from fieldfuse.training.numba_engine import NumbaEngine

        return NumbaEngine
    if chosen == "triton":
        from fieldfuse.training.triton_engine import TritonEngine

        return TritonEngine
    return TorchEngine


def fit_device(settings: Settings) -> torch.device:
    """Where a fit with these settings computes."""
    return torch.device(settings.device if settings.device != "auto" else "cuda" if torch.cuda.is_available() else "cpu")


def warm_up(settings: Settings, progress: Progress) -> None:
    """Have the kernels compiled (once a machine: they are cached on disk) or loaded, before any clock runs. The random numbers of the
    process stay as they were."""
    chosen = chosen_engine(settings, device := fit_device(settings))
    if chosen == "torch":
        torch.optim.Adam([torch.zeros(1, requires_grad=True)])  # the first optimiser imports torch's compiler: 1.6 s
        return
    kind = (settings.field.decoder, settings.field.channels, settings.field.width, device)
    if kind not in _ready:
        progress.update(0, 1, "compiling the fast engine, once on this machine, about half a minute")
        state = torch.get_rng_state()
        use_every_kernel(_kind(chosen), settings, device, 32 if chosen == "triton" else 8)
        torch.set_rng_state(state)
        _ready.add(kind)


def use_every_kernel(kind: Make, settings: Settings, device: torch.device, rays: int) -> None:
    """Everything that a fit and its renders call, on a field of a few voxels: with and without a background beyond the region of interest,
    known depth and masks, where kernels differ by these."""
    rates, host = Rates(0.01, 0.01, 0.001, 0.01, 0.01), TorchHost(device)
    pose = np.eye(4)
    pose[2, 3] = -3
    for known in (False, True):
        space = Space((0.0, 0.0, 0.0), 1.0, 1.0 if known else 0.0)
        field = NewField(space, 8, new_decoder(settings.field).to(device), torch.zeros(3, device=device)).on(all_places(space, 8), host)
        for masked in (False, True):
            valid = np.ones((4, 4), bool)
            valid[0, 0] = not masked
            one = Views(["one"], [np.zeros((4, 4, 3), np.uint8)], [Intrinsics(4, 4, 4, 4, 2, 2)], pose[None], np.zeros(1, bool), [valid])
            one.depths = [np.ones((4, 4), np.float32) if known else None]
            engine = kind(field, PixelPool(one, device, depth=known), 0)
            for _ in range(getattr(kind, "EAGER", 0) + 2 if known and masked else 1):  # the last two are recorded and replayed
                engine.step(rays, rates)
        finer_blocks(field.topology, field.occupied, 2.0)
        field = finer(field, visible(field, engine.seen, engine.visits, 0.05), 16, host)
        engine.renew_rows(field)
        engine.step(rays, rates)
        engine.go_on_with(field)
        engine.colours(torch.zeros(3, 3), torch.eye(3))
        make_renderer(engine.sync())(torch.zeros(3, 3), torch.eye(3))
