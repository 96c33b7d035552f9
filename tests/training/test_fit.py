"""Fitting a small made scene: it learns, keeps its budget, never looks at held-out views, and can be stopped."""

from __future__ import annotations

import time

import numpy as np
import pytest
import torch

from fieldfuse.camera import Intrinsics, Similarity, pixel_grid, rays
from fieldfuse.capture.types import Views
from fieldfuse.config import Settings, load_settings
from fieldfuse.poses.scene import Scene
from fieldfuse.progress import Progress
from fieldfuse.render.image import render_view
from fieldfuse.training.fit import Begin, fit_field
from fieldfuse.training.levels import all_places, finer, looked_at, visible
from fieldfuse.training.start import levels, make_space, possible
from fieldfuse.volume.grid import GridHost

SIZE = 40


def look_at(eye: np.ndarray) -> np.ndarray:
    forward = -eye / np.linalg.norm(eye)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(forward, right), forward, eye], 1)
    return pose


def sphere_views(count: int = 16) -> Views:
    """A sphere of radius 0.5 with coloured patches on white, seen from around, with alpha and exact depth."""
    camera = Intrinsics(SIZE, SIZE, 50, 50, SIZE / 2, SIZE / 2)
    images, alphas, poses = [], [], []
    for i in range(count):
        angle = 2 * np.pi * i / count
        pose = look_at(1.5 * np.array([np.cos(angle), np.sin(angle), 0.4 * np.sin(3 * angle)]))
        origin, direction, _ = rays(camera, pose, pixel_grid(SIZE, SIZE))
        b = (origin * direction).sum(1)
        inside = b * b - (origin * origin).sum(1) + 0.25
        hit = inside > 0
        point = origin + direction * (-b - inside.clamp_min(0).sqrt())[:, None]
        colour = torch.where(hit[:, None], 0.5 + 0.5 * torch.sin(6 * point), torch.ones(3))
        images.append((colour.view(SIZE, SIZE, 3).numpy() * 255).round().astype(np.uint8))
        alphas.append((hit.view(SIZE, SIZE).numpy() * 255).astype(np.uint8))
        poses.append(pose)
    test = np.arange(count) % 8 == 0
    return Views([f"{i:02d}" for i in range(count)], images, [camera] * count, np.array(poses), test, [], list(alphas), [], (1.0, 1.0, 1.0))


def scene() -> Scene:
    return Scene(Similarity.identity(), np.zeros(3), np.full(3, 0.6), 1.2, 0.8, 2.0, 0.0, False, False)


def wanted(*pairs: str) -> Settings:
    return load_settings(pairs=["budget=6", "field.channels=8", "field.hidden=16", "field.resolution=64", "device=cpu", *pairs])


def ticking(monkeypatch: pytest.MonkeyPatch, tick: float) -> dict[str, int]:
    """The fit's clock goes on by `tick` seconds at each look: a fit then makes the same steps on any machine, however busy."""
    looks = {"count": 0}

    def seconds(self: object) -> float:
        looks["count"] += 1
        return looks["count"] * tick

    monkeypatch.setattr("fieldfuse.training.fit.Clock.seconds", seconds)
    return looks


@pytest.mark.parametrize("decoder", ["deferred", "per_sample"])
def test_a_sphere_is_learnt(decoder: str, monkeypatch: pytest.MonkeyPatch) -> None:
    ticking(monkeypatch, 0.015)
    result = fit_field(sphere_views(), scene(), wanted(f"decoder={decoder}"), begin=Begin(GridHost()))
    assert result.timeline[-1]["psnr"] > (21 if decoder == "deferred" else 19)  # an empty field scores 8.6
    assert result.timeline[-1]["psnr"] > result.timeline[0]["psnr"]
    views = sphere_views()
    depth = render_view(result.field, views.intrinsics[0], views.world_from_camera[0]).depth[SIZE // 2, SIZE // 2]
    assert depth == pytest.approx(1.0, abs=0.1)


def test_budget_is_kept() -> None:
    """By the real clock: what it goes over is one step, or one climb to a finer level, however long the machine takes for that."""
    looks: list[float] = []

    def ticks() -> float:
        looks.append(time.perf_counter())
        return looks[-1]

    result = fit_field(sphere_views(), scene(), wanted("budget=1"), ticks=ticks)
    assert result.steps > 0 and result.seconds <= 1 * 1.05 + 2 * float(np.diff(looks).max())
    assert result.seconds <= looks[-1] - looks[0] + 1e-6


def test_a_fit_of_few_views_ends_with_its_passes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fieldfuse.training.schedule.LEAST_RAYS", 0.0)
    ticking(monkeypatch, 1e-3)
    views = sphere_views(8)  # too few for a validation split
    pixels = 7 * SIZE * SIZE
    result = fit_field(views, scene(), wanted("budget=60", "fit.passes=12"))
    assert 12 * pixels <= result.rays < 12 * pixels + 2048 and result.seconds < 30
    assert result.timeline[-1]["psnr"] > 14
    longer = fit_field(views, scene(), wanted("budget=1", "fit.passes=null"))
    assert longer.rays > 15 * pixels


def test_held_out_views_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """With their pictures replaced by noise the same steps give the same field, bit for bit."""
    ticks = ticking(monkeypatch, 0.05)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)

    settings = wanted()
    views, spoiled = sphere_views(), sphere_views()
    for index in np.flatnonzero(spoiled.test):
        spoiled.images[index] = np.random.default_rng(0).integers(0, 255, (SIZE, SIZE, 3), np.uint8)
        spoiled.alpha[index] = np.zeros((SIZE, SIZE), np.uint8)
    one = fit_field(views, scene(), settings)
    ticks["count"] = 0
    two = fit_field(spoiled, scene(), settings)
    torch.set_num_threads(threads)
    assert one.steps == two.steps > 50
    assert one.timeline[-1]["psnr"] > two.timeline[-1]["psnr"] + 5
    assert torch.equal(one.field.density_rows, two.field.density_rows)
    assert torch.equal(one.field.feature_rows, two.field.feature_rows)


def test_the_start_is_the_visual_hull() -> None:
    views = sphere_views()
    space = make_space(scene(), background=False)
    places = all_places(space, 32)
    kept = possible(space, 32, places, views)
    centre = (kept.double() + 0.5) / 32 * 2 * space.extent - space.extent
    radius = (centre * space.half).norm(dim=1)
    assert len(kept) < len(places)
    assert float((radius < 0.62).float().mean()) > 0.8  # the rest lies in front of every silhouette that could tell
    inner = (((places.double() + 0.5) / 32 * 2 - 1) * space.half).norm(dim=1) < 0.45
    assert int(inner.sum()) <= len(kept)


@pytest.mark.parametrize(
    ("finest", "expected"), [(64, [32, 64]), (256, [32, 64, 128, 256]), (320, [32, 64, 128, 320]), (288, [32, 64, 128, 288])]
)
def test_levels_end_at_the_finest(finest: int, expected: list[int]) -> None:
    assert levels(finest) == expected


@pytest.mark.parametrize("resolution", [128, 96])
def test_a_finer_lattice_shows_the_same(resolution: int) -> None:
    from fieldfuse.render.rays import render_rays
    from fieldfuse.volume.host import TorchHost
    from tests.render.made import random_field, random_rays

    field = random_field(resolution=64, keep=1.0, raw=-2.0)
    origins, directions = random_rays(200)
    before = render_rays(field, origins, directions)
    after = render_rays(finer(field, torch.ones_like(field.occupied), resolution, TorchHost()), origins, directions)
    assert float((before.opacity - after.opacity).abs().mean()) < 0.02
    assert float((before.colour - after.colour).abs().mean()) < 0.03


def test_pruning_keeps_neighbours_of_what_was_seen() -> None:
    from tests.render.made import random_field

    field = random_field(resolution=32)
    seen = torch.zeros(len(field.occupied))
    seen[field.occupied.nonzero()[5000]] = 0.5
    often, never = torch.full_like(seen, 100.0), torch.zeros_like(seen)
    assert 8 <= int(visible(field, seen, often, 0.05).sum()) <= 27
    assert visible(field, never, often, 0.05).equal(field.occupied)  # nothing seen strongly yet: nothing removed
    assert visible(field, seen, never, 0.05).equal(field.occupied)  # too few samples to tell


def test_when_memory_is_short_surfaces_keep_the_neighbours_that_no_ray_came_to() -> None:
    from tests.render.made import random_field

    field = random_field(resolution=32)
    surface, passed = field.occupied.nonzero().squeeze(1)[[5000, 9000]]
    seen, visits = torch.zeros(len(field.occupied)), torch.zeros(len(field.occupied))
    seen[surface], visits[surface], visits[passed] = 0.5, 20.0, 3.0
    kept = looked_at(field, seen, visits, 0.05)
    assert bool(kept[surface]) and bool(kept[passed])
    assert 8 <= int(kept.sum()) <= 28  # the surface with up to 26 neighbours, and what light only passed, which has none


def test_coarse_levels_end_soon_where_no_validation_views_tell_that_they_gain_nothing_more(monkeypatch: pytest.MonkeyPatch) -> None:
    ticking(monkeypatch, 0.02)
    climbed: list[int] = []

    def note(done: float, total: float, text: str = "") -> None:
        if text.startswith("64³") and not climbed:
            climbed.append(round(done))

    progress = Progress()
    monkeypatch.setattr(progress, "update", note)
    late = (0.7, 0.8, 0.9)
    result = fit_field(sphere_views(), scene(), wanted("budget=10"), progress, Begin(rungs=late))
    assert result.field.resolution == 64 and climbed[0] <= 2  # by `UNTOLD`, or as soon as a level has had time to grow, not by `late`


@pytest.mark.parametrize(("tick", "ends_early"), [(0.01, True), (0.04, False)])
def test_a_fit_ends_where_others_go_on_if_there_is_time_for_them(tick: float, ends_early: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    ticking(monkeypatch, tick)
    result = fit_field(sphere_views(), scene(), wanted("field.resolution=32"), begin=Begin(until=64))
    assert result.field.resolution == 32
    if ends_early:
        assert 0 < result.done < 0.5 and 100 <= result.steps < 300
    else:
        assert result.done == 1 and result.seconds > 5.9
