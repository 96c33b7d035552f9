"""Photos that find no place by the pairs that were chosen are matched with all others; with the real matcher and mapper."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from fieldfuse.config import PosesSettings
from fieldfuse.poses import database as store
from fieldfuse.poses import placing
from fieldfuse.poses.job import MAX_ASKED_AGAIN, MAX_EXHAUSTIVE, Job, plan
from fieldfuse.poses.mapping import plain
from fieldfuse.poses.match import match
from fieldfuse.poses.pairs import exhaustive_pairs, pairs_with
from fieldfuse.poses.selection import choose_pairs
from tests.poses.textured import aligned_error, orbit, post, render, write_capture

COUNT, LATE = 14, [5, 11]
POSES = orbit(COUNT, 0.4)


def silent(done: float, total: float, note: str) -> None:
    pass


@pytest.fixture(scope="module")
def matched(tmp_path_factory) -> Job:
    """Photos of a post, all matched with each other but for two, with which nothing was."""
    folder = tmp_path_factory.mktemp("post")
    planes = post((3, 4, 13, 14))
    pictures = [render(pose, planes=planes)[0] for pose in POSES]
    capture = replace(write_capture(folder / "photos", pictures, ordered=True), ordered=False)
    job = plan(capture, folder / "sparse", PosesSettings(max_features=800), seed=3, threads=1)
    Path(job.folder).mkdir()
    database = store.open_database(job)
    store.extract(job, database, silent)
    database.close()
    match(job, sorted(set(exhaustive_pairs(COUNT)) - set(pairs_with(LATE, COUNT))), silent)
    return job


def verified(job: Job) -> int:
    database = pycolmap.Database.open(job.database)
    try:
        return len(store.pair_facts(job, database))
    finally:
        database.close()


def test_pictures_without_a_place_are_asked_again(matched, monkeypatch):
    before = verified(matched)
    model, facts = placing.place(matched, silent)
    assert model is not None and plain(model)["pictures"] == [i for i in range(COUNT) if i not in LATE]  # so few are all matched at first
    assert len(facts["pairs"]) == before

    monkeypatch.setattr(placing, "MAX_EXHAUSTIVE", 10)
    model, facts = placing.place(matched, silent)
    assert model is not None
    found = plain(model)
    assert found["pictures"] == list(range(COUNT)) and len(facts["pairs"]) > before and facts["folded"] is None
    assert aligned_error(np.array(found["world_from_camera"])[:, :3, 3], POSES[:, :3, 3]) < 0.01
    assert verified(matched) == before and not (Path(matched.folder) / "again").exists()  # what was matched stays as it was


def test_frames_in_order_and_too_many_photos_are_not(matched, monkeypatch):
    monkeypatch.setattr(placing, "MAX_EXHAUSTIVE", 10)
    monkeypatch.setattr(placing, "MAX_ASKED_AGAIN", 12)
    monkeypatch.setattr(placing, "pairs_with", lambda *_: pytest.fail("was asked again"))
    assert placing.place(matched, silent)[0] is not None
    monkeypatch.setattr(placing, "MAX_ASKED_AGAIN", 120)
    assert placing.place(replace(matched, sequential=True), silent)[0] is not None


def test_few_photos_are_all_matched_and_many_with_those_that_look_alike(matched, monkeypatch):
    database = pycolmap.Database.open(matched.database)
    try:
        assert choose_pairs(matched, database, silent) == exhaustive_pairs(COUNT)
        many = replace(matched, pictures=matched.pictures * 4)
        monkeypatch.setattr("fieldfuse.poses.selection.sketches", lambda *_: list(np.zeros((len(many.pictures), 0, 128), np.float32)))
        assert len(many.pictures) > MAX_EXHAUSTIVE and len(choose_pairs(many, database, silent)) < len(exhaustive_pairs(len(many.pictures)))
    finally:
        database.close()
    assert MAX_EXHAUSTIVE < MAX_ASKED_AGAIN


def test_pairs_with_some():
    assert pairs_with([2], 4) == [(0, 2), (1, 2), (2, 3)]
    assert pairs_with(list(range(7)), 7) == exhaustive_pairs(7)
    assert pairs_with([], 5) == []
