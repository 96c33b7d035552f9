"""Agisoft Metashape's cameras (File › Export › Export Cameras, XML), with the images beside the file or in a folder below.

A `camera` has a label (the image's name, mostly without suffix) and, where it was aligned, a `transform`: 16 numbers row by row, from
its own OpenCV axes into its component's frame. The component (or the chunk) may have a `transform` of its own: rotation, translation and
scale into the world. With a georeference the world is geocentric (WGS 84, metres); it is turned here into east, north, up around the
cameras' middle.

Lens (user manual, "Camera models"): x = X/Z, y = Y/Z, r² = x² + y²,
x' = x (1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸) + p1 (r² + 2x²) + 2 p2 x y, y' likewise with x and y, p1 and p2 exchanged: OpenCV's p2 and p1;
u = w/2 + cx + x' (f + b1) + y' b2, v = h/2 + cy + y' f. A fisheye's x and y are first scaled to the angle from the axis. A spherical
sensor's images are panoramas whose middle looks along z. PhotoScan until 1.2 has fx, fy, skew, cx and cy in pixels, p1 and p2 as OpenCV.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from fieldfuse.camera import FISHEYE, Intrinsics, Similarity
from fieldfuse.capture.calibration import panorama, usable_size
from fieldfuse.capture.lenses import with_brown_lens
from fieldfuse.capture.listing import counted, files_in, natural_key, numbers, require_folder
from fieldfuse.capture.posed_list import Listed, exported, listed_capture
from fieldfuse.capture.poses import checked_pose
from fieldfuse.capture.types import Capture
from fieldfuse.capture.xml_file import read_xml, starts_with
from fieldfuse.errors import InputError
from fieldfuse.georeference import Georeference, geographic

MOST_FILES = 20
SPHERE = "spherical"
SHIFT = 0.5  # pixels by which what OpenCV's lens lacks (skew, a fisheye's tangential terms) may move a point without a word
SKEWED = 0.05  # of the focal length
GEOCENTRIC = 6.2e6  # metres from the origin beyond which coordinates are geocentric


def _export(folder: Path) -> Path | None:
    """The exported cameras in a folder: `cameras.xml`, else the first file that begins like one."""
    found = sorted(files_in(folder, "*.xml"), key=lambda file: (file.name != "cameras.xml", natural_key(file.name)))
    return next((file for file in found[:MOST_FILES] if starts_with(file, b"<document", b"<chunk")), None)


def looks_like_metashape(path: Path) -> bool:
    return exported(path, _export) is not None


def read_metashape(path: Path | str) -> Capture:
    """The aligned cameras of a chunk's largest component that have an image; `path` is the folder or the XML file.

    Raises:
        InputError: no camera is aligned, a lens that is none of a perspective or fisheye image, or broken XML.
    """
    source = Path(path).absolute()
    file = source if source.is_file() else exported(require_folder(source), _export)
    if file is None:
        raise InputError(f"{source} holds no cameras of Metashape; export them as XML there (File › Export › Export Cameras)")
    chunks = [chunk for chunk in read_xml(file).iter("chunk") if chunk.find("cameras") is not None]
    if not chunks:
        raise InputError(f"{file} holds no cameras; export them from Metashape as XML (File › Export › Export Cameras)")
    chunk = chunks[0]
    remarks = [f"{file.name} holds {len(chunks)} chunks; the first is used"] if len(chunks) > 1 else []
    lenses, lens_remarks = _lenses(chunk, file)
    aligned, counts = _aligned(chunk, lenses)
    if not aligned:
        many = counted(sum(counts.values()), "camera")
        raise InputError(f"{file}: none of {many} is aligned; align the photos in Metashape and export again")
    by_component: dict[str, list[Element]] = {}
    for camera in aligned:
        by_component.setdefault(camera.get("component_id") or "", []).append(camera)
    component = max(by_component, key=lambda key: len(by_component[key]))
    used = by_component[component]
    counts["in other components"] = len(aligned) - len(used)
    remarks += [f"{counted(many, 'camera is', 'cameras are')} {why} and not used" for why, many in counts.items() if many]
    world = _world(chunk, component, str(file))
    names = _names(chunk)
    entries = []
    for camera in used:
        where = f"{file.name}, camera {names[camera][:80]!r}"
        matrix = numbers((camera.findtext("transform") or "").split(), f"{where}: 'transform'", 16).reshape(4, 4)
        lens = lenses[camera.get("sensor_id") or ""]
        entries.append(Listed(names[camera], world.poses(checked_pose(matrix, where)), lens, where))
    facts: dict[str, Any] = {}
    centres = np.array([entry.pose[:3, 3] for entry in entries])
    middle = centres[np.isfinite(centres).all(axis=1)].mean(axis=0) if np.isfinite(centres).all(axis=1).any() else np.zeros(3)
    if GEOCENTRIC < np.linalg.norm(middle) < 2 * GEOCENTRIC and not (chunk.findtext("reference") or "").lstrip().startswith("LOCAL"):
        latitude, longitude, altitude = geographic(middle).tolist()
        level = Georeference(latitude, longitude, altitude).enu_from_ecef()
        entries = [replace(entry, pose=level.poses(entry.pose)) for entry in entries]
        place = {"latitude": latitude, "longitude": longitude, "altitude": altitude}
        facts = {"up": (0.0, 0.0, 1.0), "metric": True, "extra": {"reference_lla": place}}
    root = source if source.is_dir() else file.parent
    return listed_capture("metashape", file, entries, root, warnings=[*remarks, *lens_remarks], **facts)


def _aligned(chunk: Element, lenses: dict[str, Intrinsics]) -> tuple[list[Element], dict[str, int]]:
    """Cameras that can be used, and how many cannot, by the reason."""
    out: list[Element] = []
    counts = {"disabled": 0, "not aligned": 0, "without a calibration": 0}
    for camera in chunk.iter("camera"):
        if camera.get("enabled", "true").lower() in ("false", "0"):
            counts["disabled"] += 1
        elif camera.find("transform") is None:
            counts["not aligned"] += 1
        elif (camera.get("sensor_id") or "") not in lenses:
            counts["without a calibration"] += 1
        else:
            out.append(camera)
    return out, counts


def _names(chunk: Element) -> dict[Element, str]:
    """Names of cameras' images: their labels, with the name of their group before it if some label stands for several."""
    cameras = list(chunk.iter("camera"))
    labels = {camera: camera.get("label") or "" for camera in cameras}
    if len(set(labels.values())) < len(cameras):
        for group in chunk.iter("group"):
            labels |= {camera: f"{group.get('label')}/{labels[camera]}" for camera in group.findall("camera")}
    return labels


def _world(chunk: Element, component: str, where: str) -> Similarity:
    """World from the component's frame."""
    found = [part.find("transform") for part in chunk.iter("component") if part.get("id") == component]
    transform = next((part for part in (*found, chunk.find("transform")) if part is not None), None)
    if transform is None:
        return Similarity.identity()
    nine, three, one = (transform.findtext(name) for name in ("rotation", "translation", "scale"))
    matrix = np.eye(4)
    if nine:
        matrix[:3, :3] = numbers(nine.split(), f"{where}: the component's 'rotation'", 9).reshape(3, 3)
    if three:
        matrix[:3, 3] = numbers(three.split(), f"{where}: the component's 'translation'", 3)
    scale = float(numbers([one], f"{where}: the component's 'scale'")[0]) if one else 1.0
    if not 1e-12 < scale < 1e12:
        raise InputError(f"{where}: the component's scale is {scale:g}; export the cameras again")
    matrix = checked_pose(matrix, f"{where}, the component's transform")
    return Similarity(scale, matrix[:3, :3], matrix[:3, 3])


def _lenses(chunk: Element, file: Path) -> tuple[dict[str, Intrinsics], list[str]]:
    """Camera by the sensor's id, where it is calibrated; and remarks on what is left out of a lens."""
    out: dict[str, Intrinsics] = {}
    remarks: list[str] = []
    for sensor in chunk.iter("sensor"):
        calibrations = sorted(sensor.findall("calibration"), key=lambda one: one.get("class") != "adjusted")
        kind = sensor.get("type") or "frame"
        where = f"{file}, sensor {(sensor.get('label') or sensor.get('id') or '')[:40]!r}"
        if kind == SPHERE:
            out[sensor.get("id") or ""] = panorama(*_size(sensor, None, where), where)
        elif calibrations:
            out[sensor.get("id") or ""] = _lens(sensor, calibrations[0], kind, where, remarks)
    return out, list(dict.fromkeys(remarks))


def _size(sensor: Element, calibration: Element | None, where: str) -> tuple[int, int]:
    """Of the images that a calibration is for, in pixels."""
    found = [part.find("resolution") for part in (calibration, sensor) if part is not None]
    resolution = next((one for one in found if one is not None), None)
    sides = [] if resolution is None else [resolution.get("width"), resolution.get("height")]
    width, height = numbers(sides, f"{where}: 'resolution'", 2).tolist()
    return usable_size(width, height, where)


def _lens(sensor: Element, calibration: Element, kind: str, where: str, remarks: list[str]) -> Intrinsics:
    def value(name: str) -> float:
        text = calibration.findtext(name)
        return float(numbers([text], f"{where}: {name!r}")[0]) if text else 0.0

    if kind not in ("frame", "fisheye"):
        raise InputError(f"{where}: a camera of type {kind[:40]!r} is not supported; undistort the images in Metashape and export again")
    width, height = _size(sensor, calibration, where)
    old = calibration.find("fx") is not None
    if calibration.find("f") is None and not old:
        raise InputError(f"{where}: there is no focal length ('f'); export the cameras again")
    f, b1, b2 = (value("fy"), value("fx") - value("fy"), value("skew")) if old else (value("f"), value("b1"), value("b2"))
    p1, p2 = (value("p2"), value("p1")) if old else (value("p1"), value("p2"))
    middle = (0.0, 0.0) if old else (width / 2, height / 2)
    camera = Intrinsics(width, height, f + b1, f, middle[0] + value("cx"), middle[1] + value("cy")).checked(where)
    if abs(b2) > SKEWED * f:
        raise InputError(f"{where}: the camera is skewed (b2 is {b2:g}), which is not supported; undistort the images in Metashape first")
    if abs(b2) * height / (2 * f) > SHIFT:
        remarks.append(f"the skew of {where.rsplit(', ', 1)[1]} (b2, up to {abs(b2) * height / (2 * f):.1f} pixels) is left out")
    if value("p3") or value("p4"):
        raise InputError(f"{where}: the coefficients p3 and p4 are not supported; optimize the cameras without them and export again")
    radial = [value(name) for name in ("k1", "k2", "k3", "k4")]
    if kind == "frame":
        return with_brown_lens(camera, radial, (p2, p1), where)
    moved = 3 * max(abs(p1), abs(p2)) * float(np.hypot(width, height) / 2) ** 2 / f
    if moved > SHIFT:
        remarks.append(f"the tangential terms of the fisheye {where.rsplit(', ', 1)[1]} (up to {moved:.1f} pixels) are left out")
    return replace(camera, lens=FISHEYE, distortion=tuple(radial)).checked(where)
