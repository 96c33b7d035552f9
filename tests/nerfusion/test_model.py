"""The whole model: any order and number of views, what a fusion step leaves alone, and that it does not drift."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldfuse.nerfusion.extras.two_lattices import solid_cells
from fieldfuse.nerfusion.lattice import LatentVolume, LocalVolume
from fieldfuse.nerfusion.model import ModelConfig, NerfusionModel
from fieldfuse.nerfusion.unproject import KeyFrame
from fieldfuse.volume.topology import VOXELS, Topology
from tests.nerfusion.made import SMALL, cameras, lattice, pictures, small_model


def local(model: NerfusionModel, views: list[int], seed: int = 0, shift: float = 0.0, shell: float = 0.0) -> LocalVolume:
    seen_by = cameras(4)
    pose = seen_by.world_from_camera.clone()
    pose[:, 0, 3] += shift
    seen_by = replace(seen_by, world_from_camera=pose)[views]
    return model.local_volume(KeyFrame(model.encode(pictures(4, seed)[views], seen_by), seen_by, 0.3, 3.5), lattice(32, shell))


def by_place(volume: LatentVolume) -> dict[tuple[int, int, int], torch.Tensor]:
    blocks = volume.rows[:-1].view(volume.topology.blocks, -1)
    return {tuple(key): rows for key, rows in zip(volume.topology.keys.tolist(), blocks, strict=True)}


@settings(max_examples=6, deadline=None)
@given(st.permutations(range(1, 4)), st.sampled_from([0.0, 1.0]))
def test_the_order_of_neighbours_does_not_matter(order: list[int], shell: float) -> None:
    model = small_model().eval()
    with torch.no_grad():
        one, two = local(model, [0, 1, 2, 3], shell=shell), local(model, [0, *order], shell=shell)
    assert torch.equal(one.topology.keys, two.topology.keys) and torch.equal(one.count, two.count)
    torch.testing.assert_close(one.rows, two.rows, atol=1e-4, rtol=1e-3)


@pytest.mark.parametrize("views", [1, 2, 4])
def test_any_number_of_views(views: int) -> None:
    model = small_model()
    volume = local(model, list(range(views)))
    assert float(volume.count.max()) == views
    assert bool(torch.isfinite(volume.rows).all()) and float(volume.rows.detach()[:-1][volume.known].std()) > 0.02
    volume.rows.square().sum().backward()
    for name, parameter in model.named_parameters():
        used = name.split(".")[0] in ("encoder", "sample", "direction", "local")
        assert (parameter.grad is not None and bool(torch.isfinite(parameter.grad).all())) == used, name


def test_nothing_in_sight_gives_an_empty_volume() -> None:
    model = small_model()
    seen_by = cameras(2)
    pose = seen_by.world_from_camera.clone()
    pose[:, 2, 3] = 50.0
    seen_by = replace(seen_by, world_from_camera=pose)
    volume = model.local_volume(KeyFrame(model.encode(pictures(2), seen_by), seen_by, far=3.0), lattice())
    state = model.fuse(model.start(lattice()), volume)
    assert volume.topology.blocks == 0 and state.topology.blocks == 0
    assert [len(rows) for rows in model.head(state)] == [1, 1]


def test_only_asked_voxels_are_filled() -> None:
    model = small_model().eval()
    whole = local(model, [0, 1])
    wanted = torch.rand(len(whole.count), generator=torch.Generator().manual_seed(0)) < 0.3
    seen_by = cameras(4)[[0, 1]]
    views = model.encode(pictures(4)[[0, 1]], seen_by)
    part = model.local_volume(KeyFrame(views, seen_by, 0.3, 3.5), lattice(), whole.topology, wanted)
    place = (whole.topology.find(part.topology.keys)[:, None] * VOXELS + torch.arange(VOXELS)).view(-1)
    asked = whole.count * wanted
    assert torch.equal(part.count, asked[place]) and float(part.count.sum()) == float(asked.sum())
    assert not part.rows[:-1][~wanted[place]].any()


def test_outside_the_local_volume_every_bit_stays() -> None:
    model = small_model().eval()
    with torch.no_grad():
        state = model.fuse(model.start(lattice()), local(model, [0, 1, 2], shift=-0.5))
        new = local(model, [1, 2, 3], seed=1, shift=0.6)
        after = model.fuse(state, new)
    slots = after.topology.find(state.topology.keys)
    assert torch.equal(slots, torch.arange(state.topology.blocks)), "blocks keep their slots"
    touched = torch.zeros(after.topology.zero_row, dtype=torch.bool)
    place = (after.topology.find(new.topology.keys)[:, None] * VOXELS + torch.arange(VOXELS)).view(-1)
    touched[place] = new.known
    old = len(state.count)
    kept = ~touched[:old]
    assert 0 < int((kept & state.known).sum()) < int(state.known.sum()), "the test needs both kinds of voxels"
    assert torch.equal(after.rows[:old][kept], state.rows[:-1][kept]) and torch.equal(after.count[:old][kept], state.count[kept])
    changed = touched[:old] & state.known
    assert bool((after.rows[:old][changed] != state.rows[:-1][changed]).any(1).float().mean() > 0.9)
    assert not after.rows[old:-1][~touched[old:]].any() and not after.rows[-1].any()


# Eight seeds: with gates twice as strong as at the start the state moves by 0.03 at the most after step 100; three times as strong, where
# the candidate's answer to the state comes near to one, by 0.33, and by 0.04 in the mean.
# Of the latter the first 300 steps are made, in which two of the seeds moved by 0.13 and 0.19, and by 0.02 in the mean.
@pytest.mark.parametrize(("gain", "times", "most", "mean"), [(2.0, 1000, 0.05, 0.005), (3.0, 300, 0.3, 0.03)])
def test_the_same_frame_a_thousand_times_does_not_drift(gain: float, times: int, most: float, mean: float) -> None:
    model = small_model(2).eval()
    for parameter in model.fusion.parameters():
        parameter.data.mul_(gain)
    seen_by = cameras(1)
    pose = seen_by.world_from_camera.clone()
    pose[:, 2, 3] = -1.1
    seen_by = replace(seen_by, world_from_camera=pose)
    small = replace(lattice(16), resolution=8)
    with torch.no_grad():
        frame = KeyFrame(model.encode(pictures(1), seen_by), seen_by, 0.1)
        one = model.local_volume(frame, small, Topology(torch.tensor([[0, 0, 0]])))
        assert int(one.known.sum()) > 20
        state, moves, early = model.start(small), [], None
        for step in range(times):
            after = model.fuse(state, one)
            if step >= 1:
                moves.append(float((after.rows - state.rows).abs().max()))
            state = after
            early = state.rows if step == 99 else early
    assert bool(torch.isfinite(state.rows).all()) and float(state.rows.abs().max()) <= 1
    torch.testing.assert_close(state.count, times * one.weight * one.known, rtol=1e-3, atol=0.0)
    assert early is not None
    drift = (state.rows - early)[:-1][one.known].abs()
    assert float(drift.max()) < most and float(drift.mean()) < mean
    assert moves[-1] < 2e-3 and moves[-1] < 0.1 * moves[0], "it settles"


def test_two_equal_local_volumes_fuse_to_themselves_at_the_start_of_training() -> None:
    model = NerfusionModel(replace(SMALL, fusion="mean"))
    volume = local(model, [0, 1])
    state = model.fuse(model.fuse(model.start(lattice()), volume), volume)
    torch.testing.assert_close(state.rows, volume.rows)


def test_gradients_flow_through_time() -> None:
    model = small_model()
    first, second = local(model, [0, 1]), local(model, [2, 3], seed=1)
    raw = first.raw.detach().requires_grad_()
    first = replace(first, raw=raw, rows=torch.tanh(raw))
    state = model.fuse(model.fuse(model.start(lattice()), first), second)
    thickness, features = model.head(state)
    (thickness.sum() + features.sum()).backward()
    assert raw.grad is not None and float(raw.grad.abs().max()) > 0
    cut = model.fuse(model.fuse(model.start(lattice()), first).detached(), second.detached())
    assert cut.rows.requires_grad and not first.detached().rows.requires_grad


def test_ablations() -> None:
    for change in ({"variance": False}, {"direction": 0}, {"fusion": "mean"}, {"decoder": "per_sample"}):
        model = small_model(config=replace(SMALL, **change)).eval()
        state = model.fuse(model.start(lattice()), local(model, [0, 1, 2]))
        thickness, features = model.head(state)
        assert bool(torch.isfinite(thickness).all()) and features.shape[1] == SMALL.features
        assert int(solid_cells(state, thickness, None).sum()) > 0
    assert sum(p.numel() for p in NerfusionModel(ModelConfig()).parameters()) * 4 < 10 * 2**20
    off = small_model(config=replace(SMALL, variance=False)).eval()
    volume, single = local(off, [0, 1, 2]), local(off, [0])
    assert bool(torch.isfinite(volume.rows).all()) and bool(torch.isfinite(single.rows).all())
