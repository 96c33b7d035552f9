"""PSNR over a few pixels of some views while a field is fitted: what validation views and the timeline are told by."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from fieldfuse.camera import Array
from fieldfuse.capture.types import Views
from fieldfuse.tone import decode, encode
from fieldfuse.training.engine import Engine
from fieldfuse.training.rays import Batch, PixelPool


class Sample:
    """PSNR over a fixed random sample of some views' pixels: the mean over views, in the colours of their photos, as the report's table
    counts it."""

    def __init__(self, views: Views, indices: Array, pixels: int, device: torch.device) -> None:
        self.batch: Batch | None = None
        self.factor: Array | None = None  # (P, 3) what was taken out of the pixels' light; None: nothing
        if len(indices):
            some = views.subset(indices)
            pool = PixelPool(replace(some, images=[some.photo(index) for index in range(len(some))]), device)
            pick = torch.randperm(len(pool), generator=torch.Generator().manual_seed(0))[:pixels].to(device)
            self.batch, self.factor = pool.take(pick), _factors(some, *(place.cpu().numpy() for place in pool.seen_at(pick)))

    def psnr(self, engine: Engine) -> float | None:
        """Decibels, the mean over views; None: there are none."""
        each = self.each(engine)
        return float(each.mean()) if len(each) else None

    def each(self, engine: Engine) -> Array:
        """(V,) decibels of each view that has pixels in the sample."""
        if self.batch is None:
            return np.zeros(0)
        error = (self._as_taken(engine.colours(self.batch.origins, self.batch.directions)) - self.batch.colour).square().mean(-1)
        views, pixels = self.batch.view.unique(return_inverse=True, return_counts=True)[1:]
        of_views = torch.zeros(len(pixels), device=error.device).index_add(0, views, error) / pixels
        return np.asarray((-10 * of_views.clamp_min(1e-10).log10()).cpu().numpy())

    def _as_taken(self, shown: torch.Tensor) -> torch.Tensor:
        """(P, 3) colours of the sample's pixels with what was taken out of their pictures put back."""
        if self.factor is None:
            return shown
        return torch.from_numpy(encode(decode(shown.detach().cpu().numpy().astype(np.float64)) * self.factor)).to(shown)


def _factors(views: Views, view: Array, row: Array, column: Array) -> Array | None:
    """(P, 3) what was taken out of the light of pixels, so that their pictures are not as they were taken; None: nothing."""
    if all(photo is None for photo in views.photos):
        return None
    out = np.ones((len(view), 3))
    for index, (tone, photo) in enumerate(zip(views.tones, views.photos, strict=True)):
        mine = view == index
        if tone is not None and photo is not None:
            out[mine] = np.broadcast_to(tone.factor(views.intrinsics[index]), photo.shape)[row[mine], column[mine]]
    return out
