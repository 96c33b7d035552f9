"""Matching by several processes: the same as by one, with nothing left behind; with the real matcher."""

from __future__ import annotations

import os
import shutil
from contextlib import nullcontext
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fieldfuse.config import PosesSettings
from fieldfuse.poses import database as store
from fieldfuse.poses import match
from fieldfuse.poses.job import Job
from tests.poses.textured import all_pairs, made_job, orbit, post, render, silent, write_capture

COUNT = 12
PAIRS = all_pairs(COUNT)  # two steps, and a part of one


@pytest.fixture(scope="module")
def featured(tmp_path_factory) -> Job:
    """Pictures of a post, their features in the database and nothing matched."""
    folder = tmp_path_factory.mktemp("post")
    planes = post((3, 4, 13, 14))
    capture = write_capture(folder / "photos", [render(pose, planes=planes)[0] for pose in orbit(COUNT, 0.35)], ordered=True)
    return made_job(capture, [], PosesSettings(max_features=500))


def copy_of(job: Job, folder: Path, threads: int) -> Job:
    folder.mkdir()
    other = replace(job, folder=str(folder), threads=threads)
    shutil.copyfile(job.database, other.database)
    return other


def found(job: Job) -> dict[tuple[int, int], tuple[Any, ...]]:
    """All that matching left, by pair of image ids."""
    out = {}
    with store.opened(job.database) as database:
        for first, second in combinations(sorted(image.image_id for image in database.read_all_images()), 2):
            if database.exists_matches(first, second):
                pair = database.read_two_view_geometry(first, second)
                flat = [np.zeros(0) if one is None else np.asarray(one) for one in (pair.F, pair.E, pair.H, pair.inlier_matches)]
                out[first, second] = (np.asarray(database.read_matches(first, second)), pair.config, *flat)
    return out


@pytest.fixture(scope="module")
def alone(featured, tmp_path_factory) -> dict[tuple[int, int], tuple[Any, ...]]:
    """What one process finds."""
    job = copy_of(featured, tmp_path_factory.mktemp("alone") / "one", 1)
    match.match(job, PAIRS, silent)
    return found(job)


def test_what_is_matched_does_not_hang_on_the_threads(featured, alone, tmp_path, monkeypatch):
    monkeypatch.setattr(match, "PAIRS_A_STEP", 8)  # nine steps
    together = copy_of(featured, tmp_path / "three", 3)
    told: list[float] = []
    match.match(together, PAIRS, lambda done, total, note: told.append(done))
    first, second = alone, found(together)
    assert set(first) == set(second) and len(first) == len(PAIRS)
    for pair, values in first.items():
        for one, other in zip(values, second[pair], strict=True):
            np.testing.assert_array_equal(one, other)
    assert sum(len(values[-1]) >= store.MIN_INLIERS for values in first.values()) > COUNT
    assert told == sorted(told) and told[0] == 0 and told[-1] == len(PAIRS)
    assert not (tmp_path / "three" / "matching").exists()


def test_what_is_there_already_stays(featured, tmp_path, monkeypatch):
    monkeypatch.setattr(match, "PAIRS_A_STEP", 8)
    job = copy_of(featured, tmp_path / "job", 2)
    match.match(job, PAIRS[:20], silent)
    before = found(job)
    match.match(job, PAIRS, silent)
    after = found(job)
    assert len(before) == 20 and len(after) == len(PAIRS)
    for pair, values in before.items():
        for one, other in zip(values, after[pair], strict=True):
            np.testing.assert_array_equal(one, other)
    monkeypatch.setattr(match, "_copies", lambda job, count: pytest.fail("copied for nothing") if count else nullcontext([]))
    match.match(job, PAIRS, silent)  # nothing is left to do


@pytest.mark.parametrize("room", [0, 1])
def test_without_room_for_copies_fewer_match(featured, tmp_path, monkeypatch, room):
    monkeypatch.setattr(match, "PAIRS_A_STEP", 8)
    made = 0
    real = shutil.copyfile

    def copyfile(source: Any, target: Any) -> Any:
        nonlocal made
        if "matching" in Path(target).parts:
            if made >= room:
                raise OSError(28, "No space left on device")
            made += 1
        return real(source, target)

    job = copy_of(featured, tmp_path / "job", 3)
    monkeypatch.setattr(match.shutil, "copyfile", copyfile)
    match.match(job, PAIRS[:24], silent)
    assert made == room and len(found(job)) == 24 and not (tmp_path / "job" / "matching").exists()


@pytest.mark.parametrize("broken", ["database", "process"])
def test_what_fails_together_is_matched_alone(featured, alone, tmp_path, monkeypatch, broken):
    """A copy that is no database, and a process that dies: neither is taken for pairs without matches, and all are matched in the end."""
    monkeypatch.setattr(match, "PAIRS_A_STEP", 8)
    job = copy_of(featured, tmp_path / "job", 2)
    if broken == "process":
        monkeypatch.setattr(match, "_end_with_parent", os.abort)
    real = shutil.copyfile

    def copyfile(source: Any, target: Any) -> Any:
        if broken == "database" and Path(target).parent.name == "1":
            return Path(target).write_bytes(b"no database")
        return real(source, target)

    monkeypatch.setattr(match.shutil, "copyfile", copyfile)
    told: list[float] = []
    match.match(job, PAIRS, lambda done, total, note: told.append(done))
    first, second = found(job), alone
    assert set(first) == set(second) and all(len(first[pair][0]) == len(second[pair][0]) for pair in second)
    assert told[-1] == len(PAIRS) and not (tmp_path / "job" / "matching").exists()
