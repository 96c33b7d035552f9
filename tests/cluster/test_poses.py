"""Features and matches by tasks are those that one machine finds, also where workers die and runs are interrupted."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import AbstractContextManager, closing
from dataclasses import replace
from pathlib import Path
from tempfile import gettempdir
from typing import Any

import numpy as np
import psutil
import pytest

from fieldfuse.cluster import Workers, open_workers
from fieldfuse.config import PosesSettings
from fieldfuse.errors import FieldfuseError, InputError
from fieldfuse.poses import database as store
from fieldfuse.poses import match
from fieldfuse.poses.job import Job, plan
from fieldfuse.poses.sfm import find_poses
from fieldfuse.poses.spread import FOLDER
from tests.poses.textured import all_pairs, made_job, orbit, post, render, silent, write_capture

COUNT = 10
PAIRS = all_pairs(COUNT)  # four tasks, and a part of one
FEATURES = PosesSettings(max_features=500)


@pytest.fixture(autouse=True)
def small_tasks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(match, "PAIRS_A_TASK", 10)
    monkeypatch.setattr(match, "PAIRS_WORTH", 1)
    monkeypatch.setattr(store, "IMAGES_A_TASK", 4)
    monkeypatch.setattr(store, "IMAGES_WORTH", 1)


@pytest.fixture(scope="module")
def featured(tmp_path_factory: pytest.TempPathFactory) -> Job:
    """Pictures of a post, their features in the database and nothing matched."""
    planes = post((3, 4, 13, 14))
    photos = tmp_path_factory.mktemp("post") / "photos"
    return made_job(write_capture(photos, [render(pose, planes=planes)[0] for pose in orbit(COUNT, 0.3)]), [], FEATURES)


@pytest.fixture(scope="module")
def alone(featured: Job, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What the database holds when this process has matched."""
    job = copied(featured, tmp_path_factory.mktemp("alone") / "job")
    match.match(job, PAIRS, silent)
    return content(job)


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tasks run one after the other in this process."""

    def workers_here(address: str | None) -> AbstractContextManager[Workers]:
        return open_workers(pool=False)

    monkeypatch.setattr("fieldfuse.poses.spread.open_workers", workers_here)


def copied(job: Job, folder: Path, address: str | None = None, threads: int = 1) -> Job:
    folder.mkdir()
    other = replace(job, folder=str(folder), address=address, threads=threads)
    shutil.copyfile(job.database, other.database)
    return other


def content(job: Job) -> dict[str, Any]:
    """All rows of all tables."""
    with closing(sqlite3.connect(job.database)) as database:
        tables = [name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
        return {table: sorted(database.execute(f"SELECT * FROM {table}"), key=repr) for table in tables}


def test_nodes_find_the_matches_that_one_machine_finds(cluster: Any, featured: Job, alone: dict[str, Any], tmp_path: Path) -> None:
    assert sum(row[1] >= store.MIN_INLIERS for row in alone["two_view_geometries"]) > COUNT
    job = copied(featured, tmp_path / "job", cluster.address)
    notes: list[str] = []
    match.match(job, PAIRS, lambda done, total, note: notes.append(note))
    assert content(job) == alone
    assert any("on the cluster's nodes" in note for note in notes)
    assert [path.name for path in tmp_path.glob("job/*")] == ["database.db"]


def test_a_node_that_dies_while_it_matches_costs_nothing_else(cluster: Any, featured: Job, alone: dict[str, Any], tmp_path: Path) -> None:
    job = copied(featured, tmp_path / "job", cluster.address)
    killed: list[int] = []

    def kill(done: float, total: float, note: str) -> None:
        if killed or not done:
            return
        for process in psutil.Process().children(recursive=True):  # of this test's cluster
            if any(part.startswith("ray::matching") for part in process.cmdline()):
                killed.append(process.pid)
                process.kill()
                return

    match.match(job, PAIRS, kill)
    assert killed and content(job) == alone
    assert not list(Path(gettempdir()).glob(f"fieldfuse-matching-*-{killed[0]}"))


@pytest.mark.usefixtures("here")
def test_files_of_an_interrupted_run_are_used(
    featured: Job, alone: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = copied(featured, tmp_path / "job", "auto", threads=0)
    made: list[tuple[int, int]] = []

    def once(own: Job, folder: Path, pairs: list[tuple[int, int]]) -> None:
        made.extend(pairs)
        if PAIRS[25] in pairs and made.count(PAIRS[25]) == 1:
            raise RuntimeError("as if COLMAP could not")
        really(own, folder, pairs)

    really = match._match
    monkeypatch.setattr(match, "_match", once)
    with pytest.raises(FieldfuseError, match=r"matching of pairs 21 to 30 .*as if COLMAP could not.*; 4 of 5 tasks are kept, run the same"):
        match.match(job, PAIRS, silent)
    assert len(list((tmp_path / "job" / FOLDER).glob("matches-*.db"))) == 4
    match.match(job, PAIRS, silent)
    assert made == [*PAIRS, *PAIRS[20:30]]
    assert content(job) == alone and not (tmp_path / "job" / FOLDER).exists()


@pytest.mark.usefixtures("here")
@pytest.mark.parametrize("case", ["few pairs", "more threads"])
def test_what_is_not_faster_elsewhere_is_matched_here(
    featured: Job, alone: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, case: str
) -> None:
    monkeypatch.setattr(match, "matches_of", lambda *_: pytest.fail("a task was begun"))
    if case == "few pairs":
        monkeypatch.setattr(match, "PAIRS_WORTH", len(PAIRS) + 1)
        monkeypatch.setattr("fieldfuse.poses.spread.open_workers", lambda _: pytest.fail("the cluster was asked"))
    job = copied(featured, tmp_path / "job", "auto")
    match.match(job, PAIRS, silent)
    assert content(job) == alone and not (tmp_path / "job" / FOLDER).exists()


@pytest.fixture(params=["here", "cluster"])
def address(request: pytest.FixtureRequest) -> Iterator[str]:
    found = request.getfixturevalue(request.param)
    yield "auto" if found is None else found.address


def test_nodes_find_the_features_that_one_machine_finds(featured: Job, tmp_path: Path, address: str) -> None:
    job = replace(featured, folder=str(tmp_path), address=address, threads=0 if address == "auto" else 1, feature_bytes=2**26)
    with closing(store.open_database(job)) as database:
        records = store.extract(job, database, silent)
    assert content(job) == content(featured)
    assert len(records) == COUNT and job.records.read_bytes() == featured.records.read_bytes()
    assert not (tmp_path / FOLDER).exists()


@pytest.mark.usefixtures("here")
def test_an_image_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    capture = write_capture(tmp_path / "photos", [np.zeros((240, 320, 3), np.uint8)] * 3)
    (tmp_path / "photos" / "001.png").write_bytes(b"no picture")
    job = replace(plan(capture, tmp_path / "sparse", FEATURES, 3, 0), address="auto")
    (tmp_path / "sparse").mkdir()
    with closing(store.open_database(job)) as database, pytest.raises(FieldfuseError, match=r"features of images 1 to 3 .*001\.png"):
        store.extract(job, database, silent)


@pytest.mark.long
def test_poses_by_a_cluster_are_those_of_one_machine(cluster: Any, tmp_path: Path) -> None:
    """As many pictures as it takes for the cluster to be used: 64 with 500 pairs and more."""
    planes = post((3, 4, 13, 14))
    pictures = [render(pose, planes=planes)[0] for pose in orbit(64, 0.8)]
    found = {}
    for name, where in (("alone", None), ("cluster", cluster.address)):
        capture = write_capture(tmp_path / name / "photos", pictures, ordered=True)
        found[name] = find_poses(capture, tmp_path / name, PosesSettings(max_features=300), 3, 1, address=where)
    assert found["alone"].registered > 50
    np.testing.assert_array_equal(found["alone"].world_from_camera, found["cluster"].world_from_camera)
    matched = {name: "Feature matching" in (tmp_path / name / "sparse" / "log.txt").read_text() for name in found}
    assert matched == {"alone": True, "cluster": False}


def test_an_address_at_which_nothing_is_ends_with_a_sentence(featured: Job, tmp_path: Path) -> None:
    pytest.importorskip("ray", reason="Ray is not installed (the extra cluster)")
    job = copied(featured, tmp_path / "job", "127.0.0.1:1")
    with pytest.raises(InputError, match=r"nothing answers at 127\.0\.0\.1:1"):
        match.match(job, PAIRS, silent)
