"""Coloured points as PLY, in the input's frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fieldfuse.camera import Array, Similarity
from fieldfuse.errors import InputError
from fieldfuse.export.ply import write_ply
from fieldfuse.tsdf.mesh import as_bytes


def write_points(
    path: Path | str,
    points: Array,
    colours: Array | None = None,
    normals: Array | None = None,
    working_from_input: Similarity | None = None,
) -> None:
    """Write (P, 3) points with (P, 3) colours (uint8, or floating point 0 to 1; None: grey) and unit normals.

    With `working_from_input` the points are in the working frame and are brought back to the input's; without it they stay as they are.

    Raises:
        InputError: not a .ply name, or shapes that do not fit each other.
        OutputError: the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".ply":
        raise InputError(f"points are written as .ply, not {path.suffix or 'without a suffix'}; rename {path.name}")
    points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    colours = np.full(points.shape, 128, np.uint8) if colours is None else as_bytes(colours)
    for name, array in (("colours", colours), ("normals", normals)):
        if array is not None and array.shape != points.shape:
            raise InputError(f"{len(points)} points have {name} of shape {array.shape}; one row a point is needed")
    if working_from_input is not None:
        back = working_from_input.inverse()
        points = back.points(points)
        normals = None if normals is None else back.directions(normals)
    write_ply(path, points, colours, normals)
