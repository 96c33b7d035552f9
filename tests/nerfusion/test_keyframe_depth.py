"""The sweeps of all key frames: who bears witness for whom, that each is made once, and that the fusion uses them."""

from __future__ import annotations

import gc
import weakref
from dataclasses import replace

import numpy as np
import pytest
import torch

from fieldfuse.camera import Array
from fieldfuse.capture.types import Views
from fieldfuse.nerfusion.extras import keyframe_depth
from fieldfuse.nerfusion.extras.keyframe_depth import LEAST_OVERLAP, MOST, KeyframeDepth, overlapping
from fieldfuse.nerfusion.extras.plane_sweep import DepthDistribution
from fieldfuse.nerfusion.fusion import FusionOptions, fuse_views
from fieldfuse.nerfusion.images import ImageCache
from fieldfuse.nerfusion.keyframes import KeyFrames
from fieldfuse.poses.overlap import overlap
from tests.nerfusion.made import HEIGHT, INTRINSICS, WIDTH, lattice, small_model, wall_pictures
from tests.nerfusion.made import poses as poses_in_line

NEAR, FAR = 0.5, 4.0


def captured(count: int = 5) -> tuple[Views, KeyFrames]:
    images, poses = wall_pictures(count, 2.0)
    pictures = [(image.permute(1, 2, 0).numpy() * 255).round().astype(np.uint8) for image in images]
    views = Views([str(i) for i in range(count)], pictures, [INTRINSICS] * count, poses, np.zeros(count, bool))
    near = np.array([[max(i - 1, 0), min(i + 1, count - 1)] for i in range(count)])
    return views, KeyFrames(np.arange(count), near)


def depths(views: Views, keys: KeyFrames, others: list[list[int]], measured: bool = False) -> KeyframeDepth:
    return KeyframeDepth(ImageCache(views, measured=measured), keys, others, NEAR, FAR)


def around(count: int, radius: float = 2.0) -> Array:
    """(count, 4, 4) cameras on a circle that look at its middle."""
    out = np.tile(np.eye(4), (count, 1, 1))
    for k, angle in enumerate(np.linspace(0, 2 * np.pi, count, endpoint=False)):
        out[k, :3, 0] = np.cos(angle), 0, -np.sin(angle)
        out[k, :3, 2] = np.sin(angle), 0, np.cos(angle)
        out[k, :3, 3] = -radius * out[k, :3, 2]
    return out


def test_witnesses_overlap_and_do_not_stand_opposite() -> None:
    poses = around(28)
    keys = KeyFrames(np.arange(0, 28, 2), np.zeros((14, 2), np.int64))
    found = overlapping(keys, poses, [INTRINSICS] * 28, 2.0)
    assert len(found) == 14
    for at, others in enumerate(found):
        steps = [min((other - at) % 14, (at - other) % 14) for other in others]
        assert sorted(steps) == [1, 1, 2, 2], "26 and 51 degrees on either side"
    shares = overlap(poses[keys.indices], [INTRINSICS] * 14, 2.0)
    assert all(shares[at, other] > LEAST_OVERLAP < shares[other, at] for at, others in enumerate(found) for other in others)
    assert overlapping(KeyFrames(np.array([3]), np.array([[2, 4]])), poses, [INTRINSICS] * 28, 2.0) == [[]]
    rows = overlapping(KeyFrames(np.arange(12), np.zeros((12, 2), np.int64)), poses_in_line(12, 0.05), [INTRINSICS] * 12, 2.0)
    assert all(len(row) == MOST and at not in row for at, row in enumerate(rows))


def test_each_sweep_is_made_once_and_again_only_when_it_was_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[int] = []
    cost_volume = keyframe_depth.cost_volume

    def counted(*args: object) -> object:
        made.append(1)
        return cost_volume(*args)  # type: ignore[arg-type]

    monkeypatch.setattr(keyframe_depth, "cost_volume", counted)
    views, keys = captured(5)
    witnesses = [[j for j in range(5) if j != i] for i in range(5)]
    kept = depths(views, keys, witnesses)
    tables = [kept(at).table for at in range(5)]
    assert len(made) == 5
    assert torch.equal(kept(2).table, tables[2]) and len(made) == 6, "a second time it is compared again, and its witnesses are not"
    monkeypatch.setattr(keyframe_depth, "CACHED", 2)
    forgetful = depths(views, keys, witnesses)
    assert all(torch.equal(forgetful(at).table, table) for at, table in enumerate(tables)) and len(made) > 11


def test_what_it_keeps_goes_with_it() -> None:
    views, keys = captured(3)
    kept = depths(views, keys, [[1], [0], [1]])
    kept(0)
    gone = weakref.ref(kept)
    gc.disable()
    try:
        del kept
        assert gone() is None, "without waiting for the garbage collector"
    finally:
        gc.enable()


def test_witnesses_mend_a_key_frame_that_sees_no_texture() -> None:
    """The middle picture and its neighbours for the sweep are flat where the other key frames' pictures are not."""
    views, keys = captured(7)
    images = list(views.images)
    for index in (2, 3, 4):
        images[index] = np.full_like(images[index], 128)
    views = replace(views, images=images)
    neighbours = keys.neighbours.copy()
    for index, pair in {0: (1, 1), 1: (0, 0), 5: (6, 6), 6: (5, 5)}.items():
        neighbours[index] = pair
    keys = KeyFrames(keys.indices, neighbours)

    def wrong(distribution: DepthDistribution) -> float:
        likely = -torch.diff(distribution.table[0], dim=0)
        inverse = distribution.lowest + (likely.argmax(0) + 0.5) * distribution.step
        return float((inverse * 2.0 - 1).abs().median())

    own_estimate = depths(views, keys, [[]] * 7)(3)
    held = depths(views, keys, [[0, 1, 5, 6]] * 7)(3)
    assert wrong(held) < 0.1 < wrong(own_estimate)


def test_the_fusion_takes_them() -> None:
    views, keys = captured(4)
    model = small_model().eval()
    options = FusionOptions(1, NEAR, FAR)

    def fused(witnesses: list[list[int]] | None) -> torch.Tensor:
        rows = torch.zeros(0)
        for state in fuse_views(model, views, keys, lattice(), options, others=witnesses):
            rows = state.volume.rows.clone()
        return rows

    own_estimate = fused(None)
    torch.testing.assert_close(fused([[]] * 4), own_estimate, atol=1e-5, rtol=1e-4)
    held = fused([[1, 2], [0, 3], [0, 3], [1, 2]])
    assert bool(torch.isfinite(held).all()) and (held.shape != own_estimate.shape or not torch.allclose(held, own_estimate, atol=1e-3))


def test_a_sensor_speaks_through_its_key_frame() -> None:
    views, keys = captured(3)
    flat = replace(views, images=[np.full_like(image, 128) for image in views.images])
    flat.depths = [None, np.full((HEIGHT, WIDTH), 2.0, np.float32), None]
    point = torch.tensor([[0.0, 0.0, 0.5]])  # behind the wall at z = 0

    def open_there(measured: bool) -> float:
        return float(depths(flat, keys, [[1], [], [1]], measured)(0).look(point, torch.tensor([0.1])).visibility)

    assert open_there(True) < 0.2 < open_there(False)


def test_no_depth_at_all_is_refused() -> None:
    views, keys = captured(3)
    with pytest.raises(ValueError, match="nearest or a farthest"):
        KeyframeDepth(ImageCache(views), keys, [[]] * 3, 0.0, float("inf"))


def test_witnesses_and_silhouettes_together_are_refused() -> None:
    views, keys = captured(3)
    options = FusionOptions(1, NEAR, FAR, empty=lambda points: points[:, 2] < 0)
    steps = fuse_views(small_model().eval(), views, keys, lattice(), options, others=[[1], [0], [1]])
    with pytest.raises(ValueError, match="one of the two"):
        next(steps)
