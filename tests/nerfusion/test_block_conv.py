"""Block-sparse convolution against dense `conv3d`: values, gradients, masks, chunks, types."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldfuse.nerfusion.block_conv import BlockConv3d, _clear, block_conv3d
from fieldfuse.volume.topology import VOXELS, Topology


def dense_of(rows: torch.Tensor, topology: Topology, low: torch.Tensor, size: int) -> torch.Tensor:
    """(1, C, Z, Y, X) of size³ blocks from key `low`, by the plain definition of the row order; zero elsewhere."""
    out = torch.zeros((rows.shape[1], size * 8, size * 8, size * 8), dtype=rows.dtype)
    for slot, key in enumerate(topology.keys):
        x, y, z = ((key - low) * 8).tolist()
        block = rows[slot * VOXELS : (slot + 1) * VOXELS].T.reshape(-1, 8, 8, 8)
        out = out.index_put((torch.arange(len(out))[:, None, None, None], *_index(z, y, x)), block)
    return out[None]


def _index(z: int, y: int, x: int) -> tuple[torch.Tensor, ...]:
    line = torch.arange(8)
    return (z + line)[:, None, None], (y + line)[:, None], x + line


def rows_of(dense: torch.Tensor, topology: Topology, low: torch.Tensor) -> torch.Tensor:
    """(M · 512, C), the inverse of `dense_of`."""
    blocks = []
    for key in topology.keys:
        x, y, z = ((key - low) * 8).tolist()
        blocks.append(dense[0, :, z : z + 8, y : y + 8, x : x + 8].reshape(dense.shape[1], -1).T)
    return torch.cat(blocks)


def cube(size: int, share: float, seed: int) -> tuple[Topology, torch.Tensor]:
    """Some blocks of a size³ cube in mixed order, and its lowest key."""
    generator = torch.Generator().manual_seed(seed)
    line = torch.arange(size)
    keys = torch.stack(torch.meshgrid(line, line, line, indexing="ij"), -1).view(-1, 3)
    low = torch.tensor([-2, 5, -1])
    kept = torch.randperm(len(keys), generator=generator)[: max(int(share * len(keys)), 1)]
    return Topology(keys[kept] + low), low


def check(topology: Topology, low: torch.Tensor, size: int, kind: torch.dtype, masked: bool, zero_row: bool, chunk: int, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    rows = topology.zero_row
    occupied = torch.rand(rows, generator=generator) < (0.5 if masked else 2)
    values = torch.randn(rows, 5, generator=generator, dtype=kind) * occupied[:, None]
    weight = torch.randn(3, 5, 3, 3, 3, generator=generator, dtype=kind)
    bias = torch.randn(3, generator=generator, dtype=kind)
    pull = torch.randn(rows, 3, generator=generator, dtype=kind)

    ours = [tensor.clone().requires_grad_() for tensor in (values, weight, bias)]
    given_rows = torch.cat([ours[0], torch.zeros(1, 5, dtype=kind)]) if zero_row else ours[0]
    out = block_conv3d(given_rows, topology, ours[1], ours[2], occupied if masked else None, chunk)
    assert len(out) == len(given_rows) and (not zero_row or not out[-1].any())
    assert not out[:rows][~occupied].any()
    (out[:rows] * pull).sum().backward()

    theirs = [tensor.clone().requires_grad_() for tensor in (values, weight, bias)]
    dense = F.conv3d(dense_of(theirs[0], topology, low, size), theirs[1], theirs[2], padding=1)
    expected = rows_of(dense, topology, low) * occupied[:, None]
    (expected * pull).sum().backward()

    tolerance = 1e-11 if kind == torch.float64 else 2e-4
    torch.testing.assert_close(out[:rows], expected, atol=tolerance, rtol=tolerance)
    for one, two in zip(ours, theirs, strict=True):
        assert one.grad is not None and two.grad is not None
        scale = float(two.grad.abs().max())
        torch.testing.assert_close(one.grad / scale, two.grad / scale, atol=tolerance, rtol=tolerance)


@pytest.mark.parametrize("kind", [torch.float64, torch.float32])
def test_exact_against_dense_when_all_blocks_are_there(kind: torch.dtype) -> None:
    topology, low = cube(3, 1.0, 0)
    assert topology.blocks == 27
    check(topology, low, 3, kind, masked=False, zero_row=True, chunk=64, seed=0)


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([0.05, 0.3, 0.8]), st.booleans(), st.booleans(), st.integers(1, 9))
def test_exact_against_dense_on_sparse_blocks(seed: int, share: float, masked: bool, zero_row: bool, chunk: int) -> None:
    topology, low = cube(3, share, seed)
    check(topology, low, 3, torch.float64, masked, zero_row, chunk, seed)


def test_numerical_gradient_through_two_layers() -> None:
    topology = Topology(torch.tensor([[0, 0, 0], [1, 0, 0], [5, 5, 5]]))
    occupied = torch.zeros(topology.zero_row, dtype=torch.bool)
    occupied[[7, 63, 511, 512, 512 + 56, 1030]] = True
    one = BlockConv3d(2, 3, chunk=2).double()
    two = BlockConv3d(3, 1, bias=False, chunk=1).double()
    cells = occupied.nonzero().view(-1)
    start = torch.randn(len(cells), 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1)).requires_grad_()

    def network(values: torch.Tensor, *_: torch.Tensor) -> torch.Tensor:
        rows = torch.zeros(topology.zero_row + 1, 2, dtype=torch.float64).index_put((cells,), values)
        hidden = torch.tanh(one(rows, topology, occupied))
        return two(hidden, topology, occupied)[cells]

    assert torch.autograd.gradcheck(network, (start, *one.parameters(), *two.parameters()), fast_mode=True)


def test_only_what_needs_a_gradient_gets_one_and_inputs_stay_as_they_are() -> None:
    topology, _ = cube(2, 0.7, 3)
    rows = torch.randn(topology.zero_row + 1, 4)
    rows[-1] = 0
    before = rows.clone()
    layer = BlockConv3d(4, 4)
    layer.weight.requires_grad_(False)
    layer(rows, topology).sum().backward()
    assert layer.bias is not None and layer.bias.grad is not None and layer.weight.grad is None
    assert float(layer.bias.grad[0]) == topology.zero_row and torch.equal(rows, before)


def test_shapes_that_do_not_fit() -> None:
    topology, _ = cube(2, 1.0, 0)
    layer = BlockConv3d(4, 4)
    for rows in (torch.zeros(topology.zero_row - 1, 4), torch.zeros(topology.zero_row, 3), torch.zeros(topology.zero_row)):
        with pytest.raises(ValueError, match="do not fit"):
            layer(rows, topology)
    with pytest.raises(ValueError, match="occupied"):
        layer(torch.zeros(topology.zero_row, 4), topology, torch.ones(5, dtype=torch.bool))
    empty = Topology(torch.zeros((0, 3), dtype=torch.int32))
    assert layer(torch.zeros(1, 4), empty).shape == (1, 4) and layer(torch.zeros(0, 4), empty).shape == (0, 4)


@pytest.mark.parametrize("kind", [torch.float64, torch.float32, torch.float16, torch.bfloat16])
@pytest.mark.parametrize("channels", [1, 3, 8])
def test_rows_that_are_not_kept_are_zero_whatever_they_were(kind: torch.dtype, channels: int) -> None:
    rows = torch.randn(64, channels).to(kind)
    rows[::5] = torch.nan
    rows[1::7] = -torch.inf
    kept = torch.rand(64) < 0.5
    expected = rows.clone()
    expected[~kept] = 0
    _clear(rows, kept)
    assert torch.equal(rows.nan_to_num(17.0), expected.nan_to_num(17.0))
