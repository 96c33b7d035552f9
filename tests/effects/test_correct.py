"""Corrections: what is off changes no bit, what is on undoes the simulator's own forward model, and all of it survives its file."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from fieldfuse.camera import FISHEYE, OPENCV, Intrinsics, distort
from fieldfuse.capture.types import Capture, Frame, Views
from fieldfuse.effects.correct import Corrections, bent, correctable
from fieldfuse.effects.decide import CLIPS, DIMMEST, room_for_light
from fieldfuse.effects.models import decode_srgb, encode_srgb, to_bytes
from fieldfuse.effects.tracks import Tracks
from fieldfuse.errors import InputError
from fieldfuse.evaluation.score import score_views
from fieldfuse.render.image import Rendered
from fieldfuse.tone import Tone, share, square_radius
from fieldfuse.training.pixels import PixelPool

CAMERA = Intrinsics(64, 48, 50.0, 50.0, 32.0, 24.0)


def picture(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(20, 190, (48, 64, 3), dtype=np.uint8)


def views() -> Views:
    images = [picture(index) for index in range(3)]
    return Views(["a", "b", "c"], images, [CAMERA] * 3, np.tile(np.eye(4), (3, 1, 1)), np.array([True, False, False]), background=None)


def test_nothing_to_correct_gives_the_very_same_objects() -> None:
    before = views()
    capture = Capture("transforms", root=Path(), frames=())
    assert Corrections().on_views(before) is before
    assert Corrections().on_capture(capture) is capture
    assert Corrections().tone("a") is None


def test_gain_and_vignetting_are_undone() -> None:
    linear = decode_srgb(torch.from_numpy(picture().astype(np.float32) / 255))
    gain = (1.3, 1.1, 0.8)
    dimmed = linear * torch.from_numpy(share(0.5, square_radius(CAMERA)))[..., None] * torch.tensor(gain)
    stored = to_bytes(encode_srgb(dimmed)).numpy()
    back, lost = Tone(gain, 0.5).undone(stored, CAMERA)
    assert lost is not None
    assert np.abs(back.astype(int) - picture())[~lost].max() <= 3  # 8 bits twice, brightened by 2 in the corner
    even, _ = Tone(gain).undone(to_bytes(encode_srgb(linear * torch.tensor(gain))).numpy(), CAMERA)
    assert np.abs(even.astype(int) - picture()).max() <= 2


def test_clipped_pixels_that_become_darker_are_not_valid() -> None:
    before = views()
    before.images[1][:] = 255
    after = Corrections(gain={"b": (2.0, 2.0, 2.0), "c": (0.5, 0.5, 0.5)}).on_views(before)
    assert after.valid[1] is not None and not after.valid[1].any()
    assert after.valid[0] is None and after.valid[2] is None
    assert after.images[0] is before.images[0]


def test_held_out_views_keep_their_photo_and_all_of_its_pixels() -> None:
    before = views()
    before.images[0][:10] = 255
    after = Corrections(gain={"a": (2.0, 2.0, 2.0), "c": (0.5, 0.5, 0.5)}).on_views(before)
    assert after.photo(0) is before.images[0] and after.valid[0] is None
    assert after.images[0] is not before.images[0] and after.photos[1] is None and after.photos[2] is None
    shown = after.as_taken(0, after.images[0] / 255)
    assert np.abs(shown * 255 - before.images[0]).max() < 3
    assert after.photo(2) is after.images[2] and after.as_taken(2, shown) is shown  # a training view is what is fitted
    part = after.subset([2, 0])
    assert part.photo(1) is before.images[0] and np.array_equal(part.as_taken(1, after.images[0] / 255), shown)


def test_a_perfect_field_is_scored_as_perfect_whatever_was_corrected() -> None:
    """A picture exposed and darkened more than others is told from its canonical colours as they were taken, not brightened ones."""
    scene, gain = picture(5), (0.5, 0.45, 0.55)
    linear = decode_srgb(torch.from_numpy(scene.astype(np.float32) / 255))
    dimmed = linear * torch.from_numpy(share(0.4, square_radius(CAMERA)))[..., None] * torch.tensor(gain)
    before = views()
    before.images[0] = to_bytes(encode_srgb(dimmed)).numpy()
    after = Corrections(gain={"a": gain}, corner=0.4, dimmed=1.3).on_views(before)
    field = encode_srgb(linear / 1.3).numpy()  # what a fit to such pictures would show
    shown = Rendered(field, np.zeros((48, 64), np.float32), np.ones((48, 64), np.float32))
    assert score_views([shown], after, [0])["psnr"] > 55
    assert score_views([shown], before, [0])["psnr"] < 25


def seen(images: list[np.ndarray]) -> Tracks:
    nothing = np.zeros((0, 3))
    greys = tuple(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in images)
    return Tracks(
        names=list("abc"),
        cameras=[CAMERA] * 3,
        poses=np.tile(np.eye(4), (3, 1, 1)),
        times=np.arange(3.0),
        scale=np.ones(3),
        frame=np.zeros(0, int),
        point=np.zeros(0, int),
        pixel=nothing[:, :2],
        linear=nothing,
        slope=nothing[:, 0],
        images=greys,
    )


def test_there_is_room_for_what_becomes_brighter() -> None:
    """Hardly a pixel is clipped that was not, no more is made dark than that takes, and nothing at all where nothing becomes too bright."""
    grey = [np.repeat(np.random.default_rng(index).integers(20, 190, (48, 64, 1), dtype=np.uint8), 3, axis=2) for index in range(3)]
    gain = {"a": (0.5, 0.5, 0.5), "b": (1.3, 1.3, 1.3), "c": (1.2, 1.2, 1.2)}
    dimmed = room_for_light(seen(grey), 0.5, gain)
    assert 1.2 < dimmed < DIMMEST
    views = Views(list("abc"), grey, [CAMERA] * 3, np.tile(np.eye(4), (3, 1, 1)), np.zeros(3, bool))
    crowded, roomy = (np.mean([image == 255 for image in Corrections(gain, 0.5, by).on_views(views).images]) for by in (1.0, dimmed))
    assert roomy < 2 * CLIPS < 0.5 * crowded
    assert room_for_light(seen(grey), 0.5, {"a": (0.2, 0.2, 0.2)}) == DIMMEST
    dark = [image // 3 for image in grey]
    assert room_for_light(seen(dark), 0.5, gain) == 1 == room_for_light(seen(grey), None, {}) == room_for_light(None, 0.5, gain)


def test_weights_are_of_training_views_and_change_no_pixel() -> None:
    before = views()
    before.valid = [None, None, np.arange(64)[None].repeat(48, 0) < 32]
    after = Corrections(weight={"a": 0.3, "b": 0.3, "c": 0.5}).on_views(before)
    assert after.weight == [1.0, 0.3, 0.5] and after.subset([2, 0]).weight == [0.5, 1.0]
    assert all(one is other for one, other in zip(after.valid, before.valid, strict=True))
    assert all(one is other for one, other in zip(after.images, before.images, strict=True))
    assert Corrections(gain={"b": (2.0, 2.0, 2.0)}).on_views(before).weight == []


def test_weights_are_shares_of_the_valid_pixels_that_rays_are_drawn_from() -> None:
    whole = views()
    whole.valid = [None, None, np.arange(64)[None].repeat(48, 0) < 32]
    pool = PixelPool(Corrections(weight={"b": 0.3, "c": 0.5}).on_views(whole))
    drawn = np.diff(pool.starts.numpy())
    assert drawn[0] == 48 * 64
    assert abs(drawn[1] / (48 * 64) - 0.3) < 0.03 and abs(drawn[2] / (48 * 32) - 0.5) < 0.05
    assert bool((pool.places[pool.starts[2] :] % 64 < 32).all())
    alone = PixelPool(Corrections(weight={"b": 0.3}).on_views(views()).subset([1]))
    torch.testing.assert_close(alone.places, pool.places[pool.starts[1] : pool.starts[2]])


def test_a_lens_is_added_to_what_is_given() -> None:
    pinhole = bent(CAMERA, (-0.1, 0.02))
    assert pinhole.lens == OPENCV and pinhole.distortion == (-0.1, 0.02, 0.0, 0.0)
    given = Intrinsics(64, 48, 50.0, 50.0, 32.0, 24.0, OPENCV, (0.05, -0.01, 0.001, -0.002))
    both = bent(given, (-0.1, 0.02))
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (200, 2))
    r2 = (points**2).sum(1, keepdims=True)
    np.testing.assert_allclose(distort(both, points), distort(given, points * (1 - 0.1 * r2 + 0.02 * r2**2)), atol=2e-4)
    assert correctable(CAMERA) and correctable(given)
    assert not correctable(Intrinsics(64, 48, 50.0, 50.0, 32.0, 24.0, FISHEYE, (0.1, 0.0, 0.0, 0.0)))


def test_poses_and_lens_go_into_the_capture() -> None:
    frame = Frame("a", image=Path("a.png"), intrinsics=CAMERA, world_from_camera=np.eye(4))
    capture = Capture("transforms", root=Path(), frames=(frame,))
    moved = np.eye(4)
    moved[0, 3] = 2.0
    after = Corrections(lens=(-0.1, 0.0), poses={"a": moved}).on_capture(capture).frames[0]
    assert after.world_from_camera is not None and after.world_from_camera[0, 3] == 2.0
    assert after.intrinsics is not None and after.intrinsics.distortion[0] == -0.1


def test_corrections_survive_their_file_and_damaged_ones_are_refused() -> None:
    whole = Corrections({"a": (1.0, 1.1, 0.9)}, 0.6, 1.25, (-0.1, 0.02), {"a": np.eye(4)}, {"b": 0.25})
    again = Corrections.from_dict(whole.to_dict())
    assert again.to_dict() == whole.to_dict() and again.gain == whole.gain
    for damage in (
        {"gain": {"a": [0.0, 1, 1]}},
        {"gain": {"a": [1, 1]}},
        {"corner": "x"},
        {"corner": -1},
        {"dimmed": 0},
        {"dimmed": float("nan")},
        {"poses": {"a": [1]}},
        {"lens": [1]},
        {"weight": 3},
        {"weight": {"a": 1.5}},
        {"weight": {"a": "x"}},
    ):
        with pytest.raises(InputError, match=r"effects\.json"):
            Corrections.from_dict({**whole.to_dict(), **damage})
    older = {key: value for key, value in whole.to_dict().items() if key not in ("weight", "dimmed")}
    assert Corrections.from_dict({**older, "weight": {}}).dimmed == 1
    assert Corrections.from_dict({**older, "left_out": ["b"]}).weight == {"b": 0.0}
    for damage in ({}, {"left_out": 3}):
        with pytest.raises(InputError, match=r"effects\.json"):
            Corrections.from_dict({**older, **damage})
