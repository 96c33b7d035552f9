"""Point clouds for surveyors' programs: LAS and LAZ by laspy (the extra `las`), E57 by pye57's libE57 (the extra `e57`)."""

from __future__ import annotations

import hashlib
import math
import uuid
from pathlib import Path
from typing import Any

import numpy as np

from fieldfuse.camera import Array
from fieldfuse.errors import InputError, OutputError, first_line
from fieldfuse.export.extras import require
from fieldfuse.files import atomic_path
from fieldfuse.georeference import pyproj
from fieldfuse.tsdf.mesh import as_bytes

FINEST = 1e-6  # steps of LAS coordinates, whole numbers of 32 bits, are at most so much of the cloud's size
RGB = 7  # LAS 1.4's point format with colours; its coordinate system is written as WKT
NORMALS = ("NormalX", "NormalY", "NormalZ")  # of LAS, as extra bytes that CloudCompare and PDAL read by these names
HUES = ("Red", "Green", "Blue")
E57_NORMALS = "http://www.libe57.org/E57_NOR_surface_normals.txt"  # E57's registered extension
ROWS_AT_ONCE = 500_000


def write_cloud(path: Path | str, points: Array, colours: Array, normals: Array | None = None, crs: Any = None) -> None:
    """Write (P, 3) float64 points with (P, 3) colours (uint8, or floating point 0 to 1) and unit normals as .las, .laz or .e57.

    LAS (ASPRS, 1.4, point format 7): whole numbers times a power of ten, which is at most a millionth of the cloud's size, from an
    offset near the points; colours as 16 bits (times 257); normals as extra bytes. E57 (ASTM E2807): doubles; normals by its extension.

    Args:
        crs: the coordinates' reference system, anything that pyproj takes (`EPSG:32632`, WKT); None: coordinates of no place on Earth.

    Raises:
        InputError: another suffix, no points, a place that is not finite, a missing extra, or a reference system that is none.
        OutputError: the file cannot be written.
    """
    path = Path(path)
    kind = path.suffix.lower()
    if kind not in (".las", ".laz", ".e57"):
        raise InputError(f"a point cloud is written as .las, .laz or .e57, not {path.suffix or 'without a suffix'}; rename {path.name}")
    points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    if not len(points) or not np.isfinite(points).all():
        raise InputError(f"{path.name} needs points with finite places, and here are {len(points)}; check what they were made from")
    colours = as_bytes(colours).reshape(-1, 3)
    if len(colours) != len(points) or (normals is not None and np.shape(normals) != points.shape):
        raise InputError(f"{path.name} needs a colour (and a normal, where there are any) for each of {len(points)} points")
    write = _write_e57 if kind == ".e57" else _write_las
    write(path, points, colours, normals, None if crs is None else _crs(crs))


def _crs(given: Any) -> Any:
    proj = pyproj()
    try:
        return proj.CRS.from_user_input(given)
    except proj.exceptions.CRSError as error:
        raise InputError(f"{str(given)[:80]!r} is no coordinate reference system; give an EPSG code or WKT") from error


def las_steps(points: Array) -> tuple[float, Array]:
    """The step of whole numbers, a power of ten, and the offset (3,) for (P, 3) places."""
    low, high = points.min(axis=0), points.max(axis=0)
    size = float((high - low).max()) or 1.0
    scale = 10.0 ** math.floor(math.log10(FINEST * size))
    # Far from its origin a double has no more digits than this.
    scale = max(scale, 10.0 ** math.ceil(math.log10(max(float(np.abs(points).max()), 1e-300) * np.finfo(np.float64).eps)))
    unit = 10.0 ** math.ceil(math.log10(size))  # offsets are round numbers
    return scale, np.round(0.5 * (low + high) / unit) * unit


def _write_las(path: Path, points: Array, colours: Array, normals: Array | None, crs: Any) -> None:
    laspy = require(path.suffix.lower()[1:])
    header = laspy.LasHeader(version="1.4", point_format=RGB)
    scale, header.offsets = las_steps(points)
    header.scales = np.full(3, scale)
    header.generating_software, header.system_identifier = "Fieldfuse", "OTHER"
    if normals is not None:
        header.add_extra_dims([laspy.ExtraBytesParams(name, np.float32, "unit normal") for name in NORMALS])
    if crs is not None:
        header.add_crs(crs)
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = points.T
    cloud.red, cloud.green, cloud.blue = colours.T.astype(np.uint16) * 257
    cloud.return_number[:] = cloud.number_of_returns[:] = 1
    for name, values in zip(NORMALS, () if normals is None else np.asarray(normals, np.float32).T, strict=False):
        cloud[name] = values
    with atomic_path(path) as temporary:
        cloud.write(str(temporary))


def _write_e57(path: Path, points: Array, colours: Array, normals: Array | None, crs: Any) -> None:
    e57 = require("e57").libe57  # pye57 itself writes single precision
    columns = {f"cartesian{axis}": points[:, i] for i, axis in enumerate("XYZ")}
    columns |= {f"color{hue}": colours[:, i] for i, hue in enumerate(HUES)}
    if normals is not None:
        unit = np.clip(np.asarray(normals, np.float32), -1, 1)
        columns |= {f"nor:normal{axis}": unit[:, i] for i, axis in enumerate("XYZ")}
    try:
        with atomic_path(path) as temporary:
            image = e57.ImageFile(str(temporary), "w")
            try:
                image.extensionsAdd("", e57.E57_V1_0_URI)
                image.extensionsAdd("nor", E57_NORMALS)
                rows = _e57_tree(e57, image, points, colours, list(columns), "" if crs is None else crs.to_wkt())
                pieces = {name: np.empty(min(ROWS_AT_ONCE, len(points)), values.dtype) for name, values in columns.items()}
                buffers = e57.VectorSourceDestBuffer()
                for name, piece in pieces.items():
                    buffers.append(e57.SourceDestBuffer(image, name, piece, len(piece), True, True))
                writer = rows.writer(buffers)
                for start in range(0, len(points), ROWS_AT_ONCE):
                    for name, piece in pieces.items():
                        part = columns[name][start : start + ROWS_AT_ONCE]
                        piece[: len(part)] = part
                    writer.write(min(ROWS_AT_ONCE, len(points) - start))
                writer.close()
            finally:
                image.close()
    except e57.E57Exception as error:  # of a full disk, too
        raise OutputError(f"cannot write {path}: {first_line(error)}; free space or choose another folder") from error


def _e57_tree(e57: Any, image: Any, points: Array, colours: Array, names: list[str], crs: str) -> Any:
    """What stands in the file beside the numbers; answers the node of the points, whose columns are `names`."""

    def structure(**values: Any) -> Any:
        node = e57.StructureNode(image)
        for name, value in values.items():
            kind = {int: e57.IntegerNode, float: e57.FloatNode, str: e57.StringNode}.get(type(value))
            node.set(name, value if kind is None else kind(image, value))
        return node

    def guid(what: str) -> str:
        return f"{{{uuid.uuid5(uuid.NAMESPACE_OID, what + content)}}}"

    content = hashlib.sha256(points.tobytes() + colours.tobytes()).hexdigest()
    low, high = points.min(axis=0).tolist(), points.max(axis=0).tolist()
    limits = {f"{axis}Minimum": value for axis, value in zip("xyz", low, strict=True)}
    limits |= {f"{axis}Maximum": value for axis, value in zip("xyz", high, strict=True)}
    prototype = structure(**{name: 0.0 for name in names if name.startswith("cartesian")})
    for name in names:
        if name.startswith("color"):
            prototype.set(name, e57.IntegerNode(image, 0, 0, 255))
        elif name.startswith("nor:"):
            prototype.set(name, e57.FloatNode(image, 0.0, e57.E57_SINGLE, -1.0, 1.0))
    scan = structure(
        guid=guid("points"),
        name="points",
        description="made by Fieldfuse",
        cartesianBounds=structure(**limits),
        colorLimits=structure(**{f"color{hue}{end}": value for hue in HUES for end, value in (("Minimum", 0), ("Maximum", 255))}),
    )
    rows = e57.CompressedVectorNode(image, prototype, e57.VectorNode(image, True))
    scan.set("points", rows)
    scans = e57.VectorNode(image, True)
    head: dict[str, Any] = {
        "formatName": "ASTM E57 3D Imaging Data File",
        "guid": guid("file"),
        "versionMajor": int(e57.E57_FORMAT_MAJOR),
        "versionMinor": int(e57.E57_FORMAT_MINOR),
        "e57LibraryVersion": str(e57.E57_LIBRARY_ID),
        "coordinateMetadata": crs,
        "data3D": scans,
        "images2D": e57.VectorNode(image, True),
    }
    for name, value in head.items():
        kind = {int: e57.IntegerNode, str: e57.StringNode}.get(type(value))
        image.root().set(name, value if kind is None else kind(image, value))
    scans.append(scan)
    return rows
