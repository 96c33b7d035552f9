"""The recurrence: what it starts as, what it never does, and the same on sparse blocks as on a dense grid."""

from __future__ import annotations

from dataclasses import replace

import torch
import torch.nn.functional as F

from fieldfuse.nerfusion.extras.known_terms import colour_latent, sdf_latent
from fieldfuse.nerfusion.gru import FusionGRU, RunningMean
from fieldfuse.nerfusion.lattice import LatentVolume, LocalVolume
from fieldfuse.nerfusion.volume_net import FieldHead, LocalReconstruction
from fieldfuse.volume.topology import Topology
from tests.nerfusion.made import lattice
from tests.nerfusion.test_block_conv import cube, dense_of, rows_of

CHANNELS = 4


def trained(seed: int = 0, gain: float = 4.0) -> FusionGRU:
    """A GRU as training could leave it: weights and biases far from the start."""
    torch.manual_seed(seed)
    gru = FusionGRU(CHANNELS, 6)
    for parameter in gru.parameters():
        parameter.data = parameter.data * gain + 0.1 * torch.randn_like(parameter)
    return gru


def inputs(topology: Topology, seed: int, share: float = 0.6, channels: int = CHANNELS) -> tuple[LatentVolume, LocalVolume]:
    """A global volume and a local one on the same blocks."""
    generator = torch.Generator().manual_seed(seed)
    size = topology.zero_row
    inside = torch.rand(size, generator=generator) < share
    count = torch.randint(0, 5, (size,), generator=generator).float() * inside
    mask = torch.cat([inside, inside.new_zeros(1)])[:, None]
    raw = torch.randn((size + 1, channels), generator=generator) * mask
    known = torch.cat([count > 0, inside.new_zeros(1)])[:, None]
    state = torch.tanh(torch.randn((size + 1, channels), generator=generator)) * known
    weight = (0.01 + 0.99 * torch.rand(size, generator=generator)) * inside
    slots = torch.arange(topology.blocks)
    local = LocalVolume(lattice(), topology, torch.tanh(raw), inside.float(), raw, weight, topology, slots)
    return LatentVolume(lattice(), topology, state, count), local


def test_the_start_is_close_to_the_running_mean_of_what_was_seen() -> None:
    topology, _ = cube(2, 1.0, 0)
    torch.manual_seed(1)
    gru = FusionGRU(CHANNELS, 6)
    state, local = inputs(topology, 0)
    out, mean = gru(state, local).detach(), RunningMean()(state, local)
    first = torch.cat([(state.count == 0) & local.known, torch.zeros(1, dtype=torch.bool)])
    assert float((out - mean).abs().mean()) < 0.1
    z = (local.weight / (local.weight + state.count))[:, None]
    by_hand = ((1 - z) * state.rows[:-1] + z * local.rows[:-1])[local.known]
    torch.testing.assert_close(mean[:-1][local.known], by_hand, atol=1e-6, rtol=1e-5)
    assert float((out - local.rows)[first].abs().mean()) < 0.15, "what was never seen before takes the local volume"
    for gate in (gru.update, gru.candidate):
        gate.convolutions[-1].weight.data.zero_()
    torch.testing.assert_close(gru(state, local), mean, atol=1e-6, rtol=1e-5)


def test_against_dense_convolutions() -> None:
    """The equations written down again on a dense grid in float64."""
    topology, low = cube(3, 0.5, 5)
    gru = trained(2).double()
    state, local = inputs(topology, 7)
    state = replace(state, rows=state.rows.double(), count=state.count.double())
    local = replace(local, rows=local.rows.double(), raw=local.raw.double(), weight=local.weight.double())
    inside = local.known
    mask = dense_of(inside.double()[:, None], topology, low, 3)

    def dense(rows: torch.Tensor) -> torch.Tensor:
        return dense_of(rows[:-1], topology, low, 3)

    def gate(module: torch.nn.Module, x: torch.Tensor) -> torch.Tensor:
        for number, layer in enumerate(module.convolutions):
            x = F.conv3d(torch.relu(x) if number else x, layer.weight, layer.bias, padding=1) * mask
        return x

    h, v, raw = dense(state.rows), dense(local.rows), dense(local.raw)
    count, weight = (dense_of(values[:, None], topology, low, 3) for values in (state.count, local.weight))
    z = torch.sigmoid(gate(gru.update, torch.cat([h, v], 1)) + torch.log(weight / count))
    r = torch.sigmoid(gate(gru.reset, torch.cat([h, v], 1)))
    learned = gate(gru.candidate, torch.cat([r * h, v], 1))
    learned[:, 3] = 0.5 * torch.tanh(learned[:, 3] / 0.5)  # the distance behind the surface is changed by no more than half
    candidate = torch.tanh(raw + learned)
    expected = rows_of((1 - z) * h + z * candidate, topology, low)
    found = gru(state, local)[:-1]
    torch.testing.assert_close(found[inside], expected[inside], atol=1e-10, rtol=1e-8)


def test_gradients_reach_every_parameter_and_are_finite() -> None:
    topology, _ = cube(2, 0.6, 0)
    gru = FusionGRU(CHANNELS, 6)
    state, local = inputs(topology, 1)
    local.raw.requires_grad_()
    out = gru(state, replace(local, rows=torch.tanh(local.raw)))
    (out * torch.randn_like(out)).sum().backward()
    for name, value in [*gru.named_parameters(), ("raw", local.raw)]:
        assert value.grad is not None and bool(torch.isfinite(value.grad).all()) and float(value.grad.abs().max()) > 0, name


def test_local_network_against_dense_convolutions() -> None:
    topology, low = cube(3, 0.5, 9)
    torch.manual_seed(0)
    network = LocalReconstruction(5, 6, CHANNELS).double()
    generator = torch.Generator().manual_seed(1)
    seen = torch.rand(topology.zero_row, generator=generator) < 0.5
    mask = torch.cat([seen, seen.new_zeros(1)])[:, None]
    rows = torch.relu(torch.randn((len(mask), 6), generator=generator, dtype=torch.float64)) * mask
    start = torch.randn((len(mask), CHANNELS), generator=generator, dtype=torch.float64) * mask
    x, present = dense_of(rows[:-1], topology, low, 3), dense_of(seen.double()[:, None], topology, low, 3)
    for number, layer in enumerate(network.convolutions):
        x = F.conv3d(torch.relu(x) if number else x, layer.weight, layer.bias, padding=1) * present
    x[:, 3] = 0.5 * torch.tanh(x[:, 3] / 0.5)
    expected = rows_of(x, topology, low) + start[:-1]
    found = network(rows, start, topology, seen)
    torch.testing.assert_close(found[:-1], expected, atol=1e-10, rtol=1e-8)
    assert not found[-1].any() and not found[:-1][~seen].any()


def test_what_the_sweep_is_sure_of_stays_whatever_was_learned() -> None:
    """A voxel surely in front of the surface stays nearly free, and one surely behind it stays solid, under any weights."""
    topology, _ = cube(2, 1.0, 0)
    torch.manual_seed(0)
    network, gru, head = LocalReconstruction(5, 6, 8), FusionGRU(8, 6), FieldHead(8, 6, 8)
    with torch.no_grad():
        for parameter in (*network.parameters(), *gru.parameters(), *head.density.parameters(), *head.body.parameters()):
            parameter.mul_(30).add_(torch.randn_like(parameter))
    seen = torch.ones(topology.zero_row, dtype=torch.bool)
    for signed, thinnest, thickest in ((1.0, 0.0, 0.1), (-1.0, 4.0, torch.inf)):
        start = torch.zeros(topology.zero_row + 1, 8)
        start[:-1, 3] = sdf_latent(torch.tensor(signed))
        raw = network(torch.rand(topology.zero_row + 1, 6), start, topology, seen)
        state = LatentVolume(lattice(), topology, torch.zeros_like(start), torch.zeros(topology.zero_row))
        one = torch.ones(topology.zero_row)
        local = LocalVolume(lattice(), topology, torch.tanh(raw), one, raw, one, topology, torch.arange(topology.blocks))
        for _ in range(3):
            state = replace(state, rows=gru(state, local).detach(), count=state.count + 1)
        thickness = torch.exp(head.thickness(state.rows[:-1])).detach()
        assert thinnest <= float(thickness.min()) and float(thickness.max()) <= thickest


def test_colour_latents_decode_to_their_colour() -> None:
    colour = torch.rand(100, 3) * 0.94 + 0.03
    back = torch.sigmoid(4.0 * torch.tanh(colour_latent(colour)))
    torch.testing.assert_close(back, colour, atol=1e-5, rtol=1e-4)
    extreme = colour_latent(torch.tensor([[0.0, 1.0, 0.5]]))
    assert bool(torch.isfinite(extreme).all()) and float(extreme.abs().max()) < 2


def test_fewer_digits_without_gradients_are_those_with_them() -> None:
    topology, _ = cube(2, 1.0, 0)
    gru, (state, local) = trained(), inputs(topology, 3)
    with torch.autocast("cpu", torch.bfloat16):
        with torch.no_grad():
            quick = gru(state, local)
        assert torch.equal(quick, gru(state, local))
