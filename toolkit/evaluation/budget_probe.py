"""The quick self-test behind `fieldfuse.evaluation.budget`: a few seconds that measure a unit of each kind of work."""

from __future__ import annotations

import time
from collections.abc import Callable

import cv2
import numpy as np

from fieldfuse.config import Settings
from fieldfuse.evaluation.budget import KINDS, Speed
from fieldfuse.evaluation.sphere import around, lens, sphere_field, sphere_pixels

SECONDS = 0.4  # for each kind, after a first call that does not count
SIDE = 128  # voxels and pixels a side of what is rendered and fitted
RAYS = 1024

Piece = tuple[Callable[[], object], float]  # work, and how many units it is


def self_test(settings: Settings) -> Speed:
    """Units of every kind in seconds: a megapixel decoded, an image's features found and matched, a ray rendered, a ray fitted, a megapixel
    scored."""
    from fieldfuse.progress import SILENT
    from fieldfuse.stereo import fast_mvs
    from fieldfuse.training import depth_start
    from fieldfuse.training.engine import warm_up

    warm_up(settings, SILENT)
    fast_mvs.warm_up()
    depth_start.warm_up()
    makers = {"decode": _decode, "features": _features, "ray": _ray, "fit": _fit, "score": _score}
    units = {}
    for kind in KINDS:
        work, amount = makers[kind]()
        work()
        start, count = time.perf_counter(), 0
        while count == 0 or time.perf_counter() - start < SECONDS:  # the mean: other load on the machine counts as it comes
            work()
            count += 1
        units[kind] = (time.perf_counter() - start) / count / amount
    return Speed(units)


def texture(height: int, width: int) -> np.ndarray:
    """(height, width, 3) uint8 with detail at several scales, as a photo has."""
    generator = np.random.default_rng(0)
    out = np.zeros((height, width, 3))
    for step in (4, 8, 16, 64):
        noise = generator.random((height // step + 1, width // step + 1, 3))
        out += cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC) / 4
    return np.clip(out * 255, 0, 255).astype(np.uint8)


def _decode() -> Piece:
    _, data = cv2.imencode(".jpg", texture(480, 640))

    def work() -> None:
        image = cv2.imdecode(data, cv2.IMREAD_COLOR)
        assert image is not None
        cv2.resize(image, (320, 240), interpolation=cv2.INTER_AREA)

    return work, 640 * 480 / 1e6


def _features() -> Piece:
    from fieldfuse.poses.points import FEATURES, mutual_matches

    grey = cv2.cvtColor(texture(480, 640), cv2.COLOR_RGB2GRAY)
    finder = cv2.SIFT.create(nfeatures=FEATURES, contrastThreshold=0.02)

    def work() -> None:
        _, found = finder.detectAndCompute(grey, None)
        unit = found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-9)
        for _ in range(3):  # as many pairs as there are for each image
            mutual_matches(unit, unit)

    return work, 1.0


def _ray() -> Piece:
    from fieldfuse.render.image import make_renderer, render_view

    field = sphere_field(SIDE)
    view, pose, camera = make_renderer(field), around()[0], lens(SIDE, SIDE)
    return lambda: render_view(field, camera, pose, view), float(SIDE * SIDE)


def _fit() -> Piece:
    from fieldfuse.training.losses import Rates
    from fieldfuse.training.numba_engine import NumbaEngine

    engine, rates = NumbaEngine(sphere_field(SIDE), sphere_pixels(), 0), Rates(0.01, 0.01, 0.001, 0.01, 0.01)
    return lambda: engine.step(RAYS, rates), float(RAYS)


def _score() -> Piece:
    from fieldfuse.evaluation.score import MEASURES

    generator = np.random.default_rng(0)
    first, second = (generator.integers(0, 256, (120, 160, 3), dtype=np.uint8) for _ in range(2))

    def work() -> None:
        for measure in MEASURES.values():
            measure(first, second, None)

    return work, 120 * 160 / 1e6
