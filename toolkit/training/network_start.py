"""From the networks' field to the start of a fit: geometry and, for the deferred decoder, features and decoder at a level of the fit.

The fit's lattice is another one than the networks', so values are interpolated. What they found nothing of starts as thin and grey
as in the classical start; densities are kept between two bounds, so that a mistake of the networks can still be unlearnt.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from fieldfuse.capture.types import Views
from fieldfuse.config import Settings
from fieldfuse.nerfusion.decoder import Deferred, PerSample
from fieldfuse.poses.scene import Scene
from fieldfuse.render.field import Field
from fieldfuse.training.levels import FEATURE_NOISE, all_places, occupancy
from fieldfuse.training.start import NEAR, THIN, finest_resolution, levels, new_decoder, possible
from fieldfuse.volume.edit import resample

Tensor = torch.Tensor
# Largest raw density of the start: a fog where surfaces may be, which a wrong guess costs little (docs/measured/few_views.md).
THICK = 0.0


def widened(decoder: Deferred, hidden: int, generator: torch.Generator) -> Deferred:
    """The same function with `hidden` units a layer (at least its own): the new ones read others, but none reads them yet."""
    if hidden < decoder.hidden:
        raise ValueError(f"a decoder of {decoder.hidden} hidden units cannot be narrowed to {hidden}")
    out = Deferred(decoder.channels, hidden)
    with torch.no_grad():
        for old, new in zip(decoder.layers, out.layers, strict=True):
            rows, columns = old.weight.shape
            fresh = torch.randn(new.weight.shape, generator=generator) / new.weight.shape[1] ** 0.5
            fresh[:rows] = 0  # old units do not read new ones
            fresh[:rows, :columns] = old.weight.cpu()
            new.weight.copy_(fresh)
            new.bias.zero_()
            new.bias[:rows] = old.bias.cpu()
    return out


def network_start(made: Field, views: Views, scene: Scene, settings: Settings) -> Field:
    """The first field of a fit, at `field.start_resolution` voxels a side (the fit's finest, when that is less), from the networks'.

    With the deferred decoder and as many features as the networks have, features and decoder come along; otherwise geometry alone.

    Args:
        made: of the space that the fit uses.
        views: all views; which voxels can hold something is judged from the training views, as in the classical start.
    """
    train = views.subset(np.flatnonzero(~np.asarray(views.test)))
    rungs = levels(settings.field.resolution or finest_resolution(made.space, train, scene))
    resolution = max(rung for rung in rungs if rung <= max(settings.field.start_resolution, rungs[0]))
    generator = torch.Generator().manual_seed(settings.seed)
    device = made.device
    places = possible(made.space, resolution, all_places(made.space, resolution), views)
    topology, occupied = occupancy(places.to(device))
    scale = made.resolution / resolution
    # Thickness instead of its logarithm is what adds up when voxels are merged; the mark is 1 where the networks had a value.
    known = torch.cat([torch.ones_like(made.density_rows[:-1]), made.density_rows.new_zeros(1)])
    raw, feature, mark = resample(made.topology, made.occupied, [made.density_rows, made.feature_rows, known], topology.keys, scale)
    density = torch.where(mark > 0, raw.clamp(THIN, THICK), torch.full_like(raw, THIN))
    density[-1] = 0
    channels, hidden = settings.field.channels, settings.field.width
    noise = (torch.randn(len(density), channels, generator=generator) * FEATURE_NOISE).to(device)
    decoder: Deferred | PerSample
    fits = settings.field.decoder == "deferred" and made.feature_rows.shape[1] == channels
    if isinstance(made.decoder, Deferred) and fits and made.decoder.hidden <= hidden:
        decoder = widened(made.decoder, hidden, generator)
        rows = torch.where((mark > 0)[:, None], feature, noise)
    else:
        decoder = new_decoder(settings.field)
        rows = noise
    rows[-1] = 0
    made = replace(made, resolution=resolution, topology=topology, occupied=occupied, density_rows=density, feature_rows=rows.contiguous())
    return replace(made, decoder=decoder.to(device), near=NEAR * scene.near)
