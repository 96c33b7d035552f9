"""The unit of length by ArUco markers or a ChArUco board of known size: their corners in all images give the size that they have in the
poses' units. Detection is OpenCV's (Garrido-Jurado et al. 2014)."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.capture.images import load_image, turns_by_exif
from fieldfuse.capture.listing import counted
from fieldfuse.capture.types import Capture
from fieldfuse.errors import InputError
from fieldfuse.measures import Marker
from fieldfuse.poses.gps import similarity
from fieldfuse.poses.intersect import Sights, meet
from fieldfuse.progress import SILENT, Progress
from fieldfuse.tone import LINEAR

BOARD = -1  # the number of a board among single markers
LEAST_CORNERS = 4  # of a board or marker, seen by two cameras each
FAR_OFF = 4.0  # pixels at a long side of 1600 that a corner may be off
ROBUST = 1.0  # pixels from which on residuals weigh less
DETECTED_TO = 0.1  # pixels, at least, to which corners are taken to be detected
EDGE_REACH = 0.07  # times a marker's side that edges are looked for on either side: about half a module
EDGE_LEAST, EDGE_MOST = 2.0, 12.0  # pixels of that
EDGE_STEP = 0.25  # pixels
EDGE_PART = (0.12, 0.88)  # of an edge that is looked at: corners are round
LEAST_CONTRAST = 0.03  # linear light from black to white
STRAIGHT = 0.2, 0.01  # pixels, and share of an edge, that its points lie beside a line (root mean square): a wide lens bends edges a little
LEAST_EDGE = 0.75  # share of an edge's points that must lie on the line; something lies on the marker otherwise
MOST_MOVED = 4.0  # pixels by which a corner may lie beside the detector's
MOST_VIEWS = 300  # images that are looked at, evenly spread


@dataclass(frozen=True)
class Sized:
    """The unit of length."""

    metres: float  # of one unit of the poses
    error: float  # relative, one standard deviation
    text: str


class Detector:
    """Finds markers of one kind in images."""

    def __init__(self, marker: Marker) -> None:
        """Raises:
        InputError: the dictionary has fewer markers than the board needs.
        """
        self.marker = marker
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, marker.dictionary))
        how = cv2.aruco.DetectorParameters()
        self.board = None
        if marker.squares is not None:
            columns, rows = marker.squares
            if columns * rows // 2 > len(dictionary.bytesList):
                raise InputError(f"marker: {marker.dictionary} has too few markers for a board of {columns}x{rows}; name the board's own")
            self.board = cv2.aruco.CharucoBoard(marker.squares, marker.square, marker.side, dictionary)
            self._charuco = cv2.aruco.CharucoDetector(self.board, cv2.aruco.CharucoParameters(), how)
        else:
            self._aruco = cv2.aruco.ArucoDetector(dictionary, how)

    def corners(self, grey: Array) -> dict[int, tuple[Array, Array, bool]]:
        """By the number of a marker (`BOARD`: of the board) which corners are seen (N,), where (N, 2), pixel centres at +0.5, and whether
        that is exact: False where a marker's edges are not whole and straight, and corners are the detector's own.

        Args:
            grey: (H, W) uint8 sRGB.
        """
        if self.board is not None:
            found, numbers, _, _ = self._charuco.detectBoard(grey)
            if numbers is None or len(numbers) == 0:
                return {}
            return {BOARD: (np.asarray(numbers).ravel(), np.asarray(found, dtype=np.float64).reshape(-1, 2) + 0.5, True)}
        outlines, numbers, _ = self._aruco.detectMarkers(grey)
        if numbers is None:
            return {}
        seen: dict[int, list[Any]] = defaultdict(list)
        for number, corner in zip(np.asarray(numbers).ravel(), outlines, strict=True):
            rough = np.asarray(corner, dtype=np.float64).reshape(4, 2)
            fine = refined(grey, rough)
            seen[int(number)].append((rough + 0.5, False) if fine is None else (fine + 0.5, True))
        # Of a marker that an image shows twice nothing says which is which.
        return {number: (np.arange(4), *places[0]) for number, places in seen.items() if len(places) == 1}

    def shape(self, number: int) -> Array:
        """(N, 3) corners in metres, in the order in which `corners` numbers them."""
        if number == BOARD and self.board is not None:
            return np.asarray(self.board.getChessboardCorners(), dtype=np.float64).reshape(-1, 3)
        half = self.marker.side / 2
        return np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])


def refined(grey: Array, corners: Array) -> Array | None:
    """(4, 2) corners of a black square on white where straight lines along its edges meet, from corners (4, 2) near to them; pixel centres
    are whole numbers. None: an edge is not seen whole, or is not straight, as where something lies on it.

    An edge lies where light, not its sRGB value, is half way from black to white: a lens and a pixel take means of light. By sRGB values
    a black square of 40 pixels comes out half a pixel too small.
    """
    rim = int(MOST_MOVED + EDGE_MOST + 2)
    left, top = np.maximum(np.floor(corners.min(axis=0)).astype(int) - rim, 0)
    right, bottom = np.ceil(corners.max(axis=0)).astype(int) + rim + 1
    light, origin = LINEAR[grey[top:bottom, left:right]], np.array([left, top])
    lines = []
    for first, second in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        along, length = second - first, float(np.linalg.norm(second - first))
        outward = np.array([along[1], -along[0]]) / max(length, 1e-9)
        outward *= np.sign((first - corners.mean(axis=0)) @ outward) or 1.0
        reach = float(np.clip(EDGE_REACH * length, EDGE_LEAST, EDGE_MOST))
        at, steps = np.linspace(*EDGE_PART, max(8, round(length))), np.arange(-reach, reach + 1e-9, EDGE_STEP)
        across, down = np.moveaxis(first - origin + at[:, None, None] * along + steps[None, :, None] * outward, -1, 0).astype(np.float32)
        profile = cv2.remap(light, across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        half = len(steps) // 2
        # The darkest within and the brightest without: farther off the marker's bits, and what it lies on, begin to shine in.
        dark, bright = profile[:, : half + 1].min(axis=1), profile[:, half:].max(axis=1)
        above = (profile > (0.5 * (dark + bright))[:, None]) & (np.arange(len(steps)) > profile[:, : half + 1].argmin(axis=1)[:, None])
        right_of = np.clip(above.argmax(axis=1), 1, None)
        rows = np.arange(len(at))
        low, high = profile[rows, right_of - 1], profile[rows, right_of]
        edge = steps[right_of] - EDGE_STEP * (high - 0.5 * (dark + bright)) / np.maximum(high - low, 1e-6)
        fine = above.any(axis=1) & (bright - dark > LEAST_CONTRAST) & (np.abs(edge) < reach - 0.25)
        points = first + at[:, None] * along + edge[:, None] * outward
        for _ in range(3):
            if fine.sum() < 4:
                return None
            middle = points[fine].mean(axis=0)
            normal = np.linalg.svd(points[fine] - middle)[2][1]
            off = np.abs((points - middle) @ normal)
            fine &= off < max(0.3, 3 * float(np.median(off[fine])))
        if fine.mean() < LEAST_EDGE or np.sqrt((off[fine] ** 2).mean()) > max(STRAIGHT[0], STRAIGHT[1] * length):
            return None
        lines.append((normal, float(normal @ middle)))
    met = []
    for before, after in zip(np.roll(np.arange(4), 1), np.arange(4), strict=True):
        normals = np.array([lines[before][0], lines[after][0]])
        if abs(np.linalg.det(normals)) < 0.1:
            return None
        met.append(np.linalg.solve(normals, [lines[before][1], lines[after][1]]))
    found = np.array(met)
    return found if np.abs(found - corners).max() < MOST_MOVED else None


def scale_by_markers(capture: Capture, marker: Marker, progress: Progress = SILENT) -> Sized:
    """The unit of length by all markers that two or more of a posed capture's images show.

    Raises:
        InputError: no image, or only one, shows a marker, or the corners do not fit together.
    """
    detector, exif = Detector(marker), turns_by_exif(capture)
    seen: dict[int, list[tuple[int, Array, Array, bool]]] = defaultdict(list)  # marker → image, which corners, pixels, whether exact
    cameras: list[Intrinsics] = []
    poses: list[Array] = []
    frames = [frame for frame in capture.frames if frame.intrinsics is not None and frame.world_from_camera is not None]
    for index in np.unique(np.linspace(0, len(frames) - 1, min(len(frames), MOST_VIEWS)).round().astype(int)):
        frame = frames[int(index)]
        progress.check()
        progress.update(int(index), len(frames), f"looking for markers, {frame.name}")
        assert frame.intrinsics is not None and frame.world_from_camera is not None
        image = np.ascontiguousarray(load_image(frame, exif=exif)[..., :3])
        camera = frame.intrinsics.scaled(image.shape[1], image.shape[0])
        for number, (which, places, exact) in detector.corners(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)).items():
            seen[number].append((len(cameras), which, places, exact))
        cameras.append(camera)
        poses.append(frame.world_from_camera)
    what = "the board" if marker.squares is not None else f"a marker of {marker.dictionary}"
    if not seen:
        raise InputError(
            f"none of the {counted(len(cameras), 'image')} of {capture.root} shows {what}; check the dictionary, and that it is sharp, "
            "flat and at least 40 pixels wide, with a white rim"
        )
    found = _all_sized(detector, seen, cameras, np.array(poses), True) or _all_sized(detector, seen, cameras, np.array(poses), False)
    if not found:
        raise InputError(
            f"{what} is seen, but in no two images from different places whose poses agree on its corners; take more images of it, and "
            "give each marker of the capture another number"
        )
    logs, errors = np.log([one[0] for one in found]), np.array([one[1] for one in found])
    weights = 1 / errors**2
    mean = float((weights * logs).sum() / weights.sum())
    error = float(1 / np.sqrt(weights.sum()))
    if len(found) > 1:  # or by how much they differ, if that is more
        error = max(error, float(np.sqrt((weights * (logs - mean) ** 2).sum() / weights.sum() / (len(found) - 1))))
    many = "the board" if marker.squares is not None else counted(len(found), "marker")
    seen_by = max(one[2] for one in found)
    text = f"{many} of known size in {seen_by} images: one unit of the poses is {np.exp(mean):.6g} m, ±{100 * error:.2g}%"
    return Sized(float(np.exp(mean)), error, text)


def _all_sized(
    detector: Detector, seen: dict[int, list[tuple[int, Array, Array, bool]]], cameras: list[Intrinsics], poses: Array, only_exact: bool
) -> list[tuple[float, float, int]]:
    """`_sized` of all markers that have one: by exact corners, or by all, which make them too small."""
    found = []
    for number in sorted(seen):
        corners: dict[int, list[tuple[int, Array]]] = defaultdict(list)
        for image, which, places, exact in seen[number]:
            if exact or not only_exact:
                for corner, place in zip(which, places, strict=True):
                    corners[int(corner)].append((image, place))
        if (one := _sized(detector.shape(number), corners, cameras, poses)) is not None:
            found.append(one)
    return found


def _sized(
    shape: Array, seen: dict[int, list[tuple[int, Array]]], cameras: list[Intrinsics], poses: Array
) -> tuple[float, float, int] | None:
    """Metres of one unit of the poses by one marker or board (corners `shape`), the relative error, and how many images show it.

    Position, turn and size are those with which its corners project nearest to where images show them.
    """
    which, points, sights = [], [], []
    for corner, places in seen.items():
        own = Sights.of([cameras[index] for index, _ in places], poses[[index for index, _ in places]], np.array([at for _, at in places]))
        far = FAR_OFF * max(max(cameras[index].width, cameras[index].height) for index, _ in places) / 1600
        met = meet(own, max(far, 1.0))
        if met is not None:
            which.append(corner)
            points.append(met.point)
            sights.append(own)
    if len(which) < LEAST_CORNERS:
        return None
    start = similarity(shape[which], np.array(points))
    if start.scale <= 0:
        return None
    middle = shape[which].mean(axis=0)
    size = float(np.linalg.norm(shape[which] - middle, axis=1).mean()) * start.scale

    def off(change: Array) -> Array:
        turn = Rotation.from_rotvec(change[3:6] / size).as_matrix() @ start.rotation
        placed = start.scale * np.exp(change[6]) * (shape[which] - middle) @ turn.T + start.points(middle) + change[:3]
        return np.clip(np.concatenate([one.off(point).ravel() for one, point in zip(sights, placed, strict=True)]), -1e3, 1e3)

    fit = least_squares(off, np.zeros(7), loss="soft_l1", f_scale=ROBUST, x_scale=[size] * 6 + [1.0])
    weights = 1 / np.sqrt(1 + (fit.fun / ROBUST) ** 2)
    variance = max(float((weights * fit.fun**2).sum() / max(weights.sum() - 7, 1)), DETECTED_TO**2)
    covariance = np.linalg.pinv(fit.jac.T @ fit.jac) * variance
    views = max(len(one) for one in sights)
    return 1 / (start.scale * float(np.exp(fit.x[6]))), float(np.sqrt(covariance[6, 6])), views
