"""The unit of length by measured distances between marked points. A point is where its marks' rays meet; of one that is marked in a single
image the others are searched along its ray for where they show the same."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from fieldfuse.camera import Array, Intrinsics, project, unproject
from fieldfuse.capture.images import load_depth, load_image, turns_by_exif
from fieldfuse.capture.listing import some_of
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.errors import InputError
from fieldfuse.measures import Mark, Measurement
from fieldfuse.poses.intersect import Found, Sights, meet
from fieldfuse.poses.markers import Sized
from fieldfuse.poses.overlap import guessed_depth

CLICK = 1.0  # pixels, standard deviation of a mark that a person sets, at a long side of 1600
NEIGHBOURS = 8  # images in which a point is searched
NARROW, WIDE = 1.0, 35.0  # degrees between rays to a neighbour
SIDES = (1600, 800, 400)  # long sides of images that are searched, from fine to coarse
HALF = 10  # pixels: half side of a patch
SPREAD = 0.25  # of that: standard deviation of the weights of its pixels; what lies beside an edge counts less than what was clicked on
AGREE = 3  # images, at least, whose rays must meet
COARSE, FINE = 400, 41  # depths that are tried
REACH = 30.0  # times nearer and farther than the cameras' own depth that are searched
SAME = 0.6  # correlation with a neighbour from which on it shows the same,
CLEAR = 0.1  # and by which that of a depth apart must be lower
MATCHED_TO = 3.0  # pixels, at a long side of 1600, that a match may be off the others
AROUND = 20  # sparse points whose depth is the first guess
SENSED = 0.01  # relative error of a sensor's depth
DIFFERENT = 1e-6  # relative: points that lie nearer to each other are one


@dataclass(frozen=True)
class View:
    """A posed image in grey, at several sizes."""

    name: str
    grey: list[Array]  # (H, W) uint8 at the long sides `SIDES`, or as large as it is
    camera: Intrinsics  # of the image as it is, with its lens
    pose: Array  # (4, 4)

    def at(self, points: Array, size: int) -> Array:
        """(N, 2) float32 where world points (N, 3) lie in `grey[size]`, pixel centres whole numbers; NaN behind the camera."""
        height, width = self.grey[size].shape
        pixels, _ = project(self.camera.scaled(width, height), self.pose, points)
        return (pixels - 0.5).astype(np.float32)


class Views:
    """The images of a posed capture, read when they are needed."""

    def __init__(self, capture: Capture) -> None:
        self.capture, self.exif = capture, turns_by_exif(capture)
        self.frames = [frame for frame in capture.frames if frame.intrinsics is not None and frame.world_from_camera is not None]
        self.poses = np.array([frame.world_from_camera for frame in self.frames], dtype=np.float64)
        self._read: dict[int, View] = {}

    def index(self, mark: Mark) -> int:
        """Of the image that a mark names.

        Raises:
            InputError: it has no pose.
        """
        frame = named(self.capture, mark)
        if frame.name not in (names := [one.name for one in self.frames]):
            raise InputError(f"scale: the image {frame.name} has no pose, so a mark in it gives no place; mark another")
        return names.index(frame.name)

    def __getitem__(self, index: int) -> View:
        if index not in self._read:
            frame = self.frames[index]
            image = np.ascontiguousarray(load_image(frame, exif=self.exif)[..., :3])
            grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
            assert frame.intrinsics is not None and frame.world_from_camera is not None
            sizes = []
            for side in SIDES:
                factor = side / max(grey.shape)
                sizes.append(cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA) if factor < 1 else grey)
            camera = frame.intrinsics.scaled(image.shape[1], image.shape[0])
            self._read[index] = View(frame.name, sizes, camera, frame.world_from_camera)
        return self._read[index]


def named(capture: Capture, mark: Mark) -> Frame:
    """The frame that a mark names: by its name, its file's, or that without a suffix.

    Raises:
        InputError: there is none, or there are several.
    """
    keys = (lambda f: f.name, lambda f: f.image.name, lambda f: f.image.stem, lambda f: Path(f.name).stem)
    for key in keys:
        found = [frame for frame in capture.frames if key(frame) == mark.image]
        if len(found) == 1:
            return found[0]
        if found:
            raise InputError(f"scale: {len(found)} images are called {mark.image}; give the name with its folder, as {found[0].name}")
    names = [frame.name for frame in capture.frames]
    raise InputError(f"scale: {capture.root} has no image {mark.image!r}; there are {some_of(names, 4)}")


def check_marks(capture: Capture, measured: list[Measurement]) -> None:
    """Refuse marks in images that are not there, before anything long is started.

    Raises:
        InputError: as for `named`.
    """
    for one in measured:
        for mark in (*one.first, *one.second):
            named(capture, mark)


def scale_by_marks(capture: Capture, measured: list[Measurement]) -> Sized:
    """The unit of length by measured distances in a posed capture.

    Raises:
        InputError: a mark lies outside its image, its point cannot be found, or two points are the same.
    """
    views, logs, errors, marks = Views(capture), [], [], set()
    for one in measured:
        a, b = _point(views, one.first), _point(views, one.second)
        way = b.point - a.point
        apart = float(np.linalg.norm(way))
        if not apart > DIFFERENT * guessed_depth(views.poses):
            raise InputError("scale: the two marked points are one and the same; mark points that lie apart")
        along = way / apart
        logs.append(np.log(one.metres / apart))
        errors.append(float(np.sqrt(along @ (a.covariance + b.covariance) @ along)) / apart)
        marks |= set(one.first) | set(one.second)
    weights = 1 / np.array(errors) ** 2
    mean = float((weights * logs).sum() / weights.sum())
    error = float(1 / np.sqrt(weights.sum()))
    if len(logs) > 1:
        error = max(error, float(np.sqrt((weights * (np.array(logs) - mean) ** 2).sum() / weights.sum() / (len(logs) - 1))))
    many = "a measured distance" if len(logs) == 1 else f"{len(logs)} measured distances"
    text = f"{many} between points marked {len(marks)} times: one unit of the poses is {np.exp(mean):.6g} m, ±{100 * error:.2g}%"
    return Sized(float(np.exp(mean)), error, text)


def _point(views: Views, marks: tuple[Mark, ...]) -> Found:
    """Where a marked point is."""
    indices = [views.index(mark) for mark in marks]
    for mark, index in zip(marks, indices, strict=True):
        camera = views[index].camera
        if not (0 <= mark.x <= camera.width and 0 <= mark.y <= camera.height):
            size = f"{camera.width}×{camera.height}"
            raise InputError(f"scale: {mark.x:g},{mark.y:g} lies outside of {mark.image}, which has {size} pixels; correct the mark")
    pixels = np.array([[mark.x, mark.y] for mark in marks])
    click = CLICK * max(views[index].camera.width for index in indices) / 1600
    if len(marks) == 1:
        return _searched(views, indices[0], pixels[0], marks[0])
    sights = Sights.of([views[index].camera for index in indices], views.poses[indices], pixels)
    found = meet(sights, 20 * click, click)
    if found is None:
        where = some_of([mark.image for mark in marks], 4)
        raise InputError(
            f"scale: the marks of a point in {where} do not meet in one place: they are of different points, or the images are taken from "
            "too near to each other; mark the same point in images from places apart"
        )
    return found


# ------------------------------------------------------------------------------------------------ a point marked once


def _searched(views: Views, index: int, pixel: Array, mark: Mark) -> Found:
    """A point that is marked in one image: matched along its ray, or with a sensor's depth."""
    view = views[index]
    ray = Sights.of([view.camera], view.pose[None], pixel[None])
    if len(ray) == 1 and (found := _matched(views, index, ray, pixel)) is not None:
        return found
    frame = views.frames[index]
    if len(ray) == 1 and frame.depth is not None and frame.depth_intrinsics is None:
        depth = load_depth(frame, views.capture)
        height, width = depth.shape
        column, row = (pixel * [width / view.camera.width, height / view.camera.height]).astype(int)
        part = depth[max(0, row - 1) : row + 2, max(0, column - 1) : column + 2]
        if (part > 0).any():
            z = float(np.median(part[part > 0]))
            point = _on_ray(ray, np.array([z]))[0]
            axis = (point - view.pose[:3, 3]) / np.linalg.norm(point - view.pose[:3, 3])
            side = CLICK * z / float(ray.focal[0])
            return Found(point, (SENSED * z) ** 2 * np.outer(axis, axis) + side**2 * np.eye(3), 0.0, 1)
    raise InputError(
        f"scale: what {mark.image} shows at {mark.x:g},{mark.y:g} is not found in other images (it has no texture, or is not seen there); "
        f'mark the point in two images or more: "{mark.image}:{mark.x:g},{mark.y:g} IMAGE:x,y to … = LENGTH"'
    )


def _on_ray(ray: Sights, depth: Array) -> Array:
    """(N, 3) points at (N,) depths along z of a sight's camera."""
    local = np.concatenate([ray.ideal[0], [1.0]]) * depth[:, None]
    return np.asarray(local @ ray.pose[0, :3, :3].T + ray.pose[0, :3, 3])


def _matched(views: Views, index: int, ray: Sights, pixel: Array) -> Found | None:
    """The point, by patches around it in other images; None where these do not agree on one depth."""
    view, usual = views[index], _usual_depth(views, index, pixel)
    inverses, size = np.geomspace(REACH / usual, 1 / (REACH * usual), COARSE), len(SIDES) - 1
    others, depth = list[int](), 0.0
    while size >= 0:
        depths = 1 / inverses
        if not others:
            others = _neighbours(views, index, _on_ray(ray, np.array([usual]))[0])
            if not others:
                return None
        scores = _scores(views, view, ray, pixel, depths, others, size)
        best = int(scores.argmax())
        if scores[best] < SAME:
            return None
        apart = np.abs(np.log(depths / depths[best])) > 0.15
        if size == len(SIDES) - 1 and apart.any() and scores[apart].max() > scores[best] - CLEAR:
            return None
        depth = float(depths[best])
        if size == len(SIDES) - 1:
            others = _neighbours(views, index, _on_ray(ray, np.array([depth]))[0]) or others
        step = abs(np.log(inverses[1] / inverses[0]))
        inverses = np.exp(np.linspace(-2.5 * step, 2.5 * step, FINE)) / depth
        size -= 1
    return _aligned(views, view, ray, pixel, depth, others)


def _usual_depth(views: Views, index: int, pixel: Array) -> float:
    """Of the sparse points that lie around a pixel, if there are any; else one that fits the cameras."""
    points, view = views.capture.points, views[index]
    if points is not None and len(points):
        at, depth = project(view.camera, view.pose, np.asarray(points, dtype=np.float64))
        off = np.linalg.norm(np.where(np.isfinite(at), at, np.inf) - pixel, axis=1)
        near = np.argsort(off)[:AROUND]
        near = near[off[near] < 0.2 * view.camera.width]
        if len(near):
            return float(np.median(depth[near]))
    return guessed_depth(views.poses)


def _neighbours(views: Views, index: int, point: Array) -> list[int]:
    """Images that see a point from places which are apart, but look at it in much the same way; the best angles first."""
    centres = views.poses[:, :3, 3]
    rays = point - centres
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
    angle = np.rad2deg(np.arccos(np.clip(rays @ rays[index], -1, 1)))
    ahead = np.einsum("ij,ij->i", rays, views.poses[:, :3, 2]) > 0.3
    chosen = np.flatnonzero((angle > NARROW) & (angle < WIDE) & ahead & (np.arange(len(angle)) != index))
    inside = []
    for one in chosen[np.argsort(np.abs(angle[chosen] - 8.0))]:
        frame = views.frames[int(one)]
        assert frame.intrinsics is not None and frame.world_from_camera is not None
        at, _ = project(frame.intrinsics, frame.world_from_camera, point[None])
        if (at[0] >= 0).all() and at[0, 0] < frame.intrinsics.width and at[0, 1] < frame.intrinsics.height:
            inside.append(int(one))
        if len(inside) == NEIGHBOURS:
            break
    return inside


def _patch(view: View, pixel: Array, size: int) -> tuple[Array, Array]:
    """Where a patch's pixels lie in the image without its lens, as offsets (P, 2) in pixels of `grey[size]`, and their greys (P,)."""
    offsets = np.stack(np.meshgrid(np.arange(-HALF, HALF + 1), np.arange(-HALF, HALF + 1)), axis=-1).reshape(-1, 2).astype(np.float64)
    grey = view.grey[size]
    at = pixel * [grey.shape[1] / view.camera.width, grey.shape[0] / view.camera.height] - 0.5 + offsets
    return offsets, _sampled(grey, at)


def _sampled(grey: Array, at: Array) -> Array:
    """(N,) float32 at places (N, 2), pixel centres whole numbers; NaN outside."""
    at = np.asarray(at, dtype=np.float32)
    inside = (at[:, 0] >= 0) & (at[:, 1] >= 0) & (at[:, 0] <= grey.shape[1] - 1) & (at[:, 1] <= grey.shape[0] - 1)  # NaN is not, either
    place = np.where(inside[:, None], at, 0)
    count = len(place)
    width = 1024
    padded = np.zeros((-(-count // width) * width, 2), np.float32)
    padded[:count] = place
    rows = padded.reshape(-1, width, 2)
    found = cv2.remap(grey, rows[..., 0], rows[..., 1], cv2.INTER_LINEAR).reshape(-1)[:count].astype(np.float32)
    return np.where(inside, found, np.nan)


def _faced(view: View, pixel: Array, offsets: Array, depths: Array, size: int) -> Array:
    """(D, P, 3) world points of a patch's pixels on planes that face the camera, at depths (D,)."""
    height, width = view.grey[size].shape
    camera = view.camera.scaled(width, height)
    at = pixel * [width / view.camera.width, height / view.camera.height] + offsets
    ideal = Sights.of([camera] * len(at), np.tile(view.pose, (len(at), 1, 1)), at).ideal if camera.distorted else None
    if ideal is None or len(ideal) < len(at):
        one = unproject(camera.pinhole(), np.eye(4), at, np.ones(len(at)))
    else:
        one = np.concatenate([ideal, np.ones((len(ideal), 1))], axis=1)
    return np.asarray((depths[:, None, None] * one) @ view.pose[:3, :3].T + view.pose[:3, 3])


def _scores(views: Views, view: View, ray: Sights, pixel: Array, depths: Array, others: list[int], size: int) -> Array:
    """(D,) mean correlation, over the better half of the other images, of what these show where a patch at a depth would lie."""
    offsets, own = _patch(view, pixel, size)
    points = _faced(view, pixel, offsets, depths, size)
    weights = np.exp(-0.5 * (offsets**2).sum(axis=1) / (SPREAD * HALF) ** 2)
    weights /= weights.sum()
    own = own - weights @ own
    if not np.isfinite(own).all() or weights @ own**2 < 1.0:  # at the rim, or of one colour
        return np.zeros(len(depths))
    found = []
    for other in others:
        seen = _sampled(views[other].grey[size], views[other].at(points.reshape(-1, 3), size)).reshape(len(depths), -1)
        seen = seen - (seen @ weights)[:, None]
        with np.errstate(invalid="ignore", divide="ignore"):
            same = (seen @ (weights * own)) / np.sqrt((seen**2 @ weights) * (weights @ own**2))
        found.append(np.nan_to_num(same, nan=-1.0))
    best = np.sort(np.array(found), axis=0)[::-1][: max(1, (len(found) + 1) // 2)]
    return np.asarray(best.mean(axis=0))


def _aligned(views: Views, view: View, ray: Sights, pixel: Array, depth: float, others: list[int]) -> Found | None:
    """The point at about this depth: patches of other images are aligned to a fraction of a pixel, and all rays meet."""
    side = 2 * HALF + 1
    offsets, own = _patch(view, pixel, 0)
    if not np.isfinite(own).all():
        return None
    height, width = view.grey[0].shape
    spacing = np.array([view.camera.width / width, view.camera.height / height])
    cameras, poses, pixels = [view.camera], [view.pose], [pixel]
    points = _faced(view, pixel, offsets, np.array([depth]), 0)[0]
    stop, whole = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 60, 1e-4), np.full((side, side), 255, np.uint8)
    for other in others:
        seen = _sampled(views[other].grey[0], views[other].at(points, 0))
        if not np.isfinite(seen).all():
            continue
        template, shown = (values.reshape(side, side).astype(np.float32) for values in (own, seen))
        try:
            same, warp = cv2.findTransformECC(template, shown, np.eye(2, 3, dtype=np.float32), cv2.MOTION_AFFINE, stop, whole, 3)
        except cv2.error:  # it does not settle
            continue
        centre = warp @ np.array([HALF, HALF, 1.0])
        shift = centre - HALF
        if same < SAME or np.abs(shift).max() > 0.5 * HALF:
            continue
        # The patch's plane at this depth, shifted: where the other image shows the marked point.
        local = _faced(view, pixel + shift * spacing, np.zeros((1, 2)), np.array([depth]), 0)[0]
        at, _ = project(views[other].camera, views[other].pose, local)
        cameras.append(views[other].camera)
        poses.append(views[other].pose)
        pixels.append(at[0])
    large = max(max(camera.width, camera.height) for camera in cameras) / 1600
    if len(cameras) < AGREE:
        return None
    found = meet(Sights.of(cameras, np.array(poses), np.array(pixels)), MATCHED_TO * large, CLICK * large)
    if found is None or found.views < AGREE:
        return None
    aside = CLICK * large * depth / float(ray.focal[0])  # that the mark itself is off: all matches are off with it
    return replace(found, covariance=found.covariance + aside**2 * np.eye(3))
