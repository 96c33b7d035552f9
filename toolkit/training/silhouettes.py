"""Captures with alpha: what lies outside of the silhouettes is empty."""

from __future__ import annotations

from dataclasses import replace

from toolkit.capture.types import Views
from toolkit.networks.lattice import Lattice
from toolkit.render.field import Field
from toolkit.training.start import WHOLE, emptied_by_views


def inside_silhouettes(field: Field, views: Views, reach: float = WHOLE) -> Field:
    """The field without the voxels that the alpha of the training views says are empty.

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
