"""Matching and verifying pairs of images by COLMAP, in several processes. Runs in the child process only."""

from __future__ import annotations

import os
import shutil
import sqlite3
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from functools import lru_cache
from multiprocessing import get_context, parent_process
from pathlib import Path
from queue import SimpleQueue
from socket import gethostname
from tempfile import gettempdir

import psutil
import pycolmap

from fieldfuse.camera import Array
from fieldfuse.cluster import Task
from fieldfuse.files import atomic_path, fingerprint, remove
from fieldfuse.poses.database import Report, floats, label, opened
from fieldfuse.poses.job import XFEAT, Job
from fieldfuse.poses.spread import FOLDER, spread
from fieldfuse.progress import Progress

# Learned features nearly always match something, and of hundreds of false matches some dozens agree with some geometry or other.
LEAST_RATIO = 0.2  # share of such a pair's matches that have to
MOST_TRIALS = 3000  # which so many trials find
PAIRS_A_STEP = 40  # matched between two progress reports
MOST_MATCHERS = 8  # processes, each of a hundred megabytes and more
MOST_DESCRIBED = 128  # images whose learned descriptors are held in memory, of a megabyte each
PAIRS_A_TASK = 200  # matched by one task on a cluster
PAIRS_WORTH = 200  # for each process of this machine, from which the cluster is worth its start (docs/cluster.md)
MOST_COPIED = 2**30  # bytes of all copies of the database, of which each process that matches has one


def match(job: Job, pairs: list[tuple[int, int]], report: Report) -> None:
    """Match and verify `pairs` (indices into the job's images); those in the database already are skipped. Nobody else has the database
    open meanwhile.

    What is found does not depend on the threads. Two threads that match in one process, COLMAP's or ours, gave some pairs other matches now
    and then (docs/measured/performance.md), so each is a process with its own copy of the features, and a second thread that verifies.
    """
    left = _left(job, pairs)
    total = len(left)

    def show(done: int) -> None:
        before = 0.5 if job.features == XFEAT else 0.0
        report(before * total + (1 - before) * done, total, f"matching, pair {done} of {total}")

    if job.address is not None and total >= PAIRS_WORTH * _processes(job):
        _spread(job, pairs, left, report)
        left = _left(job, left)
    if job.features == XFEAT and left:
        _compare(job, left, lambda done: report(done / 2, total, f"matching, pair {done} of {total}"))
    show(total - len(left))
    with suppress(RuntimeError):  # no room for what copies grow to, or a process ended for its memory: what is left is matched here
        _together(job, left, show)
    left = _left(job, left)
    done = total - len(left)
    for step in _steps(left):
        _match(job, Path(job.folder), step)
        show(done := done + len(step))


def _spread(job: Job, pairs: list[tuple[int, int]], left: list[tuple[int, int]], report: Report) -> None:
    """Have the nodes of the job's cluster match what is left of `pairs`, if they are faster."""
    folder, missing = Path(job.folder) / FOLDER, set(left)
    job.save(folder / "job.json")
    tasks, parts = [], []
    for start in range(0, len(pairs), PAIRS_A_TASK):  # of all pairs, so that an interrupted run's files are those of the next
        part = pairs[start : start + PAIRS_A_TASK]
        if missing.intersection(part):
            argument = (str(folder / "job.json"), part, str(folder / f"matches-{fingerprint(part)}.db"))
            tasks.append(Task(f"matching of pairs {start + 1} to {start + len(part)}", argument))
            parts.append(part)

    def show(done: float) -> None:
        pair = int(done * len(left) / len(tasks))
        report(pair, len(left), f"matching, pair {pair} of {len(left)}, on the cluster's nodes")

    show(0)
    if spread(job, matches_of, tasks, show, _processes(job)):
        for task, part in zip(tasks, parts, strict=True):  # not before all are done: tasks read the database
            _bring(Path(task.argument[-1]), job.database, part)
    remove(folder)


def matches_of(argument: tuple[str, list[tuple[int, int]], str], link: Progress) -> None:
    """A task: match and verify some pairs of images, into a database of their own without features.

    Args:
        argument: the job's file, the pairs, the file to be written.
    """
    job, pairs, target = Job.load(Path(argument[0])), argument[1], Path(argument[2])
    with _scratch() as folder:
        own = replace(job, folder=str(folder), threads=1)
        _excerpt(job.database, own.database, pairs)
        if job.features == XFEAT:
            _compare(own, pairs, lambda done: link.update(done / 2, len(pairs)))
        for done, step in enumerate(_steps(pairs)):
            link.update(done * PAIRS_A_STEP, len(pairs))
            _match(own, folder, step)
        found = folder / target.name  # SQLite writes where its locks work
        _excerpt(own.database, found, [])
        with atomic_path(target) as path:
            shutil.copyfile(found, path)


@contextmanager
def _scratch() -> Iterator[Path]:
    """A folder on this node's own disk while the block lasts. Those of tasks that were killed go first."""
    place, name = Path(gettempdir()), f"fieldfuse-matching-{gethostname()}-"
    for folder in place.glob(f"{name}*"):
        owner = folder.name.removeprefix(name)
        if owner.isdecimal() and (int(owner) == os.getpid() or not psutil.pid_exists(int(owner))):
            remove(folder)
    folder = place / f"{name}{os.getpid()}"
    folder.mkdir(mode=0o700)
    try:
        yield folder
    finally:
        remove(folder)


def _excerpt(source: Path, target: Path, pairs: list[tuple[int, int]]) -> None:
    """Make a database of all images of another, with features and matches of `pairs`, or of none with all matches and no features.

    SQLite reads the other one without locks, which storage of several machines seldom has; nobody writes to it meanwhile.
    """
    pycolmap.Database.open(target).close()
    with closing(sqlite3.connect(target, uri=True)) as database:
        database.execute("ATTACH ? AS source", (f"{source.absolute().as_uri()}?immutable=1",))
        ids = {int(name): number for number, name in database.execute("SELECT image_id, name FROM source.images")}
        images = ",".join(str(ids[index]) for index in sorted({index for pair in pairs for index in pair}))
        numbers = ",".join(str(pycolmap.image_pair_to_pair_id(ids[i], ids[j])) for i, j in pairs)
        where = {"keypoints": f"image_id IN ({images})", "descriptors": f"image_id IN ({images})"}
        if pairs:
            where |= {"matches": f"pair_id IN ({numbers})", "two_view_geometries": f"pair_id IN ({numbers})"}
        names = "SELECT name FROM source.sqlite_master WHERE type = 'table' AND name NOT LIKE 'sqlite_%'"
        for (table,) in database.execute(names).fetchall():
            database.execute(f"INSERT INTO main.{table} SELECT * FROM source.{table} WHERE {where.get(table, '1')}")
        database.commit()


def _compare(job: Job, pairs: list[tuple[int, int]], show: Callable[[int], None]) -> None:
    """Put the matches of learned features into the job's database, which COLMAP's matcher then only verifies."""
    from fieldfuse.poses.xfeat import mutual

    with opened(job.database) as database:
        ids = {int(image.name): image.image_id for image in database.read_all_images()}

        @lru_cache(maxsize=MOST_DESCRIBED)
        def described(index: int) -> Array:
            return floats(database.read_descriptors(ids[index]).data, job.features)

        new = [(i, j) for i, j in pairs if not database.exists_matches(ids[i], ids[j])]
        with ThreadPoolExecutor(job.threads) as pool:
            for done, step in enumerate(_steps(new)):
                show(len(pairs) - len(new) + done * PAIRS_A_STEP)
                found = pool.map(mutual, [described(i) for i, _ in step], [described(j) for _, j in step])
                with pycolmap.DatabaseTransaction(database):
                    for (i, j), matches in zip(step, found, strict=True):
                        database.write_matches(ids[i], ids[j], matches)


def _processes(job: Job) -> int:
    """That match on this machine at the same time."""
    return min(job.threads, MOST_MATCHERS)


def _steps(pairs: list[tuple[int, int]]) -> list[list[tuple[int, int]]]:
    """Pairs that are matched between two progress reports."""
    return [pairs[start : start + PAIRS_A_STEP] for start in range(0, len(pairs), PAIRS_A_STEP)]


def _together(job: Job, pairs: list[tuple[int, int]], show: Callable[[int], None]) -> None:
    """Match in several processes, where there is more than one thread and one step, and room; else nothing. A RuntimeError where one of
    them failed; what the others did stays."""
    steps, done, lock = _steps(pairs), 0, threading.Lock()
    free: SimpleQueue[Path] = SimpleQueue()
    with _copies(job, min(_processes(job), len(steps))) as folders:
        if len(folders) < 2:
            return
        for folder in folders:
            free.put(folder)
        with (
            ProcessPoolExecutor(len(folders), get_context("spawn"), _end_with_parent) as processes,
            ThreadPoolExecutor(len(folders)) as pool,
        ):

            def one(step: list[tuple[int, int]]) -> None:
                nonlocal done
                folder = free.get()
                try:
                    processes.submit(_match, job, folder, step).result()
                    with lock:
                        _bring(folder / job.database.name, job.database, step)
                        show(done := done + len(step))
                finally:
                    free.put(folder)

            try:
                for _ in pool.map(one, steps):
                    pass
            finally:
                pool.shutdown(cancel_futures=True)


def _left(job: Job, pairs: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Those of the pairs that are not both matched and verified."""
    with opened(job.database) as database:
        ids = {int(image.name): image.image_id for image in database.read_all_images()}
        both = (database.exists_matches, database.exists_two_view_geometry)
        return [(i, j) for i, j in pairs if not all(exists(ids[i], ids[j]) for exists in both)]


@contextmanager
def _copies(job: Job, count: int) -> Iterator[list[Path]]:
    """Folders with a copy of the job's database each, `count` of them or as many as there is room for, while the block lasts."""
    place, made = Path(job.folder) / "matching", []
    remove(place)
    try:
        for number in range(min(count, MOST_COPIED // max(1, job.database.stat().st_size)) if count > 1 else 0):
            folder = place / str(number)
            folder.mkdir(parents=True)
            try:
                shutil.copyfile(job.database, folder / job.database.name)
            except OSError:  # no room: those that are there take turns
                remove(folder)
                break
            made.append(folder)
        yield made
    finally:
        remove(place)


def _end_with_parent() -> None:
    """In a process that matches: never outlive the one that started it."""
    parent = parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(3)

    threading.Thread(target=watch, daemon=True).start()


def _match(job: Job, folder: Path, pairs: list[tuple[int, int]]) -> None:
    """COLMAP's matcher on the database in `folder`."""
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = 1
    matching.use_gpu = False
    matching.guided_matching = False
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = job.seed
    verification.ransac.max_error = job.tolerance
    if job.features == XFEAT:
        verification.min_inlier_ratio = LEAST_RATIO
        verification.ransac.max_num_trials = MOST_TRIALS
    pairing = pycolmap.ImportedPairingOptions()
    with atomic_path(folder / "pairs.txt") as listing:
        listing.write_text("".join(f"{label(i)} {label(j)}\n" for i, j in pairs), encoding="utf-8")
        pairing.match_list_path = listing
        pycolmap.match_image_pairs(folder / job.database.name, matching, pairing, verification, pycolmap.Device.cpu)


def _bring(source: Path, target: Path, pairs: list[tuple[int, int]]) -> None:
    """Copy what was found for `pairs` from one database to another with the same images. By COLMAP's own SQLite: two of these libraries in
    one process do not respect each other's locks."""
    with opened(source) as found, opened(target) as database, pycolmap.DatabaseTransaction(database):
        ids = {int(image.name): image.image_id for image in found.read_all_images()}
        for i, j in pairs:
            first, second = ids[i], ids[j]
            if found.exists_matches(first, second) and not database.exists_matches(first, second):
                database.write_matches(first, second, found.read_matches(first, second))
            if found.exists_two_view_geometry(first, second) and not database.exists_two_view_geometry(first, second):
                database.write_two_view_geometry(first, second, found.read_two_view_geometry(first, second))
