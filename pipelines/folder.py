"""A run's folder: one command at a time, nothing of anybody else touched, leftovers of a killed run removed."""

from __future__ import annotations

import errno
import fcntl
import os
import re
import shlex
import sys
import traceback
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import IO, Any

from fieldfuse import __version__
from fieldfuse.config import Settings, settings_dict
from fieldfuse.errors import FieldfuseError, InputError, Interrupted, OutputError, first_line
from fieldfuse.files import atomic_path, read_json, remove, require_utf8, write_json

LOCK = ".lock"
RUN = "run.json"
STAGES = "stages"
ERROR_LOG = "error.log"
SUBFOLDERS = (STAGES, "frames", "unpacked", "sparse", "renders", "tsdf", "stereo", "tsdf_stereo", "cells", "compare", "tradeoff", "exports")
FILES = (
    *("capture.json", "plan.json", "poses.json", "effects.json", "scene.json", "keyframes.json", "views.safetensors"),
    *("network.safetensors", "network.json", "direct.safetensors", "preview.png", "field.safetensors", "timeline.json"),
    *("fit_notes.json", "fit_matched.json", "left_out.safetensors", "mesh.ply", "evaluation.json", "report.json", "report.html"),
    *("compare.json", "compare.html", "tradeoff.csv", "tradeoff.json", "tradeoff.html"),
)
BUSY = "another fieldfuse command is working in {}; wait for it to end or choose another --out folder"
FOREIGN = "{} holds {!r} but no fieldfuse run; choose a new or empty --out folder so that nothing of yours is replaced"
TEMPORARY = re.compile(r"\.tmp-\d+-|\.tmp[A-Za-z0-9]{6}$")  # as fieldfuse.files.atomic_path names them, and safetensors its own
WRITE_ERRORS = {errno.ENOSPC, errno.EFBIG, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM, errno.ENOTDIR, errno.EIO}
WRITE_PHRASES = ("no space left", "file too large", "disk quota", "read-only file system", "disk i/o error", "database or disk is full")


def is_run_folder(path: Path) -> bool:
    """True when `path` is a folder that a run has written to."""
    return (path / RUN).is_file()


class RunFolder:
    """The folder of one run, locked for as long as the context is open.

    Raises:
        InputError: its name is not UTF-8.
        OutputError: it cannot be made or written to, belongs to something else, or another command is working in it.
    """

    def __init__(self, path: Path) -> None:
        # One name, without links and "..": what a run keeps of its own files is compared with it. (`Path.resolve` refuses circles.)
        self.path = Path(os.path.realpath(path))
        self._lock: IO[str] | None = None
        self._made: list[Path] = []  # folders that were not there before, the innermost first
        self._held_run = False
        self._before: bytes | None = None  # run.json of the command before

    def __truediv__(self, name: str) -> Path:
        return self.path / name

    def __enter__(self) -> RunFolder:
        require_utf8(self.path)
        try:
            self._made = [place for place in (self.path, *self.path.parents) if not place.exists()]
            self.path.mkdir(parents=True, exist_ok=True)
            self._lock = (self.path / LOCK).open("a", encoding="utf-8")
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._held_run = is_run_folder(self.path)
            if not self._held_run and (foreign := self._results()):  # of the same names, but without a run: somebody's data
                self._unlock()
                remove(self.path / LOCK)
                raise OutputError(FOREIGN.format(self.path, foreign[0]))
            self._remove_leftovers()
            remove(self.path / ERROR_LOG)
        except OSError as error:
            self._unlock()
            if isinstance(error, BlockingIOError):
                raise OutputError(BUSY.format(self.path)) from error
            reason = error.strerror or error
            raise OutputError(f"cannot write to {self.path}: {reason}; make it writable, or choose another --out folder") from error
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        try:
            if isinstance(error, Exception) and not isinstance(error, FieldfuseError):
                if failed_write(error):
                    raise OutputError(
                        f"cannot write to {self.path}: {first_line(error)}; free space or choose another --out folder"
                    ) from error
                self._log(error)
        finally:
            if isinstance(error, InputError):
                self._take_back()
            self._unlock()

    def _take_back(self) -> None:
        """Remove what marks the folder as a run's, and folders made for it, where the input was refused before anything was written."""
        if self._held_run:
            return
        with suppress(OSError):  # the refusal is what matters
            if not self._results():
                remove(self.path / RUN)
                remove(self.path / LOCK)
                for place in self._made:
                    place.rmdir()  # never one that holds something

    def _results(self) -> list[str]:
        """Names of a run's files and folders that are there, `run.json` aside."""
        return [name for name in (*SUBFOLDERS, *FILES) if (self.path / name).exists()]

    def _unlock(self) -> None:
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def _remove_leftovers(self) -> None:
        """Half-written files of a run that was killed; only below our own folders."""
        places = [self.path, *(place for name in SUBFOLDERS for place in [self.path / name, *(self.path / name).glob("**/")])]
        for place in places:
            for leftover in place.glob(".tmp*"):
                if TEMPORARY.match(leftover.name):
                    remove(leftover)

    def _log(self, error: Exception) -> None:
        """Keep the traceback of something unexpected in the folder; the terminal gets a sentence."""
        try:
            text = "".join(traceback.format_exception(error))
            (self.path / ERROR_LOG).write_text(f"fieldfuse {__version__}\n{command_line()}\n\n{text}", encoding="utf-8")
        except OSError:
            return
        error.__dict__["fieldfuse_log"] = str(self.path / ERROR_LOG)

    def start(self, source: Path, settings: Settings) -> None:
        """Write run.json: what is run with what. Written before anything else, so that the folder is known as ours."""
        self._before = (self.path / RUN).read_bytes() if is_run_folder(self.path) else None
        write_json(
            self.path / RUN,
            {
                "version": __version__,
                "command": command_line(),
                "source": str(source),
                "started": datetime.now(UTC).isoformat(timespec="seconds"),
                "settings": settings_dict(settings),
            },
        )

    def restore(self) -> None:
        """Write run.json as it was before `start`, for a command that is refused before it has changed anything."""
        if self._before is not None:
            with atomic_path(self.path / RUN) as temporary:
                temporary.write_bytes(self._before)

    def about(self) -> dict[str, Any]:
        """The content of run.json.

        Raises:
            InputError: the folder holds no run, or its run.json is damaged.
        """
        if not is_run_folder(self.path):
            raise InputError(
                f"{self.path} is not the folder of a run (it has no {RUN}); make one with `fieldfuse run SOURCE --out {self.path}`"
            )
        data = read_json(self.path / RUN)
        if not isinstance(data, dict) or not isinstance(data.get("source"), str) or not isinstance(data.get("settings"), dict):
            raise InputError(f"{self.path / RUN} is damaged; run `fieldfuse run SOURCE --out {self.path}` again")
        return data


def command_line() -> str:
    """The command as it was typed, to be repeated by copying it."""
    script = Path(sys.argv[0])
    program = ["python", "-m", f"benchmarks.{script.stem}"] if script.parent.name == "benchmarks" else ["fieldfuse"]
    return shlex.join([*program, *sys.argv[1:]])


def failed_write(error: Exception) -> bool:
    """True for a full disk or a folder that may not be written, however a library words it."""
    if isinstance(error, Interrupted):
        return False
    if isinstance(error, OSError) and error.errno in WRITE_ERRORS:
        return True
    return any(phrase in str(error).lower() for phrase in WRITE_PHRASES)
