"""PSNR over a sample of pixels: what the report's table says of the same field, in the colours of the photos."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from fieldfuse.camera import Intrinsics
from fieldfuse.capture.types import Views
from fieldfuse.effects.correct import Corrections
from fieldfuse.evaluation.score import score_views
from fieldfuse.render.image import Rendered
from fieldfuse.tone import Tone
from fieldfuse.training.fit import Sample

CAMERA = Intrinsics(40, 30, 40.0, 40.0, 20.0, 15.0)


class Flat:
    """An engine whose field is one colour everywhere."""

    def __init__(self, colour: tuple[float, float, float]) -> None:
        self.colour = torch.tensor(colour)

    def colours(self, origins: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
        return self.colour.expand(len(origins), 3)


def some_views() -> Views:
    rng = np.random.default_rng(0)
    images = [rng.integers(60, 120, (30, 40, 3), dtype=np.uint8) for _ in range(4)]
    return Views(list("abcd"), images, [CAMERA] * 4, np.tile(np.eye(4), (4, 1, 1)), np.array([True, False, True, False]))


@pytest.mark.parametrize("corrections", [Corrections(), Corrections(gain={"a": (0.6, 0.5, 0.7), "b": (2.0, 2.0, 2.0)}, corner=0.5)])
def test_all_pixels_of_held_out_views_are_what_the_table_counts(corrections: Corrections) -> None:
    views, engine = corrections.on_views(some_views()), Flat((0.4, 0.35, 0.5))
    indices = np.flatnonzero(views.test)
    shown = Rendered(np.broadcast_to(engine.colour.numpy(), (30, 40, 3)), np.zeros((30, 40)), np.ones((30, 40)))
    wanted = score_views([shown] * 2, views, indices)["psnr"]
    found = Sample(views, indices, 10**6, torch.device("cpu")).psnr(engine)  # type: ignore[arg-type]
    assert found == pytest.approx(wanted, abs=1e-4)


def test_training_views_are_told_in_the_colours_that_are_fitted() -> None:
    views, engine = some_views(), Flat((0.4, 0.35, 0.5))
    train = np.flatnonzero(~views.test)
    corrected = Corrections(gain={"b": (2.0, 2.0, 2.0)}).on_views(views)
    assert corrected.tones[1] == Tone((2.0, 2.0, 2.0))
    plain = Sample(replace(corrected, photos=[], tones=[]), train, 500, torch.device("cpu"))
    found = Sample(corrected, train, 500, torch.device("cpu"))
    assert found.factor is None and found.psnr(engine) == plain.psnr(engine)  # type: ignore[arg-type]
    assert Sample(views, np.array([], int), 500, torch.device("cpu")).psnr(engine) is None  # type: ignore[arg-type]
