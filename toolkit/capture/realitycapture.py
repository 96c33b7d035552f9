"""RealityCapture's and RealityScan's cameras: the table "Internal/External camera parameters" (CSV), or an XMP file beside each photo.

The table's first line names its columns: `#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2`; RealityScan 2 has `yaw`,
`f_35mm`, `px_norm` and `py_norm`. The world has z up. Camera to world, in OpenGL axes, is Rz(-heading) · Rx(pitch) · Ry(roll), degrees:
with all of them 0 the camera looks down and the image's top is at +y. The OpenCV-compliant table has `tx`, …, `R00`, … of
camera_from_world and pixels.

XMP (`xcr:`): `Rotation` is camera_from_world row by row in OpenCV axes, `Position` the camera's place. Focal lengths are those of 36 mm
of film along the image's longer side, principal points are shares of that side from the image's middle. Brown's k1 to k3 are OpenCV's,
its k4 is of r⁸; t1 and t2 are OpenCV's p2 and p1.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from scipy.spatial.transform import Rotation

from fieldfuse.camera import Array, Intrinsics, invert, world_from_opengl
from fieldfuse.capture.lenses import with_brown_lens, with_division_lens
from fieldfuse.capture.listing import counted, files_in, images_in, natural_key, numbers, read_text, require_folder
from fieldfuse.capture.posed_list import Listed, exported, listed_capture
from fieldfuse.capture.poses import single_frame
from fieldfuse.capture.types import Capture
from fieldfuse.capture.xml_file import read_xml, starts_with
from fieldfuse.errors import InputError

FILM = 36.0  # mm of the longer side
ALIASES = {"yaw": "heading", "f_35mm": "f", "px_norm": "px", "py_norm": "py"}
ANGLES, PLACE = ("heading", "pitch", "roll"), ("x", "y", "alt")
NEEDED = {"name", *PLACE, *ANGLES, "f"}
ROTATION = [f"r{row}{column}" for row in range(3) for column in range(3)]
NEEDED_OPENCV = {"name", "tx", "ty", "tz", *ROTATION, "f_pix", "px_pix", "py_pix"}
MOST_FILES = 20
DEGREES = 0.02  # how little cameras differ in x and y, against their height, where these are degrees
PLACES = ("", "images")
BROWN = ("brown3", "brown3t2", "brown4", "brown4t2")


def _table(folder: Path) -> Path | None:
    """The table of cameras in a folder."""
    files = sorted(files_in(folder, "*.csv"), key=lambda file: natural_key(file.name))
    return next((file for file in files[:MOST_FILES] if any(starts_with(file, b"#name,", word) for word in (b",roll,", b",R22,"))), None)


def _sidecars(folder: Path) -> list[tuple[Path, Path]]:
    """Images with the XMP file that gives their pose, of the first usual folder that has some."""
    for place in PLACES:
        files = {file.stem: file for file in files_in(folder / place, "*.[xX][mM][pP]")}
        pairs = [(image, files[image.stem]) for image in images_in(folder / place) if image.stem in files] if files else []
        if any(_has_pose(xmp) for _, xmp in pairs[:MOST_FILES]):
            return [(image, xmp) for image, xmp in pairs if _has_pose(xmp)]
    return []


def _has_pose(xmp: Path) -> bool:
    return starts_with(xmp, b"capturingreality.com/ns/xcr", b"Rotation", b"Position")


def looks_like_realitycapture(path: Path) -> bool:
    return exported(path, _table) is not None or bool(_sidecars(path))


def read_realitycapture(path: Path | str) -> Capture:
    """The images of the table, else those with an XMP file; `path` is the folder or the table.

    Raises:
        InputError: a column is missing, positions are degrees, a lens cannot be modelled, or no image exists.
    """
    source = Path(path).absolute()
    table = source if source.is_file() else exported(require_folder(source), _table)
    if table is not None:
        return _read_table(table, source if source.is_dir() else table.parent)
    pairs = _sidecars(source)
    if not pairs:
        raise InputError(f"{source} holds no cameras of RealityCapture; export the registration as CSV or XMP there")
    entries = []
    for image, xmp in pairs:
        with single_frame(image.stem):
            entries.append(_from_xmp(image, xmp))
    if not entries:
        raise InputError(f"none of the {counted(len(pairs), 'XMP file')} in {source} can be read; export them again")
    return listed_capture("realitycapture", pairs[0][1], entries, source, up=(0.0, 0.0, 1.0))


# ------------------------------------------------------------------------------------------------ table


def _read_table(table: Path, root: Path) -> Capture:
    rows, columns = _rows(table)
    entries = [_from_row(row, f"{table}, row {number}") for number, row in rows]
    remarks = []
    if "x" in columns:
        _refuse_degrees(np.array([entry.pose[:3, 3] for entry in entries]), table)
    if all(row.get("k1") not in (None, "", "0") and not any(_number(row, key, "") for key in ("k2", "k3")) for _, row in rows):
        remarks.append(f"{table.name} does not have the lens model; its k1 is taken as Brown's, not as that of the division model")
    return listed_capture("realitycapture", table, entries, root, up=(0.0, 0.0, 1.0), warnings=remarks)


def _rows(table: Path) -> tuple[list[tuple[int, dict[str, str]]], set[str]]:
    """Rows with their line's number as column → word, and the columns."""
    lines = csv.reader(io.StringIO(read_text(table)))
    try:
        header: list[str] = []
        out = []
        for number, words in enumerate(lines, start=1):
            if not header:
                names = [word.strip().lstrip("#").split("(")[0].strip().lower() for word in words]
                header = [ALIASES.get(name, name) for name in names] if "name" in names else []
            elif words and words[0].strip():
                out.append((number, dict(zip(header, (word.strip() for word in words), strict=False))))
    except csv.Error as error:
        raise InputError(f"{table} cannot be read as a table ({error}); export it again") from error
    columns = set(header)
    if not (columns >= NEEDED or columns >= NEEDED_OPENCV):
        lacking = ", ".join(sorted((NEEDED if "heading" in columns or "x" in columns else NEEDED_OPENCV) - columns)[:4])
        raise InputError(f"{table} has no column {lacking}; export \"Internal/External camera parameters\" as CSV")
    if not out:
        raise InputError(f"{table} lists no cameras; align the photos and export again")
    return out, columns


def _number(row: Mapping[str, str], key: str, where: str) -> float:
    word = row.get(key)
    return float(numbers([word], f"{where}: {key!r}")[0]) if word else 0.0


def _from_row(row: dict[str, str], where: str) -> Listed:
    radial = [_number(row, key, where) for key in ("k1", "k2", "k3", "k4")]
    tangential = _number(row, "t2", where), _number(row, "t1", where)
    if "r00" in row:
        pose = np.eye(4)
        pose[:3, :3] = numbers([row.get(key) or "nan" for key in ROTATION], where).reshape(3, 3)
        pose[:3, 3] = numbers([row.get(key) or "nan" for key in ("tx", "ty", "tz")], where)
        f, cx, cy = (_number(row, key, where) for key in ("f_pix", "px_pix", "py_pix"))

        def in_pixels(size: tuple[int, int]) -> Intrinsics:
            return with_brown_lens(Intrinsics(*size, f, f, cx, cy), radial, tangential, where)

        return Listed(row["name"], invert(pose), in_pixels, where)
    heading, pitch, roll = numbers([row.get(key) or "nan" for key in ANGLES], where).tolist()
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("ZXY", [-heading, pitch, roll], degrees=True).as_matrix()
    pose[:3, 3] = numbers([row.get(key) or "nan" for key in PLACE], where)
    f, px, py = (_number(row, key, where) for key in ("f", "px", "py"))

    def of_film(size: tuple[int, int]) -> Intrinsics:
        return with_brown_lens(_on_film(size, f, px, py), radial, tangential, where)

    return Listed(row["name"], world_from_opengl(pose), of_film, where)


def _on_film(size: tuple[int, int], f: float, px: float, py: float, aspect: float = 1.0) -> Intrinsics:
    side = max(size)
    return Intrinsics(*size, f / FILM * side, f * aspect / FILM * side, size[0] / 2 + px * side, size[1] / 2 + py * side)


def _refuse_degrees(places: Array, table: Path) -> None:
    spread = places.max(axis=0) - places.min(axis=0)
    inside = np.abs(places[:, 0]).max() <= 180 and np.abs(places[:, 1]).max() <= 90
    if len(places) > 2 and inside and max(spread[:2]) < DEGREES and spread[2] > 10 * max(spread[:2]):
        raise InputError(
            f"{table}: x and y are degrees of longitude and latitude; export the cameras in a local Euclidean coordinate system"
        )


# ------------------------------------------------------------------------------------------------ XMP


def _values(root: Element) -> dict[str, str]:
    """`xcr:` attributes and elements by their name without prefix."""
    out: dict[str, str] = {}
    for element in root.iter():
        for name, value in (*element.attrib.items(), (element.tag, element.text or "")):
            if name.startswith("xcr:"):
                out.setdefault(name[4:], value.strip())
    return out


def _from_xmp(image: Path, xmp: Path) -> Listed:
    values, where = _values(read_xml(xmp)), str(xmp)

    def value(name: str, default: float) -> float:
        return float(numbers([values[name]], f"{where}: {name!r}")[0]) if values.get(name) else default

    rotation = numbers(values.get("Rotation", "").split(), f"{where}: 'Rotation'", 9).reshape(3, 3)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.T, numbers(values.get("Position", "").split(), f"{where}: 'Position'", 3)
    focal = value("FocalLength35mm", 0.0)
    if not focal:
        raise InputError(f"{where} has no 'FocalLength35mm'; export the XMP files with the calibration")
    u, v, aspect = value("PrincipalPointU", 0.0), value("PrincipalPointV", 0.0), value("AspectRatio", 1.0)
    model = values.get("DistortionModel", "perspective")
    words = values.get("DistortionCoeficients", "").split()
    k1, k2, k3, k4, t1, t2 = numbers([*words, *["0"] * (6 - len(words))], f"{where}: 'DistortionCoeficients'", 6).tolist()

    def camera(size: tuple[int, int]) -> Intrinsics:
        plain = _on_film(size, focal, u, v, aspect)
        if model == "division":
            return with_division_lens(plain, k1, where)
        if model not in (*BROWN, "perspective"):
            raise InputError(f"{where}: the lens model {model[:40]!r} is not supported; choose Brown3 in RealityCapture and export again")
        return with_brown_lens(plain, () if model == "perspective" else (k1, k2, k3, k4), (t2, t1), where)

    return Listed(image.name, pose, camera, where)
