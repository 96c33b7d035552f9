"""What is near a camera moves slowly, and only that."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldfuse.backends.numba.train_batch import near_scale
from fieldfuse.training.losses import near_gradient_scaling
from fieldfuse.training.pixels import PixelPool
from tests.render.made import random_field
from tests.training.gradients import made_views, torch_gradients
from tests.training.test_numba import RATES

BOUNDS = st.floats(0.0625, 100, width=32)
DISTANCES = st.floats(-1, 1000, width=32)


@settings(deadline=None)
@given(distance=DISTANCES, within=BOUNDS)
def test_both_engines_slow_a_sample_by_its_distance(distance, within):
    factor = float(near_gradient_scaling(torch.tensor([distance]), within)[0])
    assert factor == pytest.approx(min(max(distance, 0) / within, 1) ** 2, abs=1e-6)
    assert float(near_scale(np.float32(distance), np.float32(within))) == pytest.approx(factor, abs=1e-6)


@pytest.mark.parametrize("decoder", ["deferred", "per_sample"])
def test_far_away_gradients_are_what_they_were(decoder):
    """Cameras stand 3 before a box of half a side 1: a bound below the nearest corner changes nothing, one far beyond makes all gradients
    of rows smaller."""
    field = random_field(0.0, 32, decoder, keep=0.5, raw=-2.5)
    batch = PixelPool(made_views(), depth=True).take(torch.arange(0, 2000, 7))
    plain, below, beyond = (torch_gradients(field, batch, replace(RATES, slow_within=bound)) for bound in (0.0, 0.5, 20.0))
    for one, other in zip(plain, below, strict=True):
        assert torch.equal(one, other)
    for one, other in zip(plain[:2], beyond[:2], strict=True):
        assert 0 < float(other.norm()) < 0.1 * float(one.norm())
