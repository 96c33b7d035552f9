"""The compiled steps of the recurrence: against the tensors they stand for, in both kinds of numbers, on any number of threads."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from numba import njit

from benchmarks.timing import pinned
from fieldfuse.backends.numba import gru as kernels
from fieldfuse.nerfusion import model
from fieldfuse.nerfusion.lattice import LatentVolume, LocalVolume
from fieldfuse.volume.topology import Topology
from tests.nerfusion.made import SMALL, off, small_model
from tests.nerfusion.test_gru import inputs

SIDE = 3


def blocks() -> Topology:
    return Topology(torch.cartesian_prod(*[torch.arange(SIDE)] * 3).int())


def volumes(seed: int, busy: int = 8, seen: float = 0.6) -> tuple[LatentVolume, LocalVolume]:
    """A global volume and a local one on its blocks, the networks at work on the `busy` first of them."""
    topology = blocks()
    part, local = inputs(topology, seed, seen, SMALL.channels)
    views = local.count * torch.randint(1, 4, (topology.zero_row,), generator=torch.Generator().manual_seed(seed))
    return part, replace(local, count=views, near_surface=Topology(topology.keys[:busy]), slots=torch.arange(busy))


def trained(seed: int = 0) -> model.NerfusionModel:
    """As training could leave it: weights and biases far from the start."""
    made = small_model(seed)
    for parameter in made.fusion.parameters():
        parameter.data = 3 * parameter.data + 0.1 * torch.randn_like(parameter)
    return made


@torch.no_grad()
def both_ways(part: LatentVolume, local: LocalVolume, monkeypatch: pytest.MonkeyPatch) -> tuple[LatentVolume, LatentVolume]:
    made = trained()
    found = made.fuse_part(part, local)
    with monkeypatch.context() as patch:
        off(patch)
        expected = made.fuse_part(part, local)
    return found, expected


@pytest.mark.parametrize("busy", [0, 1, 8, SIDE**3])
def test_a_step_equals_that_of_tensors(busy: int, monkeypatch: pytest.MonkeyPatch) -> None:
    part, local = volumes(busy, busy)
    found, expected = both_ways(part, local, monkeypatch)
    assert found.rows.shape == expected.rows.shape and found.rows.dtype == torch.float32
    torch.testing.assert_close(found.rows, expected.rows, atol=3e-5, rtol=0)
    assert torch.equal(found.count, expected.count)
    assert not found.rows[:-1][~local.known].any() and not found.rows[-1].any(), "what the key frame does not see stays zero"
    assert float(found.rows.abs().max()) <= 1
    if busy:
        mean, _ = both_ways(*volumes(busy, 0), monkeypatch)
        assert float((found.rows - mean.rows).abs().max()) > 0.1, "the networks say something"


def test_a_step_in_bfloat16_equals_that_of_tensors_to_its_rounding(monkeypatch: pytest.MonkeyPatch) -> None:
    part, local = volumes(1)
    exact, _ = both_ways(part, local, monkeypatch)
    with torch.autocast("cpu", torch.bfloat16):
        found, expected = both_ways(part, local, monkeypatch)
    assert found.rows.dtype == torch.float32
    rounding = float((expected.rows - exact.rows).abs().mean())
    assert rounding > 1e-4, "the convolutions were reduced"
    assert float((found.rows - exact.rows).abs().mean()) <= 1.1 * rounding
    assert float((found.rows - expected.rows).abs().mean()) <= rounding


def test_what_was_never_known_takes_nothing_from_the_global_volume() -> None:
    part, local = volumes(4)
    with torch.no_grad():
        expected = trained().fuse_part(part, local)
        part.rows[:-1][part.count == 0] = 0.7
        found = trained().fuse_part(part, local)
    assert torch.equal(found.rows, expected.rows)


@pytest.mark.parametrize("reduced", [False, True])
def test_threads_do_not_matter(reduced: bool) -> None:
    part, local = volumes(5)
    kind = torch.bfloat16 if reduced else torch.float32
    reset, update, candidate = torch.randn((3, len(local.place), SMALL.channels)).to(kind)
    out = []
    for threads in (1, 2, 3):
        with pinned(threads):
            step = kernels.Step(local.place[:-1], part, local, 1e-3, 16)
            rows, both = step.average(), step.beside()
            step.forget(reset, both)
            step.update(update, candidate, 3, 0.5, rows)
            out.append((rows, both))
    for rows, both in out[1:]:
        assert torch.equal(rows, out[0][0]) and torch.equal(both, out[0][1])


def test_tanh_against_the_exact_one() -> None:
    values = np.concatenate([np.linspace(-12, 12, 200_001), [0.0, 1e-30, -1e-30, 1e-4, 80, -80, 3e38, -3e38, np.inf, -np.inf]])
    values = values.astype(np.float32)
    found = _all(values).astype(np.float64)
    expected = np.tanh(values.astype(np.float64))
    assert np.abs(found - expected).max() < 3e-7
    assert np.abs(found).max() <= 1
    small = np.abs(values) < 0.1
    assert (np.abs(found - expected)[small] <= 3e-7 * np.abs(expected[small])).all(), "and relative to small values"
    assert math.isnan(_all(np.array([np.nan], np.float32))[0]), "what is no number does not become one"


@njit
def _all(values: np.ndarray) -> np.ndarray:
    out = np.empty_like(values)
    for i in range(len(values)):
        out[i] = kernels.tanh(values[i])
    return out
