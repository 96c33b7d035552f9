"""Which frames a sample uses, where its space lies, and what the mixture hands out."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldfuse.errors import InputError
from fieldfuse.nerfusion.training import samples
from fieldfuse.nerfusion.training.mixture import Mixture
from fieldfuse.nerfusion.training.procedural import ProceduralScene
from fieldfuse.nerfusion.training.rendering import in_sight, picture_rays
from fieldfuse.nerfusion.training.samples import (
    Pictures,
    choose_views,
    depth_range,
    draw_sample,
    lattice_resolution,
    region_around,
    surface_points,
    view_distance,
)
from fieldfuse.nerfusion.training.settings import PictureSettings
from fieldfuse.volume.space import Space
from tests.nerfusion.training import layouts
from tests.nerfusion.training.tiny import tiny_settings


def choose(count: int, ordered: bool, kind: str, seed: int, views: int = 3, key_frames: int = 1, targets: int = 2) -> Any:
    """References and targets of a ring of cameras at a distance of 2."""
    scene: Any = SimpleNamespace(world_from_camera=ring(count), ordered=ordered, kind=kind, depth_hint=2.0)
    return choose_views(scene, np.random.default_rng(seed), PictureSettings(views=views, targets=targets), key_frames)


def ring(count: int) -> np.ndarray:
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    poses = np.tile(np.eye(4), (count, 1, 1))
    for pose, a in zip(poses, angles, strict=True):
        forward = np.array([-np.cos(a), -np.sin(a), 0])
        right = np.cross(forward, [0, 0, 1.0])
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
        pose[:3, 3] = -2 * forward
    return poses


@settings(max_examples=60, deadline=None)
@given(
    count=st.integers(4, 120),
    ordered=st.booleans(),
    kind=st.sampled_from(["room", "object"]),
    views=st.integers(1, 4),
    key_frames=st.integers(1, 5),
    targets=st.integers(1, 4),
    seed=st.integers(0, 99),
)
def test_choices_are_always_usable(count: int, ordered: bool, kind: str, views: int, key_frames: int, targets: int, seed: int) -> None:
    given = count, ordered, kind, seed, views, key_frames, targets
    if count < views + 1:
        with pytest.raises(InputError, match=f"at least {views + 1} frames"):
            choose(*given)
        return
    references, wanted = choose(*given)
    assert references.shape == (key_frames, views) and wanted.shape == (key_frames, targets)
    assert references.min() >= 0 and max(references.max(), wanted.max()) < count
    for row, others in zip(references, wanted, strict=True):
        assert len(set(row)) == views and not set(row) & set(others)


def test_key_frames_of_a_video_are_two_to_five_percent_of_it() -> None:
    """The paper's rule for rooms: they follow each other in time, 20 to 50 frames apart."""
    for seed in range(20):
        references, _ = choose(1000, True, "room", seed, key_frames=4, targets=1)
        steps = np.diff(references[:, 0])
        assert np.all(steps == steps[0]) and 20 <= steps[0] <= 50
        for row in references:
            # Neighbours in time, on both sides; at the ends of the video both on one side.
            assert sorted(np.abs(row - row[0])) in ([0, steps[0], steps[0]], [0, steps[0], 2 * steps[0]])
            assert steps[0] < row[0] < 999 - steps[0] or np.ptp(row) == 2 * steps[0]


def test_objects_use_sixteen_pictures_and_refer_to_near_ones() -> None:
    apart = view_distance(ring(200), 2.0)
    for seed in range(10):
        references, targets = choose(200, False, "object", seed, key_frames=12)
        used = np.unique(np.concatenate([references.ravel(), targets.ravel()]))
        assert len(used) <= 16
        for row in references:
            others = [apart[row[0], i] for i in used if i != row[0]]
            assert apart[row[0], row[1:]].max() <= np.sort(others)[4]


@pytest.mark.parametrize(("ordered", "kind"), [(False, "object"), (True, "room")])
def test_half_of_the_targets_are_near_and_the_others_anywhere(ordered: bool, kind: str) -> None:
    apart = view_distance(ring(60), 2.0)
    near, far = [], []
    for seed in range(60):
        references, targets = choose(60, ordered, kind, seed)
        near.append(apart[references[0, 0], targets[0, 0]])
        far.append(apart[references[0, 0], targets[0, 1]])
    middle = float(np.median(apart[0]))
    assert np.median(near) < 0.6 * middle < np.median(far) and max(far) > 1.5 * middle


def test_rays_that_end_behind_what_a_reference_shows_are_left_out() -> None:
    """Two cameras face each other across a plane between them: neither sees what the other one does."""
    poses = torch.eye(4).repeat(2, 1, 1)
    poses[1, :3, :3] = torch.diag(torch.tensor([-1.0, 1.0, -1.0]))
    poses[1, 2, 3] = 2.0
    flat = torch.full((2, 8, 8), 1.0)
    pictures = Pictures(torch.rand(2, 3, 8, 8), torch.tensor([[8.0, 8, 4, 4]]).repeat(2, 1), poses, flat)
    rays, key = picture_rays(pictures, 1), torch.tensor([0])
    assert bool(in_sight(rays, pictures, key).all())  # the plane itself, seen from behind
    thick = replace(pictures, depths=torch.stack([flat[0] - 0.2, flat[1] - 0.2]))
    assert not bool(in_sight(picture_rays(thick, 1), thick, key).any())
    unknown = replace(pictures, depths=torch.stack([torch.zeros(8, 8), flat[1] - 0.2]))
    assert bool(in_sight(picture_rays(unknown, 1), unknown, key).all())


def test_samples_move_with_their_scene_and_do_not_depend_on_where_it_lies() -> None:
    """The frame of reference is taken in float64: a scene 6000 km away gives the same sample."""

    def draw(offset: float):  # type: ignore[no-untyped-def]
        scene = ProceduralScene("room", np.random.default_rng(3), 48, 12)
        scene.world_from_camera[:, :3, 3] += offset
        wanted = tiny_settings()
        return draw_sample(scene, np.random.default_rng(0), wanted.pictures, wanted.volume, 2)

    near, far = draw(0.0), draw(6e6)
    assert torch.allclose(near.pictures.world_from_camera, far.pictures.world_from_camera, atol=1e-4)
    assert near.space.half == pytest.approx(far.space.half, rel=1e-3)
    assert float(far.pictures.world_from_camera[far.references[0, 0], :3, 3].abs().max()) < 1e-3


def test_a_closed_region_holds_what_the_pictures_show_and_an_open_one_a_part_of_it() -> None:
    scene = ProceduralScene("room", np.random.default_rng(5), 64, 12)
    pictures = scene.pictures([2, 5, 8])
    points = surface_points(pictures, torch.arange(3))
    # By hand: the middle pixel of the first picture.
    row, column = pictures.images.shape[2] // 2, pictures.images.shape[3] // 2
    fx, fy, cx, cy = pictures.intrinsics[0].tolist()
    z = float(pictures.depths[0, row, column])
    local = torch.tensor([(column + 0.5 - cx) / fx * z, (row + 0.5 - cy) / fy * z, z])
    world = pictures.world_from_camera[0, :3, :3] @ local + pictures.world_from_camera[0, :3, 3]
    assert float((points - world).norm(dim=1).min()) < 0.1 * z
    closed = region_around(points, (np.zeros(3), 1.0), part=0.5, closed=True)
    inside = (closed.normalise(points).abs() <= torch.tensor(closed.box)).all(1)
    assert closed.shell == 0 and float(inside.float().mean()) > 0.95
    open_ = region_around(points, (np.zeros(3), 1.0), part=0.5, closed=False)
    assert open_.shell > 0
    assert 0.45 < float((open_.normalise(points).abs().amax(1) <= 1.05).float().mean()) < 0.65


def test_resolution_follows_the_voxel_size_within_bounds() -> None:
    space = Space((0.0, 0.0, 0.0), 1.0, 1.0)
    assert lattice_resolution(space, 0.05, 96) == 80
    assert lattice_resolution(space, 1e-4, 96) == 96
    assert lattice_resolution(space, 10.0, 96) == samples.LEAST


def test_depth_range_falls_back_to_the_hint_and_refuses_without() -> None:
    assert depth_range(torch.zeros(2, 8, 8), 3.0, "x") == (1.5, 3.0, 6.0)
    with pytest.raises(InputError, match="depth of the scene"):
        depth_range(torch.zeros(2, 8, 8), None, "x")
    near, middle, far = depth_range(torch.linspace(1, 3, 1000).view(1, 10, 100), None, "x")
    assert (near, middle, far) == pytest.approx((1.02, 2.0, 2.98), abs=0.01)


def test_the_mixture_repeats_itself_for_a_seed_and_differs_between_processes() -> None:
    wanted = tiny_settings()
    first, again, other = Mixture(wanted), Mixture(wanted), Mixture(wanted, rank=1)
    again.sample(5, 1)  # what was asked before does not matter
    a, b, c = (mixture.sample(1, 1) for mixture in (first, again, other))
    assert a.name == b.name and torch.equal(a.pictures.images, b.pictures.images) and a.space == b.space
    assert a.pictures.images.shape != c.pictures.images.shape or not torch.equal(a.pictures.images, c.pictures.images)


def test_scenes_take_turns_and_serve_as_often_as_asked() -> None:
    mixture = Mixture(tiny_settings(window=3, reuse=4))
    numbers = [mixture.scene_number(step) for step in range(24)]
    assert all(numbers.count(n) == 4 for n in range(6)) and numbers[:6] == [0, 1, 2, 0, 1, 2] and numbers[12] == 3


def test_sources_are_drawn_by_their_weights(tmp_path) -> None:  # type: ignore[no-untyped-def]
    layouts.synthetic(tmp_path / "synthetic", scenes=("chair",))
    layouts.scanned_objects(tmp_path / "objects", objects=1)
    sources = [
        {"kind": "synthetic", "path": str(tmp_path / "synthetic"), "weight": 3.0},
        {"kind": "scanned_objects", "path": str(tmp_path / "objects"), "weight": 1.0},
        {"kind": "procedural", "weight": 0.0},
    ]
    mixture = Mixture(tiny_settings(sources=sources, window=1, reuse=1))
    names = [mixture.sample(step, 1).name for step in range(80)]
    assert set(names) == {"chair", "object_0"}
    assert 0.6 < names.count("chair") / 80 < 0.9


def test_a_source_that_never_works_is_an_error_not_a_hang(tmp_path) -> None:  # type: ignore[no-untyped-def]
    layouts.synthetic(tmp_path, scenes=("chair",), views=2)
    with pytest.raises(InputError, match="at least 4 frames"):
        Mixture(tiny_settings(sources=[{"kind": "synthetic", "path": str(tmp_path)}])).sample(0, 1)
