"""Cameras: fields of view from 1° to 170°, strong lenses and their inverse, principal points outside the picture, folding lenses."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from fieldfuse.camera import (
    FISHEYE,
    OPENCV,
    PINHOLE,
    Array,
    Intrinsics,
    distort,
    lens_limit,
    pixel_grid,
    project,
    rays,
    resample_maps,
    undistort_maps,
    unproject,
)
from fieldfuse.evaluation.selftest import reference
from fieldfuse.evaluation.selftest.case import Measure, absolute, case, not_finite, relative
from fieldfuse.poses.points import undistorted
from fieldfuse.render.paths import look_at

GROUP = "cameras"
LENS = 1e-8  # image-plane units
PIXEL = 1e-8
POSE = look_at(np.array([[0.7, -1.1, 0.4]]), np.array([0.1, 0.2, 0.3]), np.array([0.0, 0, 1]))[0]
STRONG: dict[str, Intrinsics] = {
    "barrel": Intrinsics(640, 480, 420.0, 425.0, 330.0, 235.0, OPENCV, (-0.35, 0.12, 1e-3, -8e-4, -0.02)),
    "cushion": Intrinsics(640, 480, 420.0, 425.0, 310.0, 245.0, OPENCV, (0.35, 0.08, -1e-3, 2e-3)),
    "rational": Intrinsics(640, 480, 300.0, 300.0, 320.0, 240.0, OPENCV, (0.6, -0.05, 5e-4, -3e-4, 0.01, 0.95, 0.1, 0.02)),
    "fisheye": Intrinsics(640, 480, 210.0, 210.0, 322.0, 238.0, FISHEYE, (0.08, -0.02, 4e-3, -5e-4)),
}


def of_fov(degrees: float, width: int = 64, height: int = 48) -> Intrinsics:
    """A pinhole camera of so many degrees across."""
    focal = 0.5 * width / math.tan(math.radians(degrees) / 2)
    return Intrinsics(width, height, focal, focal, width / 2, height / 2)


def projection_errors(camera: Intrinsics, pose: Array, pixels: Array, depth: Array) -> dict[str, float]:
    """Pixels → points → pixels, and rays through the same pixels, by a pinhole camera."""
    points = unproject(camera, pose, pixels, depth)
    again, z = project(camera, pose, points)
    _, directions, cosine = (values.double().numpy() for values in rays(camera, pose, pixels))
    offset = points - pose[:3, 3]
    distance = np.linalg.norm(offset, axis=1)
    return {
        "pixels there and back, by the focal length": absolute(again, pixels) / max(camera.fx, camera.width),
        "depth there and back, relative": relative(z, depth),
        "ray beside its point, relative": float(np.linalg.norm(offset - directions * distance[:, None], axis=1).max() / distance.max()),
        "depth from distance, relative": relative(distance * cosine, depth),
        "values that are not finite": not_finite(points, again, directions, cosine),
    }


def lens_errors(camera: Intrinsics, points: Array) -> dict[str, float]:
    """Bending (N, 2) image-plane points against the model written out, and bending then unbending them."""
    bent = distort(camera, points)
    written = [reference.lens(camera.lens, camera.distortion, float(x), float(y)) for x, y in points]
    pixels = bent * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    back = undistorted(camera, pixels)
    return {
        "bent": absolute(bent, np.array(written)),
        "bent and unbent": absolute(back, points),
        "values that are not finite": not_finite(bent, back),
    }


@case(GROUP, "fields of view from 1° to 170°")
def fields_of_view(folder: Path) -> list[Measure]:
    bounds = {
        "pixels there and back, by the focal length": PIXEL,
        "depth there and back, relative": 1e-12,
        "ray beside its point, relative": 2e-7,
        "depth from distance, relative": 2e-7,
        "values that are not finite": 0.0,
    }
    worst = dict.fromkeys(bounds, 0.0)
    depth = np.random.default_rng(0).uniform(0.01, 100, 64 * 48)
    for degrees in (1.0, 5.0, 30.0, 90.0, 140.0, 170.0):
        errors = projection_errors(of_fov(degrees), POSE, pixel_grid(64, 48), depth)
        worst = {name: max(worst[name], errors[name]) for name in worst}
    return [Measure(name, worst[name], bound) for name, bound in bounds.items()]


@case(GROUP, "principal points far outside the picture")
def principal_points(folder: Path) -> list[Measure]:
    out = []
    for cx, cy in ((-500.0, 24.0), (32.0, 5000.0), (1e5, -1e5)):
        camera = Intrinsics(64, 48, 60.0, 60.0, cx, cy)
        errors = projection_errors(camera, POSE, pixel_grid(64, 48), np.full(64 * 48, 2.5))
        size = max(1.0, abs(cx) / 60)
        name = f"principal point ({cx:g}, {cy:g})"
        out.append(Measure(f"{name}: pixels there and back", errors["pixels there and back, by the focal length"], PIXEL * size))
        out.append(Measure(f"{name}: rays, relative", errors["ray beside its point, relative"], 2e-7))
        _, map_x, _, seen = undistort_maps(camera, 32, 24)
        out.append(Measure(f"{name}: pixels without source", float((~seen).sum()) + not_finite(map_x), 0.0))
    return out


@case(GROUP, "strong lenses and their inverse to 1e-8")
def strong_lenses(folder: Path) -> list[Measure]:
    out = []
    for name, camera in STRONG.items():
        most = 1.4 if camera.lens == FISHEYE else 0.75
        reach = min(most, lens_limit(camera, most) * 0.98)
        angle = np.linspace(0, 2 * np.pi, 37)
        points = np.concatenate([r * np.stack([np.cos(angle), np.sin(angle)], axis=1) for r in np.linspace(0, reach, 12)])
        for what, error in lens_errors(camera, points).items():
            out.append(Measure(f"{name}: {what}", error, 0.0 if "finite" in what else LENS))
    return out


@case(GROUP, "fisheye up to 160° across")
def wide_fisheye(folder: Path) -> list[Measure]:
    camera = STRONG["fisheye"]
    theta = np.radians(np.linspace(0, 80, 60))
    points = np.stack([np.tan(theta) * np.cos(0.3), np.tan(theta) * np.sin(0.3)], axis=1)
    bent = distort(camera, points)
    back = undistorted(camera, bent * [camera.fx, camera.fy] + [camera.cx, camera.cy])
    written = [reference.lens(FISHEYE, camera.distortion, float(x), float(y)) for x, y in points]
    angle = np.degrees(np.abs(np.arctan(np.linalg.norm(back, axis=1)) - theta))
    return [
        Measure("bent", absolute(bent, np.array(written)), LENS),
        Measure("angle after bending and unbending, degrees", float(angle.max()), 1e-6),
        Measure("values that are not finite", not_finite(bent, back), 0.0),
    ]


@case(GROUP, "no lens written as a lens with zeros")
def zero_lens(folder: Path) -> list[Measure]:
    points = np.random.default_rng(1).uniform(-2, 2, (200, 2))
    out = []
    for length in (0, 4, 5, 8, 14):
        camera = Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0, OPENCV if length else PINHOLE, (0.0,) * length)
        out.append(Measure(f"{length} zeros", absolute(distort(camera, points), points), 0.0))
    tiny = Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0, OPENCV, (1e-300, 0.0, 0.0, 0.0))
    out.append(Measure("a coefficient of 1e-300", absolute(distort(tiny, points), points), 1e-12))
    out.append(
        Measure("no points", float(len(distort(STRONG["barrel"], np.zeros((0, 2)))) + len(undistorted(tiny, np.zeros((0, 2))))), 0.0)
    )
    return out


@case(GROUP, "a lens that folds back claims no pixel twice")
def folding_lens(folder: Path) -> list[Measure]:
    camera = Intrinsics(400, 400, 180.0, 180.0, 200.0, 200.0, OPENCV, (-0.25, 0.0, 0.0, 0.0))
    exact = 1 / math.sqrt(0.75)  # where r (1 - r²/4) turns back
    _, map_x, map_y, seen = undistort_maps(camera, 400, 400)
    v, u = np.nonzero(seen)
    radius = np.hypot((u + 0.5 - 200) / 180, (v + 0.5 - 200) / 180)
    line = seen[200]
    return [
        Measure("radius where it folds, relative", abs(lens_limit(camera, 3.0) / exact - 1), 2e-3),
        Measure("pixels beyond the fold", float((radius > exact * 1.002).sum()), 0.0),
        Measure("columns out of order along the middle row", float((np.diff(map_x[200][line]) <= 0).sum()), 0.0),
        Measure("maps that are not finite", not_finite(map_x[seen], map_y[seen]), 0.0),
    ]


@case(GROUP, "points on, behind and almost in the camera")
def behind(folder: Path) -> list[Measure]:
    camera = STRONG["barrel"]
    pose = np.eye(4)
    points = np.array([[0, 0, 0.0], [0.1, 0, 0], [0, 0, -1.0], [5, 5, -1e-9], [0, 0, 1e-13], [0, 0, 1e-9], [0.2, 0.1, 1.0]])
    pixels, depth = project(camera, pose, points)
    return [
        Measure("points not in front that get a pixel", float(np.isfinite(pixels[:5]).sum()), 0.0),
        Measure("points in front without one", not_finite(pixels[5:]), 0.0),
        Measure("depth", absolute(depth, points[:, 2]), 0.0),
    ]


@case(GROUP, "undistorting at another size is one and the same map")
def sizes(folder: Path) -> list[Measure]:
    out = []
    for name, camera in STRONG.items():
        target, map_x, map_y, seen = undistort_maps(camera, 160, 120)
        pixels = pixel_grid(160, 120)
        ideal = (pixels - [target.cx, target.cy]) / [target.fx, target.fy]
        written = np.array([reference.lens(camera.lens, camera.distortion, float(x), float(y)) for x, y in ideal])
        u, v = (written * [camera.fx, camera.fy] + [camera.cx, camera.cy] - 0.5).T
        got = np.stack([map_x.ravel(), map_y.ravel()], axis=1)[seen.ravel()]
        out.append(Measure(f"{name}: map, pixels", absolute(got, np.stack([u, v], axis=1)[seen.ravel()]), 1e-4))
        same, _, whole = resample_maps(camera.pinhole(), target)
        out.append(Measure(f"{name}: without its lens, whole", float((~whole).sum()) + not_finite(same), 0.0))
    return out
