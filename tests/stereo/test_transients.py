"""What moves is found where it is, nothing else is, and the consensus that it is held against equals a slow, obvious one."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldfuse.camera import Array, Intrinsics, project, unproject
from fieldfuse.capture.types import Views
from fieldfuse.errors import InputError, Interrupted
from fieldfuse.stereo import transients
from fieldfuse.stereo.match import StereoDepth, stereo_depths
from fieldfuse.stereo.transients import AGREED, SAME, LeftOut, consensus, load_left_out, save_left_out
from tests.stereo.made import CAMERA, FAR, MEDIAN, NEAR, PASSED, TALL, WIDE, Stopping, corner, with_passer


@lru_cache(maxsize=2)
def matched(passer: bool) -> tuple[Views, list[StereoDepth]]:
    views = with_passer()[0] if passer else corner()[0]
    return views, stereo_depths(views, NEAR, FAR, MEDIAN)


def found_in(views: Views, depths: list[Array | None], measured: bool) -> list[Array]:
    return transients.moving(views, depths, [CAMERA] * len(views), MEDIAN, measured)


def recall(found: list[Array], truth: list[Array]) -> float:
    return float(sum((one & true).sum() for one, true in zip(found, truth, strict=True)) / sum(true.sum() for true in truth))


def false_share(found: list[Array], truth: list[Array]) -> float:
    """Share of all pixels that are found more than three pixels away from what moves."""
    around = [cv2.dilate(true.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0 for true in truth]
    return float(np.mean([one & ~near for one, near in zip(found, around, strict=True)]))


def test_somebody_who_passes_is_found_by_matching() -> None:
    views, depths = matched(True)
    truth = with_passer()[2]
    found = found_in(views, [one.depth for one in depths], False)
    assert recall(found, truth) > 0.9 and false_share(found, truth) < 0.005
    assert [mask.any() for mask in found] == [index in PASSED for index in range(len(views))]


def test_somebody_who_passes_is_found_by_a_sensor() -> None:
    views, depths, truth = with_passer()
    found = found_in(views, depths, True)
    assert recall(found, truth) > 0.95 and false_share(found, truth) < 0.005


def test_where_nothing_moves_nothing_is_found() -> None:
    views, depths = matched(False)
    assert not any(mask.any() for mask in found_in(views, [one.depth for one in depths], False))
    assert not any(mask.any() for mask in found_in(views, corner()[1], True))


def test_a_picture_without_depth_is_looked_at_too() -> None:
    views, depths, truth = with_passer()
    found = found_in(views, [None if index in PASSED else depth for index, depth in enumerate(depths)], False)
    assert recall(found, truth) > 0.9 and false_share(found, truth) < 0.005


def test_a_darker_picture_does_not_move() -> None:
    views, depths = corner()
    darker = [np.round(image * np.float32(0.6 if index == 2 else 1)).astype(np.uint8) for index, image in enumerate(views.images)]
    assert not any(mask.any() for mask in found_in(replace(views, images=darker), depths, True))


def test_what_a_sensor_misses_does_not_move() -> None:
    """Screens, glass and the border of a picture look different from everywhere; matching misses what moves itself."""
    views, depths, truth = with_passer()
    missed = [np.where(mask, np.float32(0), depth) for mask, depth in zip(truth, depths, strict=True)]
    assert not any(mask.any() for mask in found_in(views, missed, True))
    assert recall(found_in(views, missed, False), truth) > 0.9


def test_masked_pixels_are_not_looked_at() -> None:
    views, depths, truth = with_passer()
    masked = replace(views, valid=[None if not mask.any() else ~mask for mask in truth], depths=list(depths))
    small, cameras = transients.depths_at(masked, 160)
    assert all(one is not None and not one[mask].any() for one, mask in zip(small, truth, strict=True))
    assert not any(mask.any() for mask in transients.moving(masked, small, cameras, MEDIAN, True))


def test_looking_can_be_stopped() -> None:
    views, depths, _ = with_passer()
    with pytest.raises(Interrupted):
        transients.moving(views, depths, [CAMERA] * len(views), MEDIAN, True, Stopping())


@given(st.integers(1, 5000), st.floats(1, 3600))
def test_size_follows_from_counts(views: int, budget: float) -> None:
    side, (least, most) = transients.plan(views, budget), transients.SIDES
    if side is None:
        assert views * transients.VIEW_SECONDS * (least / most) ** 2 > transients.MOST_SHARE * budget
        return
    assert least <= side <= most and side % 8 == 0
    assert views * transients.VIEW_SECONDS * (side / most) ** 2 <= transients.MOST_SHARE * budget * (1 + 1e-9)
    longer = transients.plan(views, 2 * budget)
    assert longer is not None and longer >= side


def test_depths_come_from_matching_or_from_the_views() -> None:
    views, depths = corner()
    own, cameras = transients.depths_at(replace(views, depths=[depths[0], *[None] * 6]), 80)
    assert own[1:] == [None] * 6 and own[0] is not None and own[0].shape == (60, 80) and cameras[0] == CAMERA.scaled(80, 60)
    assert np.isin(own[0], depths[0]).all()
    small = StereoDepth(np.full((48, 64), 2, np.float32), np.ones((48, 64), np.float32), CAMERA.scaled(64, 48))
    taken, cameras = transients.depths_at(replace(views, depths=list(depths)), 80, {2: small})
    assert [depth is not None for depth in taken] == [index == 2 for index in range(7)]
    assert taken[2] is not None and taken[2].shape == (48, 64) and {camera.width for camera in cameras} == {64}


def slow_consensus(
    camera: Intrinsics, pose: Array, depths: list[Array], pictures: list[Array], lenses: list[Intrinsics], poses: Array
) -> tuple[Array, Array, Array, Array]:
    """Point by point, then pixel by pixel."""
    height, width = camera.height, camera.width
    told: list[list[dict[int, tuple[float, Array]]]] = [[{} for _ in range(width)] for _ in range(height)]
    for number, (depth, picture, lens) in enumerate(zip(depths, pictures, lenses, strict=True)):
        for y, x in zip(*np.nonzero(depth > 0), strict=True):
            world = unproject(lens, poses[number], np.array([[x + 0.5, y + 0.5]]), np.array([float(depth[y, x])]))
            pixels, along = project(camera, pose, world)
            if along[0] <= 0:
                continue
            (u, v), z = pixels[0] - 0.5, float(along[0])
            for row in (int(np.floor(v)), int(np.floor(v)) + 1):
                for column in (int(np.floor(u)), int(np.floor(u)) + 1):
                    if 0 <= row < height and 0 <= column < width:
                        at = told[row][column]
                        if number not in at or z < at[number][0]:
                            at[number] = (z, picture[y, x].astype(float))
    count, mean, scatter = np.zeros((height, width), int), np.zeros((height, width)), np.zeros((height, width))
    colour = np.zeros((height, width, 3))
    for row in range(height):
        for column in range(width):
            nearest = sorted(told[row][column].values(), key=lambda one: one[0])
            for first in range(len(nearest)):
                group = [one for one in nearest[first:] if one[0] <= nearest[first][0] * (1 + SAME)]
                if len(group) >= AGREED:
                    colours = np.array([one[1] for one in group])
                    count[row, column], mean[row, column] = len(group), np.mean([one[0] for one in group])
                    colour[row, column], scatter[row, column] = colours.mean(axis=0), np.sqrt(colours.var(axis=0).mean())
                    break
    return count, mean, colour, scatter


@pytest.mark.parametrize("seed", range(4))
def test_consensus_equals_a_slow_one(seed: int) -> None:
    random = np.random.default_rng(seed)
    camera, lens = Intrinsics(13, 9, 12.0, 11.0, 6.2, 4.4), Intrinsics(11, 10, 9.0, 9.5, 5.0, 5.3)
    poses = np.tile(np.eye(4), (6, 1, 1))
    for pose in poses:
        pose[:3, :3] = cv2.Rodrigues(random.normal(0, 0.03, 3))[0]
        pose[:3, 3] = random.normal(0, 0.03, 3)
    depths = [np.where(random.random((10, 11)) < 0.3, 1.3, random.uniform(1.96, 2.04)).astype(np.float32) for _ in range(5)]
    for depth in depths:
        depth[random.random((10, 11)) < 0.1] = 0
    pictures = [random.integers(0, 256, (10, 11, 3)).astype(np.uint8) for _ in range(5)]
    found = consensus(camera, poses[5], depths, pictures, [lens] * 5, poses[:5])
    count, mean, colour, scatter = slow_consensus(camera, poses[5], depths, pictures, [lens] * 5, poses[:5])
    assert (count > 0).mean() > 0.2 and (count > AGREED).any()
    assert np.array_equal(found.count, count)
    np.testing.assert_allclose(found.depth, mean, rtol=1e-5)
    np.testing.assert_allclose(found.colour, colour, atol=1e-3)
    np.testing.assert_allclose(found.scatter, scatter, atol=1e-3)


def test_pixels_that_are_left_out_are_not_valid_and_have_no_depth() -> None:
    views, depths, truth = with_passer()
    before = np.ones((CAMERA.height, CAMERA.width), bool)
    before[:, :10] = False
    known = replace(views, depths=list(depths), valid=[None] * 4 + [before] + [None] * 2)
    left_out = LeftOut.of(views.names, truth)
    shown = left_out.without(known)
    assert shown.valid[0] is None and shown.depths[0] is depths[0]
    assert np.array_equal(shown.valid[1], ~truth[1]) and np.array_equal(shown.valid[4], before & ~truth[4])  # type: ignore[arg-type]
    assert np.array_equal(shown.depths[1], np.where(truth[1], 0, depths[1]))  # type: ignore[arg-type]
    assert known.valid[1] is None and known.depths[1] is depths[1]  # the given views stay
    share = pytest.approx(2 * WIDE * TALL / (7 * 160 * 120), abs=1e-5)
    assert left_out.to_dict() == {"looked_at": 7, "pictures": 2, "share": share, "seconds": 0}
    larger = replace(known, images=[np.repeat(np.repeat(image, 2, 0), 2, 1) for image in views.images], valid=[], depths=[])
    assert np.array_equal(left_out.without(larger).valid[1], ~np.repeat(np.repeat(truth[1], 2, 0), 2, 1))  # type: ignore[arg-type]


def test_what_is_left_out_is_kept_in_a_file(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    left_out = LeftOut.of(["a", "é/b", "c"], [random.random((7, 11)) < 0.5, np.zeros((7, 11), bool), random.random((5, 3)) < 0.5], 1.5)
    path = tmp_path / "left_out.safetensors"
    save_left_out(path, left_out)
    back = load_left_out(path)
    assert back.to_dict() == left_out.to_dict() and list(back.masks) == ["a", "c"]
    assert all(np.array_equal(back.masks[name], mask) for name, mask in left_out.masks.items())
    whole = path.read_bytes()
    for content in (b"", whole[:-1], whole[:40], whole.replace(b"[7, 11]", b"[8, 11]"), whole.replace(b"seconds", b"sekunde")):
        assert content != whole
        path.write_bytes(content)
        with pytest.raises(InputError, match="cannot be read"):
            load_left_out(path)
    save_left_out(path, LeftOut.of([], []))
    assert load_left_out(path).to_dict() == {"looked_at": 0, "pictures": 0, "share": 0, "seconds": 0}
