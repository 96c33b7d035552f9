"""The loop over key frames: one level is the plain recurrence, more levels look finer only where something is; memory stays bounded."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import torch

from fieldfuse.backends.constants import INSIDE
from fieldfuse.capture.types import Views
from fieldfuse.errors import InputError, Interrupted
from fieldfuse.nerfusion.block_conv import BlockConv3d
from fieldfuse.nerfusion.cameras import Cameras
from fieldfuse.nerfusion.fusion import CACHED, Fused, Fusion, FusionOptions, fuse_views
from fieldfuse.nerfusion.keyframes import KeyFrames
from fieldfuse.nerfusion.lattice import Lattice, part
from fieldfuse.nerfusion.model import NerfusionModel
from fieldfuse.nerfusion.unproject import KeyFrame
from fieldfuse.nerfusion.volume_net import SCALE, START
from fieldfuse.progress import Progress
from fieldfuse.volume.space import Space
from tests.nerfusion.made import HEIGHT, INTRINSICS, WIDTH, poses, small_model

SPACE = Space((0.0, 0.0, 0.0), 0.8, 0.0)
FAR = 2.6


def captured(count: int = 5) -> tuple[Views, KeyFrames]:
    generator = np.random.default_rng(0)
    images = [generator.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8) for _ in range(count)]
    views = Views([str(i) for i in range(count)], images, [INTRINSICS] * count, poses(count, 0.2), np.zeros(count, bool))
    near = np.array([[max(i - 1, 0), min(i + 1, count - 1)] for i in range(count)])
    return views, KeyFrames(np.arange(count), near)


def opinionated(seed: int = 0) -> NerfusionModel:
    """A model whose densities differ widely from place to place, as a trained one's do: the local network tells them, since pictures of
    noise agree nowhere."""
    model = small_model(seed).eval()
    head, last = model.to_field, model.local.convolutions[-1]
    assert isinstance(last, BlockConv3d)
    with torch.no_grad():
        last.weight[INSIDE] *= 100
        head.density.weight.zero_()
        head.density.bias.fill_((-0.6 - START) / SCALE)
        head.steep.fill_(2.0)
    return model


def test_one_level_is_the_plain_recurrence() -> None:
    model = opinionated()
    views, keys = captured(3)
    lattice = Lattice(SPACE, 32)
    with torch.no_grad():
        state = model.start(lattice)
        for step in fuse_views(model, views, keys, lattice, FusionOptions(1, 0.2, FAR)):
            group = keys.group(step.frame)
            cameras = Cameras.of([INTRINSICS] * len(group), views.world_from_camera[group])
            images = torch.stack([torch.from_numpy(views.images[i]).permute(2, 0, 1).float() / 255 for i in group])
            encoded = [model.encode(images[k : k + 1], cameras[k])[0] for k in range(len(group))]
            state = model.fuse(state, model.local_volume(KeyFrame(encoded, cameras, 0.2, FAR), lattice))
            found = part(step.volume, state.topology)
            assert step.volume.topology.blocks == state.topology.blocks
            assert torch.equal(found.count, state.count)
            torch.testing.assert_close(found.rows, state.rows, atol=1e-5, rtol=1e-4)
            assert bool(step.allowed.all()) and step.seconds >= step.encode_seconds >= 0


def run(levels: int, gamma: float, resolution: int = 48, prune_every: int = 100) -> list[tuple[int, int, int]]:
    """(frame, known corners, blocks) after each of three key frames."""
    views, keys = captured(3)
    steps = fuse_views(opinionated(), views, keys, Lattice(SPACE, resolution), FusionOptions(levels, 0.2, FAR, gamma, prune_every))
    return [(step.frame, int(step.volume.known.sum()), step.volume.topology.blocks) for step in steps]


def test_a_finer_level_knows_only_where_the_coarse_one_is_not_see_through() -> None:
    dense, half, empty = run(1, 0.6), run(2, 0.6), run(2, 1e-300)
    assert [frame for frame, _, _ in half] == [0, 1, 2]
    assert 0.02 * dense[-1][1] < half[-1][1] < 0.9 * dense[-1][1]
    assert all(known == 0 for _, known, _ in empty), "where nothing is solid, nothing is looked at finer"
    everything = run(2, 1 - 1e-9)
    # A coarse cell that reaches behind what is hidden is not whole, so a little less than everything.
    assert everything[-1][1] > 0.75 * dense[-1][1]


@pytest.mark.parametrize(("seed", "gamma"), [(0, 0.7), (1, 0.6), (3, 0.7)])  # the paper's 0.6, and a laxer one
def test_the_finer_levels_cells_are_allowed_by_the_coarser_ones_and_pruning_forgets_the_others(seed: int, gamma: float) -> None:
    views, keys = captured()
    model = opinionated(seed)
    fusion = Fusion(model, Lattice(SPACE, 32), FusionOptions(3, 0.2, FAR, gamma))
    assert [store.lattice.resolution for store in fusion.stores] == [8, 16, 32]
    for key in keys.indices:
        cameras = Cameras.of([INTRINSICS], views.world_from_camera[key : key + 1])
        image = torch.from_numpy(views.images[key]).permute(2, 0, 1)[None].float() / 255
        with torch.no_grad():
            fusion.add(model.encode(image, cameras), cameras)
    allowed = fusion.allowed()
    assert allowed.shape == fusion.volume.count.shape and 0 < int(allowed.sum()) < len(allowed)
    blocks = fusion.volume.topology.blocks
    keys_before, rows_before = fusion.volume.topology.keys.clone(), fusion.volume.rows.clone()
    fusion.prune()
    after = fusion.volume
    assert 0 < after.topology.blocks < blocks
    slots = {tuple(key): slot for slot, key in enumerate(keys_before.tolist())}
    for slot, key in enumerate(after.topology.keys.tolist()):
        old = slots[tuple(key)]
        assert torch.equal(after.rows[slot * 512 : slot * 512 + 512], rows_before[old * 512 : old * 512 + 512])
    assert bool(fusion.allowed().view(-1, 512).any(1).all()), "every block left holds an allowed cell"


def test_encoded_pictures_are_kept_only_for_a_while(monkeypatch: pytest.MonkeyPatch) -> None:
    model = small_model().eval()
    encoded: list[int] = []
    encode = model.encode

    def counted(images: torch.Tensor, cameras: Cameras, side: int) -> object:
        encoded.append(len(images))
        return encode(images, cameras, side)

    monkeypatch.setattr(model, "encode", counted)
    views, keys = captured(CACHED + 4)
    lattice = Lattice(SPACE, 16)
    for _ in fuse_views(model, views, keys, lattice, FusionOptions(1, 0.2, FAR)):
        pass
    assert len(encoded) == len(views), "neighbours that come again soon are not encoded again"
    far = KeyFrames(np.array([0, len(views) - 1]), np.array([[len(views) - 1, len(views) - 1], [0, 0]]))
    assert len(list(fuse_views(model, views, far, lattice, FusionOptions(1, 0.2, FAR)))) == 2


def test_measured_depth_is_asked_only_when_it_is_wanted() -> None:
    model = opinionated()
    plain, keys = captured(3)
    deep = captured(3)[0]
    deep.depths = [None, np.full((HEIGHT, WIDTH), 1.5, np.float32), np.zeros((HEIGHT, WIDTH), np.float32)]
    lattice = Lattice(SPACE, 32)

    def fused(views: Views, measured: bool) -> list[torch.Tensor]:
        options = FusionOptions(1, 0.5, FAR, measured=measured)
        return [state.volume.rows.clone() for state in fuse_views(model, views, keys, lattice, options)]

    without, with_it = fused(plain, True), fused(deep, True)
    assert all(torch.equal(*pair) for pair in zip(without, fused(deep, False), strict=True))
    assert torch.equal(without[0], with_it[0])
    assert without[1].shape != with_it[1].shape or not torch.allclose(without[1], with_it[1])
    assert all(bool(torch.isfinite(rows).all()) for rows in with_it)


def test_what_cannot_be_is_refused() -> None:
    views, keys = captured(2)
    model = small_model().eval()
    with pytest.raises(InputError, match="no key frames"):
        next(fuse_views(model, views, KeyFrames(np.zeros(0, int), np.zeros((0, 2), int)), Lattice(SPACE, 32)))
    with pytest.raises(InputError, match="levels"):
        next(fuse_views(model, views, keys, Lattice(SPACE, 24), FusionOptions(2)))


def test_a_stop_is_honoured_between_key_frames() -> None:
    class Stopping(Progress):
        seen: int = 0

        def update(self, done: float, total: float, note: str = "") -> None:
            self.seen = int(done)

        def stopping(self) -> bool:
            return self.seen >= 2

    views, keys = captured(4)
    steps: Iterator[Fused] = fuse_views(small_model().eval(), views, keys, Lattice(SPACE, 16), FusionOptions(1, 0.2, FAR), Stopping())
    with pytest.raises(Interrupted):
        list(steps)


def test_where_a_device_works_behind_the_processor_pictures_are_encoded_ahead(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of some key frames at once, before they are needed, each once, and with the same result."""
    model, (views, keys), lattice = opinionated(), captured(11), Lattice(SPACE, 8)
    encode, together = model.encode, list[int]()

    def counted(images: torch.Tensor, *rest: object) -> object:
        together.append(len(images))
        return encode(images, *rest)

    def fused() -> tuple[list[int], torch.Tensor]:
        together.clear()
        known = list[int]()
        for step in fuse_views(model, views, keys, lattice, FusionOptions(1, 0.1, FAR)):
            known.append(sum(together))
            volume = step.volume
        return known, volume.rows.clone()

    monkeypatch.setattr(model, "encode", counted)
    one_by_one, expected = fused()
    assert set(together) == {1} and one_by_one == [2, *range(3, 12), 11]
    monkeypatch.setattr("fieldfuse.nerfusion.fusion.is_cpu", lambda device: False)
    ahead, found = fused()
    # Four key frames and their neighbours; the next ones come when the fourth is fused.
    assert together == [5, 4, 2] and ahead == [5, 5, 5, 9, 9, 9, 9, 11, 11, 11, 11]
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-5)
