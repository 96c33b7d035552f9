"""Colours looked up again in the pictures: against a slow loop, on fields whose right colours are known, and what must not take part."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from fieldfuse.capture.types import Views
from fieldfuse.errors import Interrupted
from fieldfuse.evaluation.sphere import around, lens, sphere_field
from fieldfuse.progress import Progress
from fieldfuse.render.color_backprojection import BESIDE, COLOURS, MOST, STEEPEST, project_back, recoloured
from fieldfuse.render.composite import SOLID, THRESHOLD
from fieldfuse.render.field import Field
from fieldfuse.render.image import render_view
from fieldfuse.render.rays import render_with_gradients
from fieldfuse.volume.lookup import corners
from tests.render.made import random_field, random_rays

DEPTH = 2.4  # of the cameras around the sphere


def stripes(field: Field) -> torch.Tensor:
    """Rows of features: stripes in the colours, four to ten of the field's voxels wide."""
    rows = field.topology.keys.repeat_interleave(512, 0) * 8
    local = torch.arange(512).repeat(field.blocks)
    corner = rows + torch.stack([local & 7, (local >> 3) & 7, local >> 6], 1)
    features = torch.zeros_like(field.feature_rows)
    features[:-1, :COLOURS] = 2 * torch.sin(corner.float() * torch.tensor([0.5, 0.7, 0.3]))
    return features


def painted() -> Field:
    """A dense sphere with stripes of colour a few voxels wide, and nothing else that a decoder could see."""
    field = sphere_field(48)
    features = stripes(field)
    for parameter in field.decoder.parameters():
        parameter.data.zero_()
    return replace(field, feature_rows=features, density_rows=field.density_rows + 2.5)


def pictures_of(field: Field, count: int = 8, side: int = 64, test: int = 0) -> Views:
    camera, poses = lens(side, side), around(count)
    images = [(render_view(field, camera, pose).rgb * 255).round().astype(np.uint8) for pose in poses]
    return Views([f"{i}" for i in range(count)], images, [camera] * count, poses, np.arange(count) >= count - test)


def decibel(field: Field, views: Views) -> float:
    errors = [
        np.square(render_view(field, camera, pose).rgb - picture / 255).mean()
        for camera, pose, picture in zip(views.intrinsics, views.world_from_camera, views.images, strict=True)
    ]
    return -10 * math.log10(float(np.mean(errors)))


def grey(field: Field) -> Field:
    return replace(field, feature_rows=torch.zeros_like(field.feature_rows))


@pytest.mark.parametrize("decoder", ["deferred", "per_sample"])
def test_a_slow_loop_gives_the_same(decoder: str) -> None:
    field = random_field(resolution=16, decoder=decoder, keep=0.5, raw=0.5)
    origins, directions = random_rays(40)
    colours = torch.rand(40, 3, generator=torch.Generator().manual_seed(1))
    size = len(field.density_rows)
    sums, seen = torch.zeros(size, 4), torch.zeros(len(field.occupied))
    with torch.no_grad():
        shown = render_with_gradients(field, origins, directions, threshold=THRESHOLD)
        project_back(field, origins, directions, colours, sums, seen)
    slow, slow_weight, slow_seen = np.zeros((size, 3)), np.zeros(size), np.zeros(len(seen))
    for ray in range(40):
        own = [sample for sample in range(len(shown.samples)) if int(shown.samples.ray[sample]) == ray]
        for sample in own:
            cell = int(shown.samples.cell[sample])
            slow_seen[cell] = max(slow_seen[cell], float(shown.weight[sample]))
        if sum(float(shown.weight[sample]) for sample in own) > SOLID:
            slow_seen[int(shown.samples.cell[max(own, key=lambda sample: float(shown.weight[sample]))])] = 1
    rows, parts = corners(field.topology, shown.samples.cell, shown.samples.inside)
    for sample in range(len(shown.samples)):
        ray, light = int(shown.samples.ray[sample]), float(shown.weight[sample])
        opacity = float(shown.opacity[ray])
        if light <= THRESHOLD or opacity < SOLID:
            continue
        for channel in range(3):
            own = (float(shown.colour[ray, channel]) - (1 - opacity) * float(field.background[channel])) / opacity
            own = min(max(own, 0.0), 1.0)
            asked = (float(colours[ray, channel]) - own) / max(own * (1 - own), STEEPEST)
            for row, part in zip(rows[sample].tolist(), parts[sample].tolist(), strict=True):
                slow[row, channel] += light * part * min(max(asked, -MOST), MOST)
        for row, part in zip(rows[sample].tolist(), parts[sample].tolist(), strict=True):
            slow_weight[row] += light * part
    assert slow_weight.max() > 0.1
    np.testing.assert_allclose(sums[:, 3], slow_weight, atol=1e-5)
    np.testing.assert_allclose(sums[:, :3], slow, atol=1e-4)
    np.testing.assert_allclose(seen, slow_seen, atol=1e-6)


@pytest.mark.parametrize("resolution", [16, 32])
def test_the_compiled_pass_gives_what_torch_gives(resolution: int) -> None:
    field = random_field(resolution=resolution, keep=0.5, raw=0.5, channels=16)  # compiled for as many as elsewhere
    views = pictures_of(painted(), 6)
    slow, fast = (recoloured(field, views, DEPTH, engine=engine, relaxation=1.5) for engine in ("torch", "numba"))
    assert float((slow.field.feature_rows - field.feature_rows).abs().max()) > 0.5
    difference = (slow.field.feature_rows - fast.field.feature_rows).abs()
    # Rays that end where both may round differently, at half of the light or a thousandth of it, are few.
    assert float(difference.quantile(0.999)) < 2e-3 and float(difference.mean()) < 1e-4
    assert float(((slow.seen - fast.seen).abs() > 1e-3).float().mean()) < 2e-3


def test_any_number_of_threads_gives_the_same_but_for_the_order_of_sums() -> None:
    field, views = grey(painted()), pictures_of(painted(), 6)
    before = torch.get_num_threads()
    found = []
    try:
        for threads in (1, 3, 3):
            torch.set_num_threads(threads)
            found.append(recoloured(field, views, DEPTH))
    finally:
        torch.set_num_threads(before)
    one, three, again = found
    assert torch.equal(three.field.feature_rows, again.field.feature_rows) and torch.equal(one.seen, three.seen)
    assert torch.allclose(one.field.feature_rows, three.field.feature_rows, atol=1e-4)


def test_in_place_is_the_same() -> None:
    field, views = grey(painted()), pictures_of(painted(), 4)
    expected = recoloured(field, views, DEPTH)
    assert not field.feature_rows.any()
    found = recoloured(field, views, DEPTH, in_place=True).field
    assert found.feature_rows is field.feature_rows and torch.equal(found.feature_rows, expected.field.feature_rows)


def test_what_is_seen_is_the_side_of_the_sphere_that_a_picture_shows() -> None:
    field = painted()
    seen = recoloured(field, pictures_of(field).subset([0]), DEPTH).seen
    assert seen.shape == field.occupied.shape and not seen[~field.occupied].any()
    assert 0.02 < float((seen > 0.02)[field.occupied].float().mean()) < 0.6 and float(seen.max()) == 1


def test_from_grey_to_the_colours_of_the_pictures() -> None:
    """Stripes of four to ten voxels; seen between the cameras, too."""
    field = painted()
    views = pictures_of(field, 16)
    between = views.subset([1, 6, 11])
    start, found = grey(field), recoloured(grey(field), views.subset([i for i in range(16) if i not in (1, 6, 11)]), DEPTH).field
    assert decibel(start, between) < 16
    assert decibel(found, between) > decibel(start, between) + 10
    assert torch.equal(found.density_rows, field.density_rows) and found.decoder is field.decoder
    assert not start.feature_rows.any() and not found.feature_rows[-1].any()  # what was given is left, and the zero row is zero


def test_right_colours_stay() -> None:
    field = painted()
    views = pictures_of(field)
    found = recoloured(field, views, 100.0).field  # at the pictures' full size: nothing is averaged
    assert decibel(found, views) > 40
    assert float((found.feature_rows - field.feature_rows).abs().mean()) < 0.01


def test_what_no_picture_shows_keeps_every_bit() -> None:
    field = painted()
    views = pictures_of(field).subset([0])
    found = recoloured(grey(field), views, DEPTH).field
    changed = (found.feature_rows[:-1] != 0).any(1)
    assert 0.05 < float(changed.float().mean()) < 0.6  # one side of the sphere
    centre = torch.from_numpy(views.world_from_camera[0, :3, 3]).float()
    rows = changed.nonzero().view(-1)
    slot, local = rows // 512, rows % 512
    corner = field.topology.keys[slot] * 8 + torch.stack([local & 7, (local >> 3) & 7, local >> 6], 1)
    places = corner.float() * field.voxel_size - 1
    assert float((places @ centre).min()) > -0.2 * float(centre.norm())  # the far half is hidden
    assert not found.feature_rows[:, COLOURS:].any()


def test_held_out_pictures_and_masked_pixels_are_not_looked_at() -> None:
    field = painted()
    views = pictures_of(field, test=2)
    expected = recoloured(grey(field), views, DEPTH).field.feature_rows
    spoilt = replace(views, images=[picture.copy() for picture in views.images])
    spoilt.images[7][:] = 255
    assert torch.equal(recoloured(grey(field), spoilt, DEPTH).field.feature_rows, expected)
    left = np.zeros((64, 64), bool)
    left[:, :32] = True
    half = replace(views, valid=[left] * 8)
    expected = recoloured(grey(field), half, 100.0).field.feature_rows
    spoilt = replace(half, images=[picture.copy() for picture in views.images])
    for picture in spoilt.images:
        picture[:, 32:] = 0
    assert torch.equal(recoloured(grey(field), spoilt, 100.0).field.feature_rows, expected)


def test_rays_are_bounded_by_leaving_pictures_out(monkeypatch: pytest.MonkeyPatch) -> None:
    field = painted()
    views = pictures_of(field)
    monkeypatch.setattr("fieldfuse.render.color_backprojection.MOST_RAYS", 3 * 64 * 64)
    third = recoloured(grey(field), views, 100.0).field.feature_rows
    monkeypatch.undo()
    assert torch.equal(third, recoloured(grey(field), views.subset([0, 3, 6]), 100.0).field.feature_rows)


def with_alpha(field: Field) -> Views:
    """The same pictures with the field's own opacity as alpha, which leaves the corners of each see-through."""
    views = pictures_of(field)
    cameras = zip(views.intrinsics, views.world_from_camera, strict=True)
    opacities = [render_view(field, camera, pose).opacity for camera, pose in cameras]
    return replace(views, alpha=[(opacity > 0.5).astype(np.uint8) * 255 for opacity in opacities])


def test_with_alpha_the_rays_that_count_are_those_that_show_something(monkeypatch: pytest.MonkeyPatch) -> None:
    field = painted()
    views = with_alpha(field)
    shown = sum(int(np.count_nonzero(alpha)) for alpha in views.alpha if alpha is not None)
    assert 0.1 < shown / (8 * 64 * 64) < 0.9
    everything = recoloured(grey(field), views, 100.0).field.feature_rows
    monkeypatch.setattr("fieldfuse.render.color_backprojection.MOST_RAYS", 1)  # that of captures without alpha
    monkeypatch.setattr("fieldfuse.render.color_backprojection.MOST_WITHIN", shown)
    assert torch.equal(recoloured(grey(field), views, 100.0).field.feature_rows, everything)
    monkeypatch.setattr("fieldfuse.render.color_backprojection.MOST_WITHIN", shown - 1)
    half = recoloured(grey(field), views.subset([0, 2, 4, 6]), 100.0).field.feature_rows
    assert torch.equal(recoloured(grey(field), views, 100.0).field.feature_rows, half)


def test_pixels_far_from_what_a_picture_shows_are_not_asked() -> None:
    """And those just beside it are, so that what bulges over a silhouette gets the background's colour."""
    field = painted()
    views = with_alpha(field)
    views = replace(views, alpha=[cv2.erode(alpha, np.ones((17, 17), np.uint8)) for alpha in views.alpha if alpha is not None])
    expected = recoloured(grey(field), views, 100.0).field.feature_rows
    for beside, same in ((BESIDE + 1, True), (1, False)):
        spoilt = replace(views, images=[picture.copy() for picture in views.images])
        for picture, alpha in zip(spoilt.images, views.alpha, strict=True):
            assert alpha is not None
            picture[cv2.dilate(alpha, np.ones((2 * beside - 1, 2 * beside - 1), np.uint8)) == 0] = 255
        assert torch.equal(recoloured(grey(field), spoilt, 100.0).field.feature_rows, expected) == same


def test_it_can_be_stopped() -> None:
    class Stop(Progress):
        def stopping(self) -> bool:
            return True

    with pytest.raises(Interrupted):
        recoloured(painted(), pictures_of(painted(), 2), DEPTH, Stop())


def test_an_empty_field_and_pictures_of_nothing() -> None:
    field = painted()
    empty = replace(field, occupied=torch.zeros_like(field.occupied))
    views = pictures_of(field, 2)
    assert torch.equal(recoloured(empty, views, DEPTH).field.feature_rows, empty.feature_rows)
    nothing = replace(views, valid=[np.zeros((64, 64), bool)] * 2)
    assert torch.equal(recoloured(field, nothing, DEPTH).field.feature_rows, field.feature_rows)
