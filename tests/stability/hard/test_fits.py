"""Short fits of captures that say little: whatever the pictures hold, the field stays finite, can be written, and shows something."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from fieldfuse.capture.types import Views
from fieldfuse.config import load_settings
from fieldfuse.poses.scene import Scene
from fieldfuse.render.field import Field
from fieldfuse.render.image import make_renderer, render_view
from fieldfuse.training.fit import fit_field
from tests.stability.hard.captures import CAMERA, flat, noise, one_pixel, saturated, scene_of, texture, views_of
from tests.stability.hard.errors import not_finite
from tests.stability.hard.within import Within

GROUP = "fits"
SECONDS = 0.4


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


@pytest.mark.parametrize("engine", ["torch", pytest.param("numba", marks=pytest.mark.long)])
def test_fits(within: Within, tmp_path: Path, engine: str) -> None:
    """Black, white, noise, one bright pixel, one view, no opacity, no region."""
    for name, make in CAPTURES.items():
        within.each(fit_errors(*make(), engine, tmp_path), name=f"{name}: {{}}")
