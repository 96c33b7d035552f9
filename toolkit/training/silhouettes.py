"""Captures with alpha: what lies outside of the silhouettes is empty, for the plane sweep and for what is made of it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from fieldfuse.backends.dispatch import can_use_numba
from fieldfuse.backends.numba.tensors import spread
from fieldfuse.backends.numba.volume import outside_hull
from fieldfuse.capture.types import Views
from fieldfuse.nerfusion.lattice import Lattice
from fieldfuse.render.field import Field
from fieldfuse.training.levels import all_places
from fieldfuse.training.start import COARSEST, WHOLE, emptied_by_views
from fieldfuse.volume.space import Space

Tensor = torch.Tensor
HULL = 128  # voxels along a side: 256 gave no better fields


@dataclass(frozen=True)
class Hull:
    """The visual hull of the training views on a lattice.

    Attributes:
        empty: (R, R, R) bool z, y, x; voxel (0, 0, 0) starts at −extent.
    """

    space: Space
    empty: Tensor

    def __call__(self, points: Tensor) -> Tensor:
        """(N, 3) points of the working frame → (N,) bool, outside of the hull (or of the lattice)."""
        side = len(self.empty)
        if can_use_numba(points) and self.empty.device.type == "cpu":
            out, given = np.empty(len(points), np.bool_), points.detach().contiguous().numpy()
            numbers = np.array([*self.space.centre, self.space.half, self.space.shell, self.space.extent], np.float32)
            spread(lambda n: outside_hull(given[n], self.empty.numpy(), numbers, out[n]), len(points))
            return torch.from_numpy(out)
        contracted = self.space.contract(self.space.normalise(points))
        place = ((contracted + self.space.extent) * (side / (2 * self.space.extent))).floor().long()
        outside = ((place < 0) | (place >= side)).any(1)
        x, y, z = place.clamp(0, side - 1).unbind(1)
        return outside | self.empty[z, y, x]


def visual_hull(space: Space, views: Views, device: torch.device | str = "cpu") -> Hull | None:
    """What the alpha of the training views leaves, from coarse to fine: what is empty is not divided. None where there is no alpha, or
    where it leaves nothing at all."""
    if all(alpha is None for alpha in views.alpha):
        return None
    side = COARSEST
    places = all_places(space, side)
    places = places[~emptied_by_views(space, side, places, views)]
    octants = torch.cartesian_prod(*[torch.arange(2)] * 3)
    while side < HULL:
        side *= 2
        places = (2 * places[:, None] + octants).view(-1, 3)
        places = places[~emptied_by_views(space, side, places, views)]
    if len(places) == 0:
        return None
    empty = torch.ones((side, side, side), dtype=torch.bool)
    x, y, z = places.unbind(1)
    empty[z, y, x] = False
    return Hull(space, empty.to(device))


def inside_silhouettes(field: Field, views: Views, reach: float = WHOLE) -> Field:
    """The field without the voxels that the alpha of the training views shows empty.

    Args:
        reach: voxels about the middle of each that have to be empty: `WHOLE` keeps all that a silhouette touches.
    """
    rows = field.occupied.nonzero().view(-1)
    if len(rows) == 0:
        return field
    corner = Lattice(field.space, field.resolution).contracted(field.topology.keys, rows)
    places = ((corner + field.space.extent) / (2 * field.space.extent / field.resolution)).round().long().cpu()
    empty = emptied_by_views(field.space, field.resolution, places, views, reach).to(rows.device)
    occupied = field.occupied.clone()
    occupied[rows[empty]] = False
    return field if bool(empty.all()) else replace(field, occupied=occupied)
