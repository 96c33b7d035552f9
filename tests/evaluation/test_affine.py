"""The correction of colour is fitted on the left half and scored on the right."""

from __future__ import annotations

import numpy as np
import pytest

from fieldfuse.evaluation.metrics import right_half_psnr


def test_colour_is_forgiven_and_detail_is_not() -> None:
    rng = np.random.default_rng(0)
    truth = rng.uniform(0.2, 0.8, (20, 30, 3))
    tinted = 0.5 * truth @ (np.eye(3) + 0.1) + 0.05
    assert right_half_psnr(tinted, truth) > 80  # type: ignore[operator]
    blurred = np.broadcast_to(truth.mean((0, 1)), truth.shape) + rng.normal(0, 0.01, truth.shape)
    assert right_half_psnr(blurred, truth) < 20  # type: ignore[operator]


def test_the_right_half_takes_no_part_in_the_fit() -> None:
    truth = np.random.default_rng(1).uniform(0.2, 0.8, (20, 30, 3))
    rendered = truth.copy()
    rendered[:, 15:] *= 0.5  # only the half that is scored is wrong
    wrong = float(-10 * np.log10(((rendered - truth)[:, 15:] ** 2).mean()))
    assert right_half_psnr(rendered, truth) == pytest.approx(wrong, abs=1e-6)


def test_too_few_pixels_give_nothing() -> None:
    truth = np.full((20, 30, 3), 0.5)
    assert right_half_psnr(truth, truth, np.zeros((20, 30), dtype=bool)) is None
