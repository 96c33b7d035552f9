"""Stages of a run: each is made once, recorded last, and made again when anything that went into it has changed.

A stage's record `DIR/stages/<name>.json` is written atomically after its outputs, so a run that is killed at any moment
leaves either a finished stage or none. Its key is a hash of all that went in; a stage before it goes in by the identity
of that very result (`made`), so that whatever is made again makes all that follows from it again.
"""

from __future__ import annotations

import os
import threading
import time
import uuid
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any, Generic, TypeVar

import psutil

from fieldfuse import __version__
from fieldfuse.errors import FieldfuseError, InputError
from fieldfuse.files import fingerprint, read_json, remove, write_json
from fieldfuse.memory import give_back
from fieldfuse.pipelines.console import ConsoleProgress
from fieldfuse.pipelines.folder import STAGES, RunFolder

T = TypeVar("T")
BEFORE = ("capture", "frames", "poses", "scaling", "effects", "scene", "keyframes", "views")  # what every result of a run stands on
INTERVAL = 0.2  # seconds between two samples of this process's memory
CHILDREN_EVERY = 3  # samples between two looks at the children, which cost far more


@dataclass(frozen=True)
class Record:
    """What is on disk of a finished stage."""

    name: str
    key: str
    made: str  # identity of this very result
    seconds: float
    peak_memory_mb: float
    outputs: dict[str, int]  # path relative to the run's folder → bytes
    after: dict[str, str]  # stages before it → which of their results went in
    stopped: bool = False  # ended early on request, usable but not complete


@dataclass
class Stage(Generic[T]):
    """One step of a run, with everything that its result depends on.

    Attributes:
        make: does the work. It may raise `Interrupted` and errors of its own.
        save: writes the result, returns the files that the stage consists of.
        load: reads back what `save` wrote; an InputError from it means that the files are damaged.
        inputs: names of the stages before it whose results go in.
        settings: plain data of all else that it depends on.
        version: raised when the stage's code changes what it writes.
    """

    name: str
    make: Callable[[], T]
    save: Callable[[T], Iterable[Path]]
    load: Callable[[], T]
    inputs: Sequence[str] = ()
    settings: Any = None
    version: int = 1

    def key(self, before: dict[str, str]) -> str:
        """Hash of all that goes in; `before`: stages before it → which of their results."""
        return stage_key(self.name, self.settings, before, self.version)

    def reusable(self, record: Record, key: str, trusted: bool) -> bool:
        """Whether a finished result is the one that would be made now (or is taken as it is)."""
        return trusted or (record.key == key and not record.stopped)

    def begin(self, path: Path) -> None:
        """Called before `make`; `path`: of the record of an earlier result, if there is one."""

    def ended_early(self, progress: ConsoleProgress) -> bool:
        """Whether `make` returned early because the user wants to stop, with a result that is worth keeping."""
        return False

    def recorded(self, record: Record, old: Record | None, complete: bool, folder: RunFolder) -> Record:
        """The record to be written, where `old` is the one of the result before, all of whose files were there if it was `complete`."""
        return record

    def result(self, value: T) -> T | None:
        """What later stages get; None: what the files hold."""
        return value


class StoredStage(Stage[T]):
    """Its files hold less precision than memory: the result is what they hold, so that a run that was killed and goes on has the same."""

    def result(self, value: T) -> T | None:
        return None


class InPlaceStage(StoredStage[T]):
    """`make` itself writes into the folder, so an earlier result is gone once it starts."""

    def begin(self, path: Path) -> None:
        remove(path)


class EndlessStage(StoredStage[T]):
    """`make` ends when the user asks to stop, and what it has by then is kept."""

    def ended_early(self, progress: ConsoleProgress) -> bool:
        return progress.stopping()


@dataclass
class CollectingStage(Stage[T]):
    """Files of an earlier result of the same inputs stay beside those that are made now.

    Attributes:
        only_part: a part of the result is wanted, and made whether there is one or not.
        whole: whether `make` made everything. A part is made again when the whole is wanted; added to a whole it leaves it whole.
        renewed: files of an earlier result do not fit those that are made now, and go.
    """

    only_part: bool = False
    whole: bool = True
    renewed: bool = False

    def reusable(self, record: Record, key: str, trusted: bool) -> bool:
        return not self.only_part and super().reusable(record, key, trusted)

    def recorded(self, record: Record, old: Record | None, complete: bool, folder: RunFolder) -> Record:
        outputs, key = record.outputs, record.key
        if old is not None and old.after == record.after and not self.renewed:
            outputs = {path: size for path, size in old.outputs.items() if (folder / path).is_file()} | outputs
        was_whole = old is not None and complete and old.key == key and not old.stopped
        if (self.only_part or not self.whole) and not was_whole:
            key = fingerprint(key, "a part")
        return replace(record, key=key, outputs=outputs)


def stage_key(name: str, settings: Any, before: dict[str, str] | None = None, version: int = 1) -> str:
    """Hash of all that goes into a stage; see `Stage`."""
    return fingerprint(name, version, __version__, settings, before or {})


def read_record(path: Path) -> Record | None:
    """The record at `path`, None when it is not there or not readable."""
    if not path.is_file():
        return None
    try:
        return Record(**read_json(path))
    except (FieldfuseError, TypeError):
        return None


def is_complete(record: Record, folder: RunFolder) -> bool:
    """Whether all files that a record lists are there in the size that was written."""
    paths = {folder / relative: size for relative, size in record.outputs.items()}
    return all(path.is_file() and path.stat().st_size == size for path, size in paths.items())


def finished_stages(folder: RunFolder) -> list[Record]:
    """Records of a run's folder, the oldest first."""
    paths = [path for path in (folder / STAGES).glob("*.json") if not path.name.startswith(".")]
    found = [read_record(path) for path in sorted(paths, key=lambda path: path.stat().st_mtime_ns)]
    return [record for record in found if record is not None]


def outdated(records: Iterable[Record]) -> set[str]:
    """Names of those stages that stand, directly or not, on another result than the one that is there now, or on one that is gone."""
    known = {record.name: record for record in records}
    old: set[str] = set()
    while True:  # what stands on something old is old itself
        more = {
            name
            for name, record in known.items()
            if any(other in old or other not in known or known[other].made != made for other, made in record.after.items())
        }
        if more == old:
            return old
        old = more


class Stages:
    """The stages of one run folder, in the order in which they run."""

    def __init__(self, folder: RunFolder, progress: ConsoleProgress, trusted: Iterable[str] = ()) -> None:
        """Stages named in `trusted` are taken as they are, whatever settings and source are now, if the stages that went into them are the
        same; that others would go into them now does not matter."""
        self.folder = folder
        self.progress = progress
        self.trusted = set(trusted)
        self.records: dict[str, Record] = {}
        self.cached: dict[str, bool] = {}

    def run(self, stage: Stage[T]) -> T:
        """The stage's result: loaded when it is finished and nothing that went in has changed, else made and recorded.

        Raises:
            Interrupted: the user asked to stop.
            FieldfuseError: from the stage itself.
        """
        before = {other: self.records[other].made for other in stage.inputs}
        key = stage.key(before)
        record = self.finished(stage.name)
        trusted = stage.name in self.trusted and self.usable(stage.name)
        if record is not None and stage.reusable(record, key, trusted):
            try:
                value = stage.load()
            except InputError:
                if trusted:
                    raise
            else:
                self._note(record, cached=True)
                return value
        self.progress.check()
        made = self._make(stage, key, before)
        return stage.load() if made is None else made

    def _make(self, stage: Stage[T], key: str, before: dict[str, str]) -> T | None:
        path, old, complete = self._path(stage.name), self.record(stage.name), self.finished(stage.name) is not None
        stage.begin(path)
        self.progress.begin(stage.name)
        start = time.monotonic()
        with PeakMemory() as memory:
            value = stage.make()
            stopped = stage.ended_early(self.progress)
            remove(path)
            files = [Path(file) for file in stage.save(value)]
        give_back()
        for file in files:
            file.chmod(0o666 & ~_umask())  # some writers make files that only their owner may read
        outputs = {file.relative_to(self.folder.path).as_posix(): file.stat().st_size for file in files}
        seconds, peak = round(time.monotonic() - start, 3), round(memory.megabytes, 1)
        record = Record(stage.name, key, uuid.uuid4().hex[:16], seconds, peak, outputs, before, stopped)
        record = stage.recorded(record, old, complete, self.folder)
        write_json(path, asdict(record))
        for gone in set(old.outputs if old else ()) - set(record.outputs):
            remove(self.folder / gone)
        if stopped:
            self.progress.resume()
        self._note(record, cached=False)
        return stage.result(value)

    def _note(self, record: Record, cached: bool) -> None:
        self.records[record.name] = record
        self.cached[record.name] = cached
        self.progress.finish(record.name, record.seconds, cached)

    def _path(self, name: str) -> Path:
        return self.folder / STAGES / f"{name}.json"

    def record(self, name: str) -> Record | None:
        """The stage's record, if there is a readable one."""
        return read_record(self._path(name))

    def finished(self, name: str) -> Record | None:
        """The stage's record, if all its files are there."""
        record = self.record(name)
        return record if record is not None and is_complete(record, self.folder) else None

    def usable(self, name: str) -> bool:
        """True when the stage is finished and stands on the results that this run has."""
        record = self.finished(name)
        return record is not None and all(
            other in self.records and self.records[other].made == made for other, made in record.after.items()
        )

    def done(self, *names: str) -> list[str]:
        """Those of the stages that this run has; `frames`, for one, exists only for videos and HEIF pictures."""
        return [name for name in names if name in self.records]

    def summary(self) -> list[dict[str, Any]]:
        """Entries of the report: name, seconds that making it took, peak memory, and whether it was reused."""
        return [
            {"name": name, "seconds": record.seconds, "peak_memory_mb": record.peak_memory_mb, "cached": self.cached[name]}
            for name, record in self.records.items()
        ]

    def reused_seconds(self) -> float:
        """Seconds of stages that were made earlier and reused now."""
        return sum(record.seconds for name, record in self.records.items() if self.cached[name])

    def stopped(self) -> list[str]:
        """Stages that are incomplete, because the user stopped them."""
        return [name for name, record in self.records.items() if record.stopped]


def _umask() -> int:
    """The process's umask; there is no way to read it without setting it."""
    value = os.umask(0o022)
    os.umask(value)
    return value


class PeakMemory:
    """Memory of this process and of every child that it starts, sampled by a small thread while the context is open.

    Attributes:
        megabytes: largest resident memory, children included; what parent and children share counts once for each of them.
        own: the same without the pages of files, those of libraries first of all.
    """

    def __init__(self) -> None:
        self.megabytes = self.own = 0.0
        self._stop = threading.Event()
        self._process = psutil.Process()
        self._thread = threading.Thread(target=self._watch, name="peak-memory", daemon=True)

    def __enter__(self) -> PeakMemory:
        self._sample()
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._stop.set()
        self._thread.join()
        self._sample()

    def _watch(self) -> None:
        count = 0
        while not self._stop.wait(INTERVAL):
            count += 1
            self._sample(count % CHILDREN_EVERY == 0)

    def _sample(self, children: bool = True) -> None:
        seen = [self._process.memory_info()]
        for child in self._process.children(recursive=True) if children else ():
            try:
                seen.append(child.memory_info())
            except psutil.Error:  # it ended in between
                continue
        self.megabytes = max(self.megabytes, sum(one.rss for one in seen) / 2**20)
        self.own = max(self.own, sum(own_bytes(one) for one in seen) / 2**20)


def own_bytes(found: Any) -> int:
    """Resident bytes of a process, by psutil, that are pages of no file (and of nothing shared), where the system tells them apart."""
    return int(found.rss - getattr(found, "shared", 0))
