"""Which pixels a step looks at: more of those where the field was wrong lately, each counted by how rarely such a pixel is drawn.

A step's losses estimate means over all pixels. The estimate's gradient varies least when a pixel is drawn in proportion to the size of
its own gradient, which goes with the root of its squared error. So every tile of a training picture remembers the error that rays from
it had, and a pixel of it is drawn with a density

    q = 1 − S + S · min(√e / mean √e, M)

and counts 1 / q in all losses, which leaves their means as they are but for a factor (importance sampling; the paper draws evenly). What
no ray came to has q = 1.

Pixels are drawn by lot from evenly drawn ones, so masks and weights of pictures need no index. Here for any device; compiled twins of the
functions are in `backends/numba/train_draw.py`.
"""

from __future__ import annotations

import torch

from fieldfuse.backends.constants import KEEP as KEEP
from fieldfuse.backends.constants import MOST as MOST
from fieldfuse.backends.constants import RENEW as RENEW
from fieldfuse.backends.constants import SHARE as SHARE
from fieldfuse.backends.constants import TILE as TILE
from fieldfuse.backends.constants import TOP as TOP
from fieldfuse.training.rays import PixelPool

Tensor = torch.Tensor


def tile_grid(pool: PixelPool) -> tuple[int, int]:
    """Rows and columns of tiles of the largest picture."""
    return int(pool.height) // TILE + 1, int(pool.camera[:, 4].max()) // TILE + 1


class Errors:
    """The squared error that rays from each tile had, and the draw of pixels by it."""

    def __init__(self, pool: PixelPool) -> None:
        self.pool, (self.high, self.wide) = pool, tile_grid(pool)
        device = pool.camera.device
        self.error = torch.zeros(len(pool.pose) * self.high * self.wide, device=device)  # (T,) 0: no ray yet
        self.density = torch.ones_like(self.error)
        self.steps = 0

    def tiles(self, picks: Tensor) -> Tensor:
        """(B,) pixels → (B,) tiles."""
        view, row, column = self.pool.seen_at(picks)
        return (view * self.high + row // TILE) * self.wide + column // TILE

    def draw(self, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """(count,) pixels before the pool's limit, with replacement, and (count,) what each of them counts."""
        if self.steps % RENEW == 0:
            self.density = densities(self.error)
        self.steps += 1
        device, found, missing = self.error.device, [], count
        while missing > 0:
            more = int(missing * TOP * 1.2) + 16
            picks = torch.randint(self.pool.limit, (more,), generator=generator).to(device)
            luck = torch.rand(more, generator=generator).to(device)
            picks = picks[luck * TOP < self.density[self.tiles(picks)]][:missing]
            found.append(picks)
            missing -= len(picks)
        picks = torch.cat(found)
        return picks, 1 / self.density[self.tiles(picks)]

    def remember(self, picks: Tensor, error: Tensor) -> None:
        """The squared errors (B,) ≥ 0 of the rays of a batch; of several rays of a tile any one counts."""
        tiles = self.tiles(picks)
        old = self.error[tiles]
        self.error[tiles] = torch.where(old > 0, KEEP * old + (1 - KEEP) * error, error)


def densities(error: Tensor) -> Tensor:
    """(T,) squared errors, 0 where no ray came to → (T,) q, between 1 − S and `TOP`."""
    known = error > 0
    root = torch.where(known, error, torch.zeros_like(error)).sqrt()
    mean = root.sum() / known.sum().clamp_min(1)
    ratio = torch.where(known, (root / mean.clamp_min(1e-12)).clamp_max(MOST), torch.ones_like(root))
    return 1 - SHARE + SHARE * ratio
