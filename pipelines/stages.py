"""Stages of a run: each is made once, recorded last, and made again when anything that went into it has changed.

A stage's record `DIR/stages/<name>.json` is written atomically after its outputs, so a run that is killed at any moment
leaves either a finished stage or none. Its key is a hash of all that went in; a stage before it goes in by the identity
of that very result (`made`), so that whatever is made again makes all that follows from it again.
"""

from __future__ import annotations

import os
import time
import uuid
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar

from fieldfuse import __version__
from fieldfuse.errors import FieldfuseError, InputError
from fieldfuse.files import fingerprint, read_json, remove, write_json
from fieldfuse.memory import give_back
from fieldfuse.pipelines.console import ConsoleProgress
from fieldfuse.pipelines.folder import STAGES, RunFolder
from fieldfuse.pipelines.memory import PeakMemory

T = TypeVar("T")


@dataclass(frozen=True)
class Record:
    """What is kept of a finished stage."""

    name: str
    key: str
    made: str  # identity of this very result
    seconds: float
    peak_memory_mb: float
    outputs: dict[str, int]  # path relative to the run's folder → bytes
    after: dict[str, str]  # stages before it → which of their results went in
    stopped: bool = False  # ended early on request, usable but not what was asked for


def _umask() -> int:
    """The process's umask; there is no way to ask for it without setting it."""
    value = os.umask(0o022)
    os.umask(value)
    return value


def read_record(path: Path) -> Record | None:
    """The record at `path`, None when it is not there or not readable."""
    if not path.is_file():
        return None
    try:
        return Record(**read_json(path))
    except (FieldfuseError, TypeError):
        return None


def finished_stages(folder: RunFolder) -> list[Record]:
    """Records of a run's folder, the oldest first."""
    paths = [path for path in (folder / STAGES).glob("*.json") if not path.name.startswith(".")]
    found = [read_record(path) for path in sorted(paths, key=lambda path: path.stat().st_mtime_ns)]
    return [record for record in found if record is not None]


def stage_key(name: str, uses: Any, before: dict[str, str] | None = None, version: int = 1) -> str:
    """Hash of all that goes into a stage; `before`: results of stages before it, by their identities."""
    return fingerprint(name, version, __version__, uses, before or {})


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
    """The stages of one run folder, in the order in which they are asked for."""

    def __init__(self, folder: RunFolder, progress: ConsoleProgress, trusted: Iterable[str] = ()) -> None:
        """Stages named in `trusted` are taken as they are, whatever settings and source say now, if the stages that went into them are the
        same; that others would go into them now does not matter."""
        self.folder = folder
        self.progress = progress
        self.trusted = set(trusted)
        self.records: dict[str, Record] = {}
        self.cached: dict[str, bool] = {}

    def run(
        self,
        name: str,
        make: Callable[[], T],
        save: Callable[[T], Iterable[Path]],
        load: Callable[[], T],
        *,
        uses: Any = None,
        after: Sequence[str] = (),
        version: int = 1,
        in_place: bool = False,
        keeps: bool = False,
        rounded: bool = False,
        adds: bool = False,
        part: bool = False,
        whole: Callable[[], bool] = lambda: True,
    ) -> T:
        """The stage's result: loaded when it is finished and nothing that went in has changed, else made and recorded.

        Args:
            make: does the work.
            save: writes the result, returns the files that the stage consists of.
            load: reads back what `save` wrote; an InputError from it means that the files are damaged.
            uses: plain data of all that the stage depends on besides the stages `after`.
            version: raised when the stage's code changes what it writes.
            in_place: `make` itself writes into the folder, so an older result is gone once it starts.
            keeps: `make` may return early when the user asks to stop; what it has is kept.
            adds: files of the result before that are not written again stay, as long as the stages `after` are still the same.
            part: `make` makes only a part of the result, whether there is one or not.
            whole: asked when `make` is done: whether it made all that it was asked for. A part that is added to a whole leaves it whole;
                else it is made again when the whole is asked for.
            rounded: the files hold less precision than memory: the result is what they hold, so that a run that was killed later and
                goes on has the same one.

        Raises:
            Interrupted: the user asked to stop.
            FieldfuseError: from the stage itself.
        """
        before = {other: self.records[other].made for other in after}
        key = stage_key(name, uses, before, version)
        record = self.finished(name)
        trusted = record is not None and name in self.trusted and self.usable(name)
        if record is not None and not part and (trusted or (record.key == key and not record.stopped)):
            try:
                value = load()
            except InputError:
                if trusted:
                    raise
            else:
                self._note(record, cached=True)
                return value
        self.progress.check()
        value = self._make(name, key, before, make, save, in_place, keeps, adds, lambda: not part and whole())
        return load() if rounded else value

    def _make(
        self,
        name: str,
        key: str,
        before: dict[str, str],
        make: Callable[[], T],
        save: Callable[[T], Iterable[Path]],
        in_place: bool,
        keeps: bool,
        adds: bool,
        whole: Callable[[], bool],
    ) -> T:
        old = self.record(name)
        had_all = adds and (finished := self.finished(name)) is not None and finished.key == key and not finished.stopped
        if in_place:
            remove(self._path(name))
        self.progress.begin(name)
        start = time.monotonic()
        with PeakMemory() as memory:
            value = make()
            stopped = keeps and self.progress.stopping()
            remove(self._path(name))
            paths = [Path(path) for path in save(value)]
        give_back()
        for path in paths:
            path.chmod(0o666 & ~_umask())  # some writers make files that only their owner may read
        outputs = {path.relative_to(self.folder.path).as_posix(): path.stat().st_size for path in paths}
        if adds and old and old.after == before:
            outputs = {path: size for path, size in old.outputs.items() if (self.folder / path).is_file()} | outputs
        if not whole() and not had_all:
            key = fingerprint(key, "a part")
        record = Record(
            name, key, uuid.uuid4().hex[:16], round(time.monotonic() - start, 3), round(memory.megabytes, 1), outputs, before, stopped
        )
        write_json(self._path(name), asdict(record))
        for gone in set(old.outputs if old else ()) - set(outputs):
            remove(self.folder / gone)
        if stopped:
            self.progress.resume()
        self._note(record, cached=False)
        return value

    def _note(self, record: Record, cached: bool) -> None:
        self.records[record.name] = record
        self.cached[record.name] = cached
        self.progress.finish(record.name, record.seconds, cached)

    def _path(self, name: str) -> Path:
        return self.folder / STAGES / f"{name}.json"

    def record(self, name: str) -> Record | None:
        """The stage's record, if there is a readable one."""
        return read_record(self._path(name))

    def trust(self, names: Iterable[str]) -> None:
        """Take these stages, too, as they are."""
        self.trusted.update(names)

    def usable(self, name: str) -> bool:
        """True when the stage is finished and stands on the results that this run has."""
        record = self.finished(name)
        return record is not None and all(
            other in self.records and self.records[other].made == made for other, made in record.after.items()
        )

    def finished(self, name: str) -> Record | None:
        """The stage's record, if all files that it lists are there in the size that was written."""
        record = self.record(name)
        if record is None:
            return None
        for relative, size in record.outputs.items():
            path = self.folder / relative
            if not path.is_file() or path.stat().st_size != size:
                return None
        return record

    def summary(self) -> list[dict[str, Any]]:
        """Entries of the report: name, seconds that making it took, peak memory, and whether it was reused."""
        return [
            {"name": name, "seconds": record.seconds, "peak_memory_mb": record.peak_memory_mb, "cached": self.cached[name]}
            for name, record in self.records.items()
        ]

    def fresh_seconds(self) -> float:
        """Seconds of stages that were made earlier and reused now."""
        return sum(record.seconds for name, record in self.records.items() if self.cached[name])

    def stopped(self) -> list[str]:
        """Stages that hold less than what was asked for, because the user stopped them."""
        return [name for name, record in self.records.items() if record.stopped]
