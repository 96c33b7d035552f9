"""Binary PLY: points or vertices with colours and normals, triangles when there are any."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fieldfuse.camera import Array, Similarity
from fieldfuse.errors import InputError
from fieldfuse.files import atomic_path
from fieldfuse.tsdf.mesh import as_bytes

# float32 positions are kept when their rounding stays below this share of the model's size; else float64 is written.
PRECISION = 1e-7


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


def write_ply(path: Path | str, points: Array, colours: Array, normals: Array | None = None, triangles: Array | None = None) -> None:
    """Write (P, 3) points, (P, 3) uint8 colours, and where given (P, 3) normals and (T, 3) triangles.

    Positions are `float`, or `double` where `float` would round them by more than a ten-millionth of the model's size (a model far from
    its frame's origin). Colours are `uchar` red, green, blue, as every viewer expects them.

    Raises:
        OutputError: the file cannot be written.
    """
    points = np.asarray(points, dtype=np.float64)
    real, name = ("<f4", "float") if single_precision(points) else ("<f8", "double")
    fields = [(axis, real) for axis in "xyz"]
    lines = [f"property {name} {axis}" for axis in "xyz"]
    if normals is not None:
        fields += [(axis, "<f4") for axis in ("nx", "ny", "nz")]
        lines += [f"property float {axis}" for axis in ("nx", "ny", "nz")]
    fields += [(channel, "u1") for channel in ("red", "green", "blue")]
    lines += [f"property uchar {channel}" for channel in ("red", "green", "blue")]
    rows = np.zeros(len(points), dtype=fields)
    for i in range(3):
        rows["xyz"[i]] = points[:, i]
        rows[("red", "green", "blue")[i]] = colours[:, i]
        if normals is not None:
            rows[("nx", "ny", "nz")[i]] = normals[:, i]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}", *lines]
    faces = np.zeros(0 if triangles is None else len(triangles), dtype=[("count", "u1"), ("corner", "<i4", (3,))])
    if triangles is not None:
        header += [f"element face {len(triangles)}", "property list uchar int vertex_indices"]
        faces["count"], faces["corner"] = 3, triangles
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(("\n".join([*header, "end_header"]) + "\n").encode("ascii"))
        file.write(rows.tobytes())
        file.write(faces.tobytes())


def single_precision(points: Array) -> bool:
    """Whether float32 holds (P, 3) positions well enough for a model of their size."""
    if len(points) == 0:
        return True
    size = float(np.max(points.max(axis=0) - points.min(axis=0)))
    return bool(np.abs(points).max() * np.finfo(np.float32).eps / 2 <= PRECISION * size)
