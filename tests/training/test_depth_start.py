"""The start by known depth: votes and sums against slow references, what stays and what goes, and pictures of a start before any step."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from fieldfuse.camera import Array, Similarity, invert, unproject
from fieldfuse.capture.types import Views
from fieldfuse.config import Settings, load_settings
from fieldfuse.poses.scene import Scene
from fieldfuse.render.field import Field
from fieldfuse.render.image import make_renderer, render_view
from fieldfuse.training.depth_start import (
    KNOWN,
    RESOLUTION,
    RESOLUTION_KNOWN,
    THICK,
    Votes,
    _voters,
    depth_start,
    measured,
    starts_by_depth,
    votes,
)
from fieldfuse.training.levels import all_places
from fieldfuse.training.start import THIN, WHOLE, radii
from fieldfuse.volume.space import Space
from fieldfuse.volume.topology import BLOCK, Topology
from tests.stereo.made import FAR, MEDIAN, NEAR, corner

SCENE = Scene(Similarity.identity(), np.array([0.0, 0.0, 0.0]), np.full(3, 1.5), MEDIAN, NEAR, FAR, 0.0, True, False)
SPACE = Space((0.0, 0.0, 0.0), 3.0, 1.0)


def wanted(*pairs: str) -> Settings:
    return load_settings(pairs=["field.channels=8", "field.hidden=16", "device=cpu", "threads=1", *pairs])


def views() -> Views:
    made, truth = corner()
    return replace(made, test=np.arange(len(made)) == 3, depths=list(truth))


def blind(made: Views, side: slice) -> Views:
    """The same with no depth in these columns."""
    depths: list[Array | None] = []
    for one in made.depths:
        assert one is not None
        seen = one.copy()
        seen[:, side] = 0
        depths.append(seen)
    return replace(made, depths=depths)


def centres(field: Field) -> Array:
    """(N, 3) middles of the occupied voxels, working frame."""
    row = field.occupied.nonzero().squeeze(1)
    local = row % 512
    place = field.topology.keys[row // 512].long() * BLOCK + torch.stack([local & 7, (local >> 3) & 7, local >> 6], 1)
    return radii(field.space, field.resolution, place, 1.0)[0]


def test_votes_are_those_of_a_slow_loop() -> None:
    made = blind(views(), slice(0, 40))
    places = all_places(SPACE, 16)
    found = votes(SPACE, 16, places, made)
    middles, radius = radii(SPACE, 16, places, WHOLE)
    for at in range(0, len(places), 37):
        counted = np.zeros(3, int)
        for index in range(len(made)):
            camera, depth = made.intrinsics[index], made.depths[index]
            assert depth is not None
            x, y, z = invert(made.world_from_camera[index])[:3] @ [*middles[at], 1]
            if z <= 2 * radius[at]:
                continue
            column, row = int(np.floor(x / z * camera.fx + camera.cx)), int(np.floor(y / z * camera.fy + camera.cy))
            if 0 <= column < camera.width and 0 <= row < camera.height:
                there = depth[row, column]
                if there == 0:
                    counted[0] += 1
                elif abs(z - there) <= 2 * radius[at]:
                    counted[2] += 1
                elif z < there:
                    counted[1] += 1
        assert (found.unknown[at], found.past[at], found.here[at]) == tuple(counted)
    assert found.past.max() >= 5 and found.here.max() >= 5 and found.unknown.max() >= 3


numbers = st.integers(0, 60)


@given(numbers, numbers, numbers, st.sampled_from([5, 60]))
def test_what_stays(unknown: int, past: int, here: int, count: int) -> None:
    def stays(*told: int) -> bool:
        return bool(Votes(*(np.array([one], np.int32) for one in told)).stays(count)[0])

    assert not stays(0, past, 0)  # nobody looks there, or everybody sees past it
    assert stays(unknown + 1, 0, here)  # nobody says that it is empty
    assert stays(unknown, past, 2 + past)  # a surface that many measured stays, whoever sees past it
    assert stays(unknown, 1, 1) == stays(unknown, 0, 1)  # one picture may err
    assert not stays(unknown, 2 + unknown // 9, 0)
    if stays(unknown, past + 1, here):
        assert stays(unknown, past, here)


def test_points_and_colours_are_those_of_a_slow_loop() -> None:
    made = views().subset([0, 5])
    flat = [np.full((120, 160, 3), tone, np.uint8) for tone in (50, 200)]
    masks: list[Array | None] = [None, np.arange(160)[None].repeat(120, 0) < 80]
    made = replace(made, images=flat, valid=masks)
    topology = Topology(torch.stack(torch.meshgrid(*[torch.arange(5)] * 3, indexing="ij"), -1).reshape(-1, 3).int())
    count, colour = measured(SPACE, 32, topology, made)
    whole = np.zeros((40, 40, 40, 2))
    for index, tone in enumerate((50, 200)):
        depth, mask = made.depths[index], masks[index]
        assert depth is not None
        row, column = np.nonzero((depth > 0) & (True if mask is None else mask))
        points = unproject(made.intrinsics[index], made.world_from_camera[index], np.stack([column, row], 1) + 0.5, depth[row, column])
        at = (SPACE.contract(SPACE.normalise(torch.from_numpy(points))).numpy() + 2) * 8
        low = np.floor(at).astype(int)
        for corner_of in np.ndindex(2, 2, 2):
            weight = np.prod(np.where(corner_of, at - low, 1 - (at - low)), 1)
            for channel, value in enumerate((1.0, tone / 255)):
                np.add.at(whole[..., channel], tuple((low + corner_of).T), weight * value)
    x, y, z = topology.keys.long().unbind(1)
    local = torch.arange(512)
    places = (x[:, None] * 8 + (local & 7), y[:, None] * 8 + ((local >> 3) & 7), z[:, None] * 8 + (local >> 6))
    expected = torch.from_numpy(whole)[places].reshape(-1, 2)
    assert torch.allclose(count[:-1].double(), expected[:, 0], rtol=1e-3, atol=1e-2)
    assert torch.allclose(colour[:-1].double(), expected[:, 1:].expand(-1, 3), rtol=1e-3, atol=1e-2)
    assert count[-1] == 0 and not colour[-1].any() and count.sum() > 10_000


def test_a_start_shows_the_scene_before_any_step() -> None:
    made, truth = views(), corner()[1]
    field = depth_start(made, SCENE, wanted(), "cpu")
    shown = render_view(field, made.intrinsics[3], made.world_from_camera[3], make_renderer(field))
    known = (truth[3] > 0) & (np.asarray(shown.depth) > 0)
    assert known.mean() > 0.8
    assert np.median(np.abs(np.asarray(shown.depth) - truth[3])[known] / truth[3][known]) < 0.03
    picture = made.images[3] / 255
    plain = np.mean((picture - picture.mean((0, 1))) ** 2)
    assert np.mean((np.asarray(shown.rgb) - picture) ** 2) < 0.7 * plain  # as smooth as its voxels are large
    thick = field.density_rows == THICK
    assert thick.sum() > 1000 and ((field.density_rows == THIN) | thick)[:-1].all()


def test_what_was_seen_past_is_gone_and_what_nobody_knows_stays() -> None:
    made, truth = views(), corner()[1]
    known = depth_start(made, SCENE, wanted("field.resolution=64"), "cpu")
    half = depth_start(blind(made, slice(0, 80)), SCENE, wanted("field.resolution=64"), "cpu")
    assert known.voxels < 0.5 * half.voxels
    eye, camera = made.world_from_camera[0], made.intrinsics[0]
    for field, column, empty in ((known, 40, True), (known, 120, True), (half, 40, False), (half, 120, True)):
        away = np.linspace(1.2, 0.8 * truth[0][60, column], 20)  # before the surface
        points = unproject(camera, eye, np.tile([column + 0.5, 60.5], (20, 1)), away)
        near = np.abs(centres(field)[:, None] - points[None]).max(2).min(0) < field.voxel_size / 2
        assert near.mean() < 0.1 if empty else near.mean() > 0.6, (column, near.mean())


def test_the_lattice_is_finer_where_nearly_everything_is_known() -> None:
    made = views()
    full = replace(made, depths=[np.full_like(one, 3.0) for one in made.depths if one is not None])
    assert depth_start(full, SCENE, wanted("field.resolution=256"), "cpu").resolution == RESOLUTION_KNOWN
    assert depth_start(full, SCENE, wanted("field.resolution=64"), "cpu").resolution == 64
    assert depth_start(full, SCENE, wanted("field.resolution=48"), "cpu").resolution == 32
    assert depth_start(full, SCENE, wanted("field.resolution=40"), "cpu").resolution == 32  # the only level of such a fit is 40
    assert depth_start(full, SCENE, wanted("field.resolution=160"), "cpu").resolution == 64  # 160 is the level after 64
    missing = int(160 * (1 - KNOWN)) + 2
    assert depth_start(blind(full, slice(0, missing)), SCENE, wanted("field.resolution=256"), "cpu").resolution == RESOLUTION


def test_depth_that_leaves_nothing_is_not_believed() -> None:
    made = views()
    far = replace(made, depths=[np.full((120, 160), 1e6, np.float32)] * 7)
    odd = [np.full((120, 160), value, np.float32) for value in (np.nan, np.inf, -1.0, 1e-30, 1e30, 0.0, 3e38)]
    for some in (far, replace(made, depths=odd)):
        field = depth_start(some, SCENE, wanted("field.background=off", "field.resolution=64"), "cpu")
        assert field.voxels > 1000 and torch.isfinite(field.density_rows).all() and torch.isfinite(field.feature_rows).all()


def test_pictures_with_depth_are_voters_wherever_they_are() -> None:
    made = views().subset(np.arange(200) % 7)
    depths = [one if index % 2 else None for index, one in enumerate(made.depths)]
    asked = _voters(replace(made, depths=depths))
    assert len(asked) == len(set(asked)) == 100 and sum(index % 2 for index in asked) == 50
    few = [one if index == 77 else None for index, one in enumerate(made.depths)]
    assert 77 in _voters(replace(made, depths=few))


def test_held_out_pictures_are_not_looked_at() -> None:
    made = views()
    other = replace(made, images=list(made.images), depths=list(made.depths))
    other.images[3] = 255 - other.images[3]
    other.depths[3] = np.full((120, 160), 1.1, np.float32)
    one, two = (depth_start(each, SCENE, wanted(), "cpu") for each in (made, other))
    assert torch.equal(one.occupied, two.occupied) and torch.equal(one.density_rows, two.density_rows)
    assert torch.equal(one.feature_rows, two.feature_rows)
    assert all(torch.equal(a, b) for a, b in zip(one.decoder.state_dict().values(), two.decoder.state_dict().values(), strict=True))


@pytest.mark.parametrize(
    ("change", "begins"),
    [
        ({}, True),
        ({"depths": []}, False),
        ({"depths": [None] * 7}, False),
        ({"background": (1.0, 1.0, 1.0)}, False),  # alpha cuts it out: silhouettes tell
    ],
)
def test_when_a_fit_begins_so(change: dict[str, object], begins: bool) -> None:
    made = replace(views(), **change)  # type: ignore[arg-type]
    assert starts_by_depth(made, wanted()) == begins
    assert not starts_by_depth(made, wanted("fit.depth=0"))
    assert not starts_by_depth(replace(made, matched=True), wanted())  # by matching of so few pictures
    many = replace(made.subset(np.arange(4 * len(made)) % len(made)), matched=True)
    assert starts_by_depth(many, wanted()) == begins
    only = [depth if test else None for depth, test in zip(views().depths, views().test, strict=True)]
    assert not starts_by_depth(replace(views(), depths=only), wanted())
