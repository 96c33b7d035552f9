"""Highlights looked for between points, on made-up pictures of a textured wall: found where light wanders over it, and only then."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fieldfuse.effects.evidence import Finding
from fieldfuse.effects.light import EXPOSURE, VIGNETTING, Light
from fieldfuse.effects.specularity import THRESHOLD, find_specularity
from fieldfuse.effects.tracks import Tracks
from tests.effects.walls import AWAY, FRAMES, WIDTH, problem_of, wall

PLAIN = Light({}, frozenset(), {}, {}, 1.0)


def looked(seen: Tracks, found: Light = PLAIN, wrong: float = 0.0) -> Finding:
    depth = np.full(len(seen.frame), AWAY)
    depth[: int(wrong * len(depth))] *= 0.5
    return find_specularity(seen, problem_of(seen), np.random.default_rng(1).permutation(depth), found)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_wall_without_lamps_is_dull(seed: int) -> None:
    drift = np.exp2(0.5 * np.sin(np.arange(FRAMES)))
    uneven = replace(PLAIN, kept=frozenset({EXPOSURE}))
    dim = replace(PLAIN, kept=frozenset({VIGNETTING}), corner=0.5)
    for found in (looked(wall(seed=seed)), looked(wall(gain=drift, seed=seed), uneven), looked(wall(corner=0.5, seed=seed), dim)):
        assert not found.there and found.number < 0.5 * THRESHOLD, found.reason


@pytest.mark.parametrize("seed", [0, 1])
def test_light_that_wanders_over_a_wall_is_found_and_held_out_pictures_agree(seed: int) -> None:
    found = looked(wall(lamp=0.08, seed=seed))
    assert found.there and found.number > 4 * THRESHOLD, found.reason
    assert found.before is not None and found.after is not None and found.after < 0.5 * found.before
    drift = np.exp2(0.3 * np.sin(np.arange(FRAMES)))
    assert looked(wall(lamp=0.08, gain=drift, seed=seed), replace(PLAIN, kept=frozenset({EXPOSURE}))).there


@pytest.mark.parametrize("lamp", [0.0, 0.08])
def test_pictures_of_several_shapes(lamp: float) -> None:
    """Upright ones among lying ones: every second shows only the middle of what it did."""
    seen = wall(lamp=lamp)
    cut = 40
    cameras = [replace(c, width=c.width - 2 * cut, cx=c.cx - cut) if k % 2 else c for k, c in enumerate(seen.cameras)]
    pictures = tuple(picture[:, cut:-cut] if k % 2 else picture for k, picture in enumerate(seen.images))
    odd = seen.frame % 2 == 1
    pixel = seen.pixel - np.where(odd, cut, 0)[:, None] * [1, 0]
    kept = ~odd | ((pixel[:, 0] > 2) & (pixel[:, 0] < WIDTH - 2 * cut - 2))
    parts = {name: getattr(seen, name)[kept] for name in ("frame", "point")}
    mixed = replace(seen, cameras=cameras, images=pictures, pixel=pixel[kept], **parts)
    assert looked(mixed).there == (lamp > 0)


def test_wrong_depths_are_no_highlights_and_nothing_is_told_of_too_little() -> None:
    assert not looked(wall(), wrong=0.3).there
    found = looked(replace(wall(lamp=0.08), poses=np.tile(np.eye(4), (FRAMES, 1, 1))))  # all from one place
    assert not found.there and found.number == 0 and found.before is None


def test_points_that_lie_on_no_plane_tell_nothing() -> None:
    """As on a small object between much that is empty: no patch has a depth."""
    seen = wall(lamp=0.08)
    depth = AWAY * np.random.default_rng(0).uniform(0.2, 5.0, len(seen.frame))
    found = find_specularity(seen, problem_of(seen), depth, PLAIN)
    assert not found.there and found.number == 0
