"""Short fits of captures that say little: whatever the pictures hold, the field stays finite, can be written, and shows something."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from fieldfuse.camera import Array, Intrinsics, Similarity
from fieldfuse.capture.types import Views
from fieldfuse.config import load_settings
from fieldfuse.evaluation.selftest.case import Measure, case, not_finite
from fieldfuse.evaluation.selftest.data import flat, one_pixel, poses, saturated, texture
from fieldfuse.poses.scene import Scene
from fieldfuse.render.field import Field
from fieldfuse.render.image import make_renderer, render_view
from fieldfuse.training.fit import fit_field

GROUP = "fits"
SECONDS = 0.4
CAMERA = Intrinsics(40, 32, 44.0, 44.0, 20.0, 16.0)
Paint = Callable[[int, int, int], Array]


def noise(index: int, height: int, width: int) -> Array:
    return np.asarray(np.random.default_rng(index).integers(0, 255, (height, width, 3)), dtype=np.uint8)


def views_of(paint: Paint, count: int = 6, tested: int = 0, alpha: bool = False) -> Views:
    """Views on an arc, the first `tested` held out; with `alpha` nothing is opaque."""
    pictures = [paint(index, CAMERA.height, CAMERA.width) for index in range(count)]
    views = Views([str(i) for i in range(count)], pictures, [CAMERA] * count, poses(count), np.arange(count) < tested)
    if alpha:
        views.alpha, views.background = [np.zeros(pictures[0].shape[:2], np.uint8)] * count, (1.0, 1.0, 1.0)
    return views


def scene_of(half: Array | None = None, centre: Array | None = None, background: bool = False) -> Scene:
    half = np.full(3, 1.2) if half is None else half
    return Scene(Similarity.identity(), np.zeros(3) if centre is None else centre, half, 3.0, 0.5, 6.0, 0.1, background, True)


def fit_errors(views: Views, scene: Scene, engine: str, folder: Path) -> dict[str, float]:
    """What is not finite after a short fit, in the field, in its file and in a picture of it."""
    settings = load_settings("fast", pairs=[f"budget={SECONDS}", "threads=1", "field.resolution=32", f"engine={engine}"])
    result = fit_field(views, scene, settings)
    field = result.field
    numbers = [field.density_rows, field.feature_rows, *field.decoder.parameters()]
    field.save(folder / "field.safetensors")
    again = Field.load(folder / "field.safetensors")
    picture = render_view(again, CAMERA, views.world_from_camera[0], make_renderer(again, "torch"))
    return {
        "values that are not finite": not_finite(*numbers, picture.rgb, picture.depth, picture.opacity),
        "colours outside [0, 1]": float(((picture.rgb < 0) | (picture.rgb > 1)).sum()),
        "points of the timeline that are not finite": not_finite(torch.tensor([[p["seconds"], p["psnr"]] for p in result.timeline])),
    }


CAPTURES: dict[str, Callable[[], tuple[Views, Scene]]] = {
    "black": lambda: (views_of(flat(0)), scene_of()),
    "white, with a background": lambda: (views_of(flat(255)), scene_of(background=True)),
    "noise": lambda: (views_of(noise), scene_of()),
    "saturated": lambda: (views_of(saturated), scene_of()),
    "one bright pixel": lambda: (views_of(one_pixel), scene_of()),
    "one training view": lambda: (views_of(texture, 2, 1), scene_of()),
    "nothing opaque": lambda: (views_of(flat(255), alpha=True), scene_of()),
    "a region of a micrometre": lambda: (views_of(texture), scene_of(np.full(3, 1e-6))),
    "a region without height": lambda: (views_of(texture), scene_of(np.array([1.0, 1.0, 1e-9]))),
    "a region that no camera sees": lambda: (views_of(texture), scene_of(np.ones(3), np.array([50.0, 0.0, 0.0]), True)),
}


@case(GROUP, "black, white, noise, one bright pixel, one view, no opacity, no region (torch)")
def with_torch(folder: Path) -> list[Measure]:
    return _all(folder, "torch")


@case(GROUP, "the same with the compiled engine", slow=True)
def compiled(folder: Path) -> list[Measure]:
    return _all(folder, "numba")


def _all(folder: Path, engine: str) -> list[Measure]:
    return [
        Measure(f"{name}: {what}", error, 0.0)
        for name, make in CAPTURES.items()
        for what, error in fit_errors(*make(), engine, folder).items()
    ]
