"""Filming: each listed effect does in the picture what its formula says, and what is not listed changes no bit and is never called."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import cache
from types import FunctionType
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from fieldfuse.camera import Intrinsics, project, unproject
from fieldfuse.effects.effect_specs import PRESETS, parse, preset
from fieldfuse.effects.models import MotionBlur, RollingShutter, decode_srgb, encode_srgb, to_bytes
from fieldfuse.simulate.eye import eye_of, take
from fieldfuse.simulate.film import Film, FilmCamera, Shot
from fieldfuse.simulate.materials import TextureBank
from fieldfuse.simulate.paths import PathSettings, plan
from fieldfuse.simulate.procedural import random_scene
from fieldfuse.simulate.scene import Scene
from fieldfuse.tone import share, square_radius

CAMERA = Intrinsics(80, 60, 60.0, 60.0, 40.0, 30.0)
PATH = PathSettings("walk", frames=6, fps=5.0, speed=0.6, shake=6.0)


def filmed(bank: TextureBank, *listing: Any, kind: str = "room", depth: bool = False, seed: int = 4) -> Film:
    scene = random_scene(kind, np.random.default_rng(seed), bank)
    motion = plan(scene, PATH, np.random.default_rng(seed))
    return Film(scene, FilmCamera(CAMERA, depth=depth), motion, PATH.times(), parse(list(listing), "test"), seed)


def digest(shot: Shot) -> str:
    parts = [shot.rgb, shot.depth, shot.normals, shot.world_from_camera] + [shot.sensor_depth] * (shot.sensor_depth is not None)
    return hashlib.sha256(b"".join(np.ascontiguousarray(part).tobytes() for part in parts)).hexdigest()


class Count(TorchDispatchMode):
    """Counts the tensor operations that run inside it."""

    def __init__(self) -> None:
        super().__init__()
        self.operations = 0

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.operations += 1
        return function(*args, **(kwargs or {}))


def counted(film: Film) -> tuple[int, str]:
    with Count() as count:
        shot = film.shot(2)
    return count.operations, digest(shot)


def forbid(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """Make every method of an effect fail."""
    kind = type(preset(name, "medium"))
    for attribute, value in list(vars(kind).items()):
        if not attribute.startswith("__") and isinstance(value, FunctionType | staticmethod | classmethod):

            def called(*_: Any, who: str = f"{name}.{attribute}", **__: Any) -> Any:
                raise AssertionError(f"{who} was called, but is not listed")

            monkeypatch.setattr(kind, attribute, called)


def test_what_is_not_listed_is_never_called_and_changes_no_bit(bank: TextureBank, monkeypatch: pytest.MonkeyPatch) -> None:
    expected = counted(filmed(bank, depth=True))
    for name in PRESETS:
        forbid(monkeypatch, name)
    assert counted(filmed(bank, depth=True)) == expected


@pytest.fixture(scope="module")
def clean_of(bank: TextureBank) -> Callable[[str], tuple[int, str]]:
    """Operations and shot of a kind of scene without any effect, filmed once each."""
    return cache(lambda kind: counted(filmed(bank, kind=kind, depth=True)))


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_each_effect_alone_calls_no_other(
    bank: TextureBank, clean_of: Callable[[str], tuple[int, str]], name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    kind = {"background": "street", "highlights": "sphere"}.get(name, "room")
    clean = clean_of(kind)
    for other in PRESETS:
        if other != name:
            forbid(monkeypatch, other)
    operations, got = counted(filmed(bank, name, kind=kind, depth=True))
    assert got != clean[1]
    assert operations >= clean[0] or name in ("compression",)


def test_one_effects_draws_do_not_depend_on_others(bank: TextureBank) -> None:
    alone, both = filmed(bank, "exposure").shot(3), filmed(bank, "exposure", "sensor_noise").shot(3)
    assert alone.facts["exposure"] == both.facts["exposure"]
    assert not np.array_equal(alone.rgb, both.rgb)


def test_frames_do_not_depend_on_order(bank: TextureBank) -> None:
    film = filmed(bank, "exposure", "sensor_noise", "rolling_shutter", "depth_noise", "compression", depth=True)
    forwards = [digest(film.shot(i)) for i in range(4)]
    again = filmed(bank, "exposure", "sensor_noise", "rolling_shutter", "depth_noise", "compression", depth=True)
    assert [digest(again.shot(i)) for i in reversed(range(4))][::-1] == forwards
    assert len(set(forwards)) == 4


def linear_of(film: Film, index: int) -> torch.Tensor:
    return take(film.scene, film.eye, film.world_from_camera[index][None]).linear


def test_light_goes_through_vignetting_and_exposure(bank: TextureBank) -> None:
    film = filmed(bank, "vignetting:strong", "exposure:strong")
    shot, clean = film.shot(1), linear_of(film, 1)
    gain = torch.tensor(shot.facts["exposure"]["gain"], dtype=torch.float32)
    dimmed = clean * torch.from_numpy(share(preset("vignetting", "strong").corner, square_radius(CAMERA)).astype(np.float32))[..., None]
    expected = to_bytes(encode_srgb(dimmed * gain)).numpy()
    assert np.array_equal(shot.rgb, expected)
    assert np.array_equal(shot.depth, filmed(bank).shot(1).depth)  # geometry is untouched


def test_noise_of_the_picture_is_the_formulas(bank: TextureBank) -> None:
    film, effect = filmed(bank, "sensor_noise:strong"), preset("sensor_noise", "strong")
    residual, spread = [], []
    for index in range(4):
        clean = linear_of(film, index).numpy().clip(0, 1)
        noisy = decode_srgb(torch.from_numpy(film.shot(index).rgb.astype(np.float32) / 255)).numpy()
        inner = (clean > 0.15) & (clean < 0.7)
        residual.append((noisy - clean)[inner])
        spread.append(np.sqrt(clean[inner] / effect.well + (effect.read / effect.well) ** 2))
    score = np.concatenate(residual) / np.concatenate(spread)
    assert abs(score.mean()) < 0.05 and score.std() == pytest.approx(1, abs=0.05)


def test_rows_are_seen_from_where_the_camera_was(bank: TextureBank) -> None:
    """Row by row, the picture is that of a camera that stands still at the row's own time."""
    film = filmed(bank, {"rolling_shutter": {"readout": 0.2}})
    shot = film.shot(2)
    rows = RollingShutter(0.2).rows(shot.seconds, 60)
    assert shot.facts["rolling_shutter"]["first_row_seconds"] == pytest.approx(rows[0])
    for row in (0, 17, 59):
        still = to_bytes(encode_srgb(take(film.scene, film.eye, film.motion.poses(rows[row : row + 1])).linear)).numpy()
        same = np.abs(still[row].astype(int) - shot.rgb[row]).max(axis=1)
        assert (same <= 1).mean() > 0.8  # edge pixels are found by neighbours, which differ
        assert np.median(same) == 0
    middle = filmed(bank).shot(2)
    assert np.array_equal(shot.depth, middle.depth)  # the truth is that of the frame's own pose
    assert np.abs(middle.rgb[0].astype(int) - shot.rgb[0]).mean() > 2


def test_blur_is_the_mean_of_instants_in_linear_light(bank: TextureBank) -> None:
    film = filmed(bank, {"motion_blur": {"exposure": 0.1, "samples": 5}})
    shot = film.shot(2)
    times = shot.seconds + MotionBlur(0.1, 5).instants()
    mean = torch.stack([take(film.scene, film.eye, film.motion.poses(t)).linear for t in times]).mean(0)
    expected = to_bytes(encode_srgb(mean)).numpy()
    assert np.abs(expected.astype(int) - shot.rgb).max() <= 1
    ends = np.array(shot.facts["motion_blur"]["path"])
    np.testing.assert_allclose(ends, film.motion.poses(shot.seconds + np.array([-0.05, 0, 0.05])))


def test_a_lens_moves_points_as_its_camera_projects_them(bank: TextureBank) -> None:
    """Points of an undistorted view land, through the lens model, on pixels of the same colour and depth of the distorted view."""
    film, straight = filmed(bank, "distortion:strong"), filmed(bank)
    bent, plain = film.shot(1), straight.shot(1)
    assert film.intrinsics.distorted
    v, u = np.mgrid[8:52:2, 8:72:2].reshape(2, -1)
    points = unproject(CAMERA, plain.world_from_camera, np.stack([u + 0.5, v + 0.5], axis=1), plain.depth[v, u])
    pixels, depth = project(film.intrinsics, bent.world_from_camera, points)
    x, y = np.floor(pixels).astype(int).T
    moved = np.hypot(pixels[:, 0] - u - 0.5, pixels[:, 1] - v - 0.5)
    assert moved.max() > 2
    near = np.abs(bent.depth[y, x] / depth - 1) < 0.02
    assert near.mean() > 0.85
    assert np.median(np.abs(bent.rgb[y, x].astype(int) - plain.rgb[v, u])[near].mean(1)) < 12


def test_highlights_move_with_the_view_and_nothing_else_does(bank: TextureBank) -> None:
    film, dull = filmed(bank, "highlights:strong", kind="sphere"), filmed(bank, kind="sphere")
    assert dull.scene.highlights is None
    for index in (0, 5):
        more = film.shot(index).rgb.astype(int) - dull.shot(index).rgb
        assert more.min() >= 0 and more.max() > 30


def test_the_background_fills_what_nothing_covers(bank: TextureBank) -> None:
    film, black = filmed(bank, "background", kind="street").shot(0), filmed(bank, kind="street").shot(0)
    sky = black.depth == 0
    assert sky.mean() > 0.02
    assert black.rgb[sky].mean() < 8 < 60 < film.rgb[sky].mean()
    inner = ~sky
    inner[1:] &= ~sky[:-1]
    inner[:-1] &= ~sky[1:]
    inner[:, 1:] &= ~sky[:, :-1]
    inner[:, :-1] &= ~sky[:, 1:]
    assert np.array_equal(film.rgb[inner], black.rgb[inner])


def test_depth_noise_is_only_in_the_sensors_depth(bank: TextureBank) -> None:
    film, clean = filmed(bank, "depth_noise:strong", depth=True).shot(0), filmed(bank, depth=True).shot(0)
    assert clean.sensor_depth is not None and film.sensor_depth is not None
    assert np.array_equal(clean.sensor_depth, clean.depth)
    assert np.array_equal(film.depth, clean.depth) and np.array_equal(film.rgb, clean.rgb)
    got = film.sensor_depth > 0
    assert 0.3 < got.mean() < 0.98
    assert 0.001 < np.median(np.abs(film.sensor_depth - film.depth)[got]) < 0.1
    assert filmed(bank).shot(0).sensor_depth is None


def test_compression_is_what_the_file_will_hold(bank: TextureBank) -> None:
    shot, clean = filmed(bank, "compression:strong").shot(0), filmed(bank).shot(0)
    assert shot.jpeg is not None and shot.jpeg[:2] == b"\xff\xd8" and clean.jpeg is None
    assert np.abs(shot.rgb.astype(int) - clean.rgb).mean() > 1


def test_exact_geometry_with_a_lens_and_rows(bank: TextureBank) -> None:
    """Depth through a lens: unprojected along the lens' own rays it lies on the scene's surfaces."""
    film = filmed(bank, "distortion", "rolling_shutter")
    shot = film.shot(0)
    assert isinstance(film.scene, Scene)
    eye = eye_of(film.intrinsics, 2, torch.device("cpu"))
    rays = (eye.directions / eye.cosine[:, None]).numpy() * shot.depth.reshape(-1, 1)
    points = rays @ shot.world_from_camera[:3, :3].T + shot.world_from_camera[:3, 3]
    assert np.quantile(film.scene.clearance(torch.from_numpy(points)).abs().numpy(), 0.98) < 2e-3
