"""Networks, recurrent fusion: against sums in float64, over ten thousand frames, and where gates, volumes and weights are at their ends."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from fieldfuse.nerfusion.gru import LEAST, FusionGRU, RunningMean
from fieldfuse.nerfusion.lattice import LatentVolume, Lattice, LocalVolume
from fieldfuse.nerfusion.training.curve import saturation
from fieldfuse.volume.space import Space
from fieldfuse.volume.topology import Topology
from tests.stability.hard.errors import absolute, by_size, not_finite
from tests.stability.hard.within import Within

GROUP = "networks"
SIZE = 512  # corners of one block


def one_block() -> tuple[Topology, Tensor, Tensor]:
    """A block, which of its corners are inside, and the same with the zero row, (513, 1)."""
    inside = torch.rand(SIZE) < 0.2
    return Topology(torch.zeros((1, 3), dtype=torch.int64)), inside, torch.cat([inside, inside.new_zeros(1)])[:, None]


def fuse(fusion: FusionGRU | RunningMean, *given: Any) -> Tensor:
    """(513, C) H' of H, n, V, V_raw, w, the block, and which of its corners are inside."""
    state, count, local, raw, weight, topology, inside = given
    lattice = Lattice(Space((0.0, 0.0, 0.0), 1.0, 0.0), 8)
    known = local, inside.to(weight.dtype), raw, weight, topology, torch.arange(topology.blocks)
    return fusion(LatentVolume(lattice, topology, state, count), LocalVolume(lattice, topology, *known))  # type: ignore[no-any-return]


def recurrence_errors(frames: int) -> dict[str, float]:
    """Run the recurrence over random frames, every hundredth a thousand times as large, and look at what comes out."""
    topology, inside, mask = one_block()
    gru, mean = FusionGRU(4, 8), RunningMean()
    state, average = torch.zeros(SIZE + 1, 4), torch.zeros(SIZE + 1, 4)
    count = torch.zeros(SIZE)
    largest, wrong = 0.0, 0.0
    with torch.no_grad():
        for frame in range(frames):
            raw = torch.randn(SIZE + 1, 4) * (1e3 if frame % 100 == 99 else 1.0) * mask
            local, weight = torch.tanh(raw), torch.rand(SIZE) * inside * (0 if frame % 50 == 49 else 1)
            state = fuse(gru, state, count, local, raw, weight, topology, inside) * mask
            average = fuse(mean, average, count, local, raw, weight, topology, inside) * mask
            count += weight
            largest = max(largest, float(state.abs().max()), float(average.abs().max()))
            wrong += not_finite(state, average)
    return {"state beyond ±1": max(0.0, largest - 1), "values that are not finite": wrong}


def test_recurrence(within: Within) -> None:
    """Recurrent fusion: 200 frames stay bounded."""
    for name, error in recurrence_errors(200).items():
        within(name, error, 1e-6 if name.startswith("state") else 0.0)


@pytest.mark.long
def test_long_recurrence(within: Within) -> None:
    """Recurrent fusion: 10,000 frames stay bounded."""
    for name, error in recurrence_errors(10_000).items():
        within(name, error, 1e-6 if name.startswith("state") else 0.0)


def test_recurrence_exact(within: Within) -> None:
    """Recurrent fusion: ten frames against weighted means and float64, gradients too.

    With gates that say nothing the state is the weighted mean of the frames: its value and its slopes are known in closed form.
    """
    topology, inside, mask = one_block()
    frames = 10
    raw, weight = torch.randn(frames, SIZE + 1, 4) * mask, (torch.rand(frames, SIZE) * 0.9 + 0.1) * inside
    wide = torch.tanh(raw.double())
    share = weight.double() / weight.double().sum(0).clamp_min(1e-30)
    exact = (wide[:, :-1] * share[:, :, None]).sum(0)
    slope = (1 - wide[:, :-1] ** 2) * share[:, :, None]
    silent = FusionGRU(4, 8)
    for gate in (silent.update, silent.reset, silent.candidate):
        for parameter in list(gate.parameters())[-2:]:
            parameter.data.zero_()
    for name, fusion in (("silent gates", silent), ("running mean", RunningMean())):
        leaf = raw.clone().requires_grad_(True)
        state = _run(fusion, leaf, weight, topology, inside, mask)
        state.sum().backward()
        assert leaf.grad is not None
        within(f"{name}: value", absolute(state[:-1][inside], exact[inside]), 1e-6)
        within(f"{name}: gradient, by the largest", by_size(leaf.grad[:, :-1][:, inside], slope[:, inside]), 5e-6)
    gru = FusionGRU(4, 8)
    double = FusionGRU(4, 8).double()
    double.load_state_dict({key: value.double() for key, value in gru.state_dict().items()})
    leaf, twin = raw.clone().requires_grad_(True), raw.double().requires_grad_(True)
    state, truth = _run(gru, leaf, weight, topology, inside, mask), _run(double, twin, weight.double(), topology, inside, mask)
    state.sum().backward()
    truth.sum().backward()
    assert leaf.grad is not None and twin.grad is not None
    within("open gates: value", absolute(state, truth), 2e-6)
    within("open gates: gradient, by the largest", by_size(leaf.grad, twin.grad), 1e-5)
    weights = zip(gru.parameters(), double.parameters(), strict=True)
    within("open gates: gradient of the weights, by the largest", max(by_size(a.grad, b.grad) for a, b in weights), 1e-5)


def _run(fusion: FusionGRU | RunningMean, raw: Tensor, weight: Tensor, topology: Topology, inside: Tensor, mask: Tensor) -> Tensor:
    """(frames, 513, C), (frames, 512) → the state after all of them."""
    state, count = torch.zeros_like(raw[0]), torch.zeros_like(weight[0])
    for frame, one in zip(raw, weight, strict=True):
        state = fuse(fusion, state, count, torch.tanh(frame), frame, one, topology, inside) * mask
        count = count + one
    return state


def test_recurrence_edges(within: Within) -> None:
    """Recurrent fusion: first frame, saturated gates, the same frame twice, an empty local volume, weights from 0 to 1e6."""
    topology, inside, mask = one_block()
    gru, mean = FusionGRU(4, 8), RunningMean()
    none, once = torch.zeros(SIZE), inside.float()
    raw = (torch.randn(SIZE + 1, 4) * mask).requires_grad_(True)
    first = fuse(gru, torch.zeros(SIZE + 1, 4), none, torch.tanh(raw), raw, once, topology, inside)
    first[:-1][inside].sum().backward()
    assert raw.grad is not None
    held = torch.full((SIZE + 1, 4), 0.5) * mask
    large = (torch.full((SIZE + 1, 4), 1e4) * mask).requires_grad_(True)
    saturated = fuse(gru, held, once, torch.tanh(large), large, once, topology, inside)
    saturated.sum().backward()
    assert large.grad is not None
    nothing = torch.zeros(SIZE + 1, 4)
    empty = fuse(gru, held, once, nothing, nothing, none, topology, torch.zeros(SIZE, dtype=torch.bool))
    value = torch.tanh(raw.detach()) * mask
    one = fuse(mean, torch.zeros(SIZE + 1, 4), none, value, value, once, topology, inside)
    twice = fuse(mean, one, once, value, value, once, topology, inside)
    # A key frame that sees nothing weighs LEAST, not zero: what was known hardly changes, and where nothing was, it counts.
    unseen = fuse(mean, held, once, value, value, none, topology, inside)
    drift = LEAST / (LEAST + 1)
    heavy = [fuse(module, held, once, value, raw.detach(), once * 1e6, topology, inside) for module in (gru, mean)]
    within("values that are not finite", not_finite(first, saturated, empty, raw.grad, large.grad, unseen, *heavy), 0.0)
    within("first frame without a gradient", float(raw.grad[:-1][inside].abs().sum() == 0), 0.0)
    within("mean of the same frame twice", absolute(twice, value), 2e-7)
    within("known by a frame that weighs nothing", absolute(unseen, (1 - drift) * held.double() + drift * value.double()), 1e-6)
    within("mean with a frame of a million", absolute(heavy[1], value), 3e-6)
    within("state beyond ±1", max(0.0, *(float(state.detach().abs().max()) - 1 for state in (*heavy, saturated))), 1e-6)


def test_stuck_gates(within: Within) -> None:
    """Recurrent fusion: stuck gates are reported, open ones pass a gradient.

    A gate at its end passes hardly any gradient: what counts is that its share is measured and shown (`GateWatch`).
    """
    topology = Topology(torch.zeros((1, 3), dtype=torch.int64))
    inside, once = torch.ones(SIZE, dtype=torch.bool), torch.ones(SIZE)
    for name, bias, wanted in (("open", 0.0, 0.0), ("stuck", 1e3, 1.0), ("shut", -1e3, 1.0)):
        torch.manual_seed(0)
        gru = FusionGRU(4, 8)
        seen: list[float] = []
        hook = gru.update.register_forward_hook(lambda module, given, answer, seen=seen: seen.append(saturation(torch.sigmoid(answer))))
        last = [parameter for key, parameter in gru.update.named_parameters() if key.endswith("bias")][-1]
        last.data.fill_(bias)
        raw = torch.randn(SIZE + 1, 4).requires_grad_(True)
        state = fuse(gru, torch.full((SIZE + 1, 4), 0.3), once, torch.tanh(raw), raw, once, topology, inside)
        state[:-1].sum().backward()
        hook.remove()
        assert raw.grad is not None
        within(f"{name}: share of saturated gates, off by", abs(seen[0] - wanted), 0.05)
        within(f"{name}: values that are not finite", not_finite(state, raw.grad), 0.0)
        if name == "open":
            within("open: no gradient", float(raw.grad.abs().sum() == 0), 0.0)
