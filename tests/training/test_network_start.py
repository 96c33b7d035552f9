"""The networks' field as the start of a fit, and direct inference as it is streamed."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch

from fieldfuse.camera import Intrinsics, Similarity, pixel_grid, rays
from fieldfuse.capture.types import Views
from fieldfuse.config import NetworkSettings, Settings, load_settings
from fieldfuse.errors import InputError
from fieldfuse.evaluation.sphere import around, lens
from fieldfuse.nerfusion.decoder import Deferred
from fieldfuse.nerfusion.keyframes import KeyFrames
from fieldfuse.poses.scene import Scene
from fieldfuse.render.field import Field
from fieldfuse.render.image import render_view
from fieldfuse.training.fit import Begin, fit_field
from fieldfuse.training.from_network import (
    MEASURED_PIXELS,
    OBJECT_PIXELS,
    PIXELS,
    Inference,
    lattice_of,
    voxels_to_median,
)
from fieldfuse.training.network_start import THICK, THIN, network_start, widened
from fieldfuse.training.silhouettes import inside_silhouettes, visual_hull
from fieldfuse.training.start import space_of
from fieldfuse.volume.lookup import corners, gather
from fieldfuse.volume.space import Space
from tests.nerfusion.made import INTRINSICS, small_model, wall_pictures

DEPTH = 2.0


def wall_views(count: int = 4) -> Views:
    images, world = wall_pictures(count, DEPTH)
    pixels = [(image.permute(1, 2, 0).numpy() * 255).round().astype(np.uint8) for image in images]
    return Views([str(i) for i in range(count)], pixels, [INTRINSICS] * count, world, np.arange(count) == 1)


def scene() -> Scene:
    return Scene(Similarity.identity(), np.zeros(3), np.full(3, 0.8), DEPTH, 1.0, 3.0, 0.0, False, False)


def settings(*pairs: str) -> Settings:
    return load_settings(pairs=["field.channels=8", "field.hidden=16", "field.resolution=64", "device=cpu", "budget=1", *pairs])


def inference(network: NetworkSettings | None = None) -> Inference:
    model = small_model()
    with torch.no_grad():
        model.to_field.density.weight.mul_(6)  # opinions that differ from place to place, as a trained network's do
    keys = KeyFrames(np.array([0, 2]), np.array([[1], [1]]))
    return Inference(model.eval(), wall_views(), scene(), keys, settings=network or NetworkSettings(voxels=16.0))


def made() -> Field:
    running = inference()
    assert list(running.frames()) == [0, 2] and running.done == 2
    return running.field()


@pytest.mark.parametrize("hidden", [8, 11, 64])
def test_a_wider_decoder_is_the_same_function(hidden: int) -> None:
    torch.manual_seed(3)
    decoder = Deferred(8, 8)
    with torch.no_grad():
        decoder.layers[2].weight.normal_()
        decoder.layers[2].bias.normal_()
    wide = widened(decoder, hidden, torch.Generator().manual_seed(0))
    features, directions = torch.randn(50, 8), torch.nn.functional.normalize(torch.randn(50, 3), dim=1)
    torch.testing.assert_close(wide(features, directions), decoder(features, directions))
    assert wide.hidden == hidden
    # The new units are alive: some input moves them, so that a gradient can come to what reads them.
    if hidden > 8:
        assert bool((wide.layers[0].weight[8:] != 0).all())
    with pytest.raises(ValueError, match="narrowed"):
        widened(decoder, 4, torch.Generator())


def test_the_start_holds_what_the_networks_say_and_is_thin_where_they_say_nothing() -> None:
    field, views = made(), wall_views()
    start = network_start(field, views, scene(), settings())
    assert start.resolution == 32 and start.space == field.space == space_of(views, scene())
    assert isinstance(start.decoder, Deferred) and start.decoder.hidden == 16
    assert float(start.density_rows[:-1].min()) >= THIN and float(start.density_rows.max()) <= THICK
    assert not start.density_rows[-1] and not start.feature_rows[-1].any()
    rows = start.occupied.nonzero().squeeze(1)
    places = start.topology.keys[rows // 512].long() * 8 + torch.stack([rows % 8, rows // 8 % 8, rows // 64 % 8], 1)
    theirs = places.double() * field.resolution / start.resolution
    cell = theirs.floor().long()
    slot = field.topology.find(cell >> 3)
    local = cell & 7
    there = slot.clamp_min(0) * 512 + (local[:, 2] * 8 + local[:, 1]) * 8 + local[:, 0]
    inside = (slot >= 0) & field.occupied[there]
    assert 100 < int(inside.sum()) < len(inside)
    at, weights = corners(field.topology, there[inside], (theirs - cell)[inside].float())
    expected = gather(field.density_rows, at, weights).clamp(THIN, THICK)
    torch.testing.assert_close(start.density_rows[rows[inside]], expected, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(start.feature_rows[rows[inside]], gather(field.feature_rows, at, weights), atol=1e-4, rtol=1e-4)


def test_what_the_decoder_cannot_take_over_stays_behind() -> None:
    field, views = made(), wall_views()
    for pairs in (["decoder=per_sample"], ["field.channels=4"], ["field.hidden=4"]):
        start = network_start(field, views, scene(), settings(*pairs))
        assert start.feature_rows.abs().max() < 0.5, pairs  # the classical noise
        assert bool((start.density_rows > THIN + 0.01).any())
    assert network_start(field, views, scene(), settings("field.resolution=32")).resolution == 32


def test_a_fit_climbs_from_it() -> None:
    """With a clock that goes on at each look, so that the steps are the same however busy the machine is."""
    views, chosen = wall_views(), settings("field.resolution=96")
    start = network_start(made(), views, scene(), chosen)
    clock = itertools.count(0, 0.001)
    result = fit_field(views, scene(), chosen, begin=Begin(start=start, coarse=True), ticks=lambda: next(clock))
    assert result.field.resolution == 96 and result.steps > 500
    train = views.subset(np.flatnonzero(~views.test))
    before, after = (np.mean([error(field, train, i) for i in range(3)]) for field in (start, result.field))
    assert after < 0.2 * before


def error(field: Field, views: Views, index: int) -> float:
    """Mean squared colour error at a view."""
    shown = render_view(field, views.intrinsics[index], views.world_from_camera[index]).rgb
    return float(np.mean((shown - views.images[index] / 255) ** 2))


def test_held_out_views_are_never_looked_at() -> None:
    running = inference()
    assert running.train.names == ["0", "2", "3"]
    views = wall_views()
    views.images[1] = np.zeros_like(views.images[1])
    spoilt = Inference(running.model, views, scene(), running.keys, settings=running.settings)
    list(running.frames())
    list(spoilt.frames())
    assert torch.equal(running.field().density_rows, spoilt.field().density_rows)


def test_the_field_can_be_had_after_every_key_frame_and_grows() -> None:
    running = inference(NetworkSettings(voxels=16.0, gamma=1.0))
    with pytest.raises(InputError, match="no key frame"):
        running.field()
    voxels = [running.field().voxels for _ in running.frames()]
    assert len(voxels) == 2 and 0 < voxels[0] <= voxels[1]
    assert running.seconds > running.encode_seconds > 0


def test_a_voxel_spans_no_more_than_some_pixels_at_the_median_depth() -> None:
    """48 voxels to the median depth for wide angles and small pictures, more for long lenses and large ones."""
    views, about = wall_views(), scene()
    assert voxels_to_median(views) == 48
    long = replace(views, intrinsics=[Intrinsics(64, 64, 600.0, 600.0, 32.0, 32.0)] * len(views))
    assert voxels_to_median(long) == pytest.approx(600 / PIXELS)
    wide, fine = (lattice_of(space_of(views, about), about, voxels_to_median(v), 2) for v in (views, long))
    assert DEPTH / fine.voxel_size / 600 == pytest.approx(1 / PIXELS, rel=0.1) and fine.resolution > 2 * wide.resolution
    assert lattice_of(space_of(views, about), about, 1e5, 2).resolution == 384
    deep = replace(long, depths=[None, *[np.ones((1, 1), np.float32)] * (len(long) - 1)])
    assert [voxels_to_median(v, known) for v in (long, deep) for known in (False, True)] == pytest.approx(
        [600 / PIXELS] * 3 + [600 / MEASURED_PIXELS]
    )
    cut_out = replace(long, alpha=[np.full((64, 64), 255, np.uint8)] * len(long))
    assert voxels_to_median(cut_out) == pytest.approx(600 / OBJECT_PIXELS)


def test_what_lies_outside_of_the_silhouettes_is_left_out() -> None:
    """Alpha says that the left half of every picture shows nothing: what is left of the field shows in the right halves alone."""
    views = wall_views()
    height, width = views.images[0].shape[:2]
    alpha = np.full((height, width), 255, np.uint8)
    alpha[:, : width // 2] = 0
    cut = replace(views, alpha=[alpha] * len(views), background=(1.0, 1.0, 1.0))
    made = []
    for some in (views, cut):
        keys = KeyFrames(np.array([0, 2]), np.array([[1], [1]]))
        running = Inference(inference().model, some, scene(), keys, "off", NetworkSettings(voxels=32.0))
        list(running.frames())
        made.append(running.field())
    whole, carved = made
    assert 0 < carved.voxels < whole.voxels
    views = cut
    for index in (0, 2, 3):
        full, rest = (
            np.asarray(render_view(one, views.intrinsics[index], views.world_from_camera[index]).opacity) for one in (whole, carved)
        )
        left = width // 2 - 4  # voxels reach over the edge by some pixels, and over the picture's border, where nothing is judged
        assert float(rest[2:-2, :left].mean()) < 0.01 and float(rest.max()) > 0.99
        assert index == 0 or float(full[:, :left].mean()) > 0.8
    assert inside_silhouettes(running.field(finished=False), views).voxels == carved.voxels
    assert inside_silhouettes(carved, views).voxels == carved.voxels and inside_silhouettes(whole, views).voxels < 0.8 * whole.voxels


def test_the_hull_holds_what_silhouettes_show_and_little_else() -> None:
    """A ball seen from eight sides."""
    poses, camera = around(8), lens(64, 64)
    space, radius = Space((0.0, 0.0, 0.0), 1.0, 0.0), 0.5
    alpha = []
    for pose in poses:
        origins, directions, _ = rays(camera, pose, pixel_grid(64, 64))
        closest = (origins - (origins * directions).sum(1, keepdim=True) * directions).norm(dim=1)
        alpha.append(np.where(closest.numpy().reshape(64, 64) < radius, 255, 0).astype(np.uint8))
    blank = [np.zeros((64, 64, 3), np.uint8)] * 8
    views = Views([str(i) for i in range(8)], blank, [camera] * 8, poses, np.zeros(8, bool), alpha=alpha, background=(0.0, 0.0, 0.0))
    hull = visual_hull(space, views)
    assert hull is not None
    directions = torch.nn.functional.normalize(torch.randn(2000, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    assert not hull(0.97 * radius * directions).any()
    assert float(hull(1.6 * radius * directions).float().mean()) > 0.95  # eight silhouettes leave corners
    assert hull(torch.tensor([[5.0, 0.0, 0.0], [0.0, -9.0, 0.0]])).all()
    for within in (space, Space((0.1, 0.0, -0.1), 0.3, 1.5)):  # compiled and as tensors; the second is contracted about the ball
        found, points = visual_hull(within, views), 0.7 * torch.randn(4000, 3, generator=torch.Generator().manual_seed(1))
        points[:3] = torch.tensor([[torch.nan, 0.0, 0.0], [torch.inf, 0.0, 0.0], [1e30, -1e30, 0.0]])
        assert found is not None and 0 < float(found(points).float().mean()) < 1 and found(points)[:3].all()
        differ = found(points)[3:] != found(points.double())[3:]
        assert float(differ.float().mean()) < 1e-3  # on the edges of voxels
    assert visual_hull(space, replace(views, alpha=[None] * 8)) is None
    assert visual_hull(space, replace(views, alpha=[np.zeros((64, 64), np.uint8)] * 8)) is None  # it would leave nothing
