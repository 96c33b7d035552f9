"""The child process that runs pycolmap: `python -m fieldfuse.poses.worker job.json`.

COLMAP can abort a process, and its native code cannot be interrupted; here that costs nobody else anything. Messages go to
the parent as JSON lines: `progress` (done, total, note), `step` (name, seconds), `error` (kind, message).
"""

from __future__ import annotations

import ctypes
import json
import os
import signal
import sys
import threading
import time
from pathlib import Path
from typing import IO, Any

PR_SET_PDEATHSIG = 1
PROBE_BYTES = 4 * 2**20
WEIGHTS = {"features": (0.0, 0.3), "matching": (0.3, 0.4), "mapping": (0.7, 0.3)}  # start and share of the whole, for the bar


def die_with_parent() -> None:
    """Never outlive the parent: the kernel's signal on Linux, the end of standard input elsewhere and for good measure."""
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)

    def watch() -> None:
        while os.read(0, 1):  # not sys.stdin: its lock, held here, aborts the interpreter when it ends
            pass
        os._exit(3)

    threading.Thread(target=watch, daemon=True).start()


class Mouth:
    """Speaks to the parent. The real standard output is kept here; file descriptor 1 then leads to the log, whatever C++ prints."""

    def __init__(self) -> None:
        self.pipe: IO[str] = os.fdopen(os.dup(1), "w", buffering=1, encoding="utf-8")
        os.dup2(2, 1)

    def say(self, **message: Any) -> None:
        try:
            self.pipe.write(json.dumps(message) + "\n")
            self.pipe.flush()
        except OSError:
            os._exit(3)  # nobody listens any more

    def progress(self, step: str, done: float, total: float, note: str) -> None:
        start, share = WEIGHTS[step]
        self.say(event="progress", done=100 * (start + share * done / max(total, 1)), total=100, note=note)


def work(job_file: Path, mouth: Mouth) -> None:
    """Extract, match, map; leave everything in the job's folder.

    Raises:
        FieldfuseError: with a sentence for the user.
    """
    from fieldfuse.files import write_json
    from fieldfuse.poses import database as store
    from fieldfuse.poses import mapping
    from fieldfuse.poses.health import hopeless
    from fieldfuse.poses.job import Job
    from fieldfuse.poses.match import match
    from fieldfuse.poses.placing import place
    from fieldfuse.poses.selection import choose_pairs

    job = Job.load(job_file)
    began = time.monotonic()

    def step(name: str) -> None:
        nonlocal began
        mouth.say(event="step", name=name, seconds=time.monotonic() - began)
        began = time.monotonic()

    database = store.open_database(job)
    records = store.extract(job, database, lambda done, total, note: mouth.progress("features", done, total, note))
    facts: dict[str, Any] = {"pictures": records, "pairs": [], "attempts": [], "folded": None, "model": None}
    step("features")
    job, reason = store.tolerant(job, records), hopeless(records)
    pairs = [] if reason else choose_pairs(job, database, lambda done, total, note: mouth.progress("matching", 0, total, note))
    database.close()
    if reason is None or job.second is not None:
        match(job, pairs, lambda done, total, note: mouth.progress("matching", done, total, note))
        step("matching")

        def report(done: float, total: float, note: str) -> None:
            mouth.progress("mapping", done, total, note)

        model, told = place(job, report)
        facts |= told
        if model is not None:
            mapping.finish(job, model, report)
            facts["model"] = mapping.plain(model)
            mapping.save_model(model, [picture.name for picture in job.pictures], Path(job.folder) / "model")
        step("mapping")
    write_json(job.result, facts)


def unwritable(folder: Path) -> str | None:
    """Why a file of the size of a database cannot be written in `folder` now; None when it can."""
    probe = folder / f".probe-{os.getpid()}"
    try:
        with probe.open("wb") as file:
            file.write(b"\0" * PROBE_BYTES)
            file.flush()
            os.fsync(file.fileno())
        return None
    except OSError as error:
        return f"cannot write {folder}: {error.strerror or error}; free space or choose another --out folder"
    finally:
        probe.unlink(missing_ok=True)


def main() -> int:
    die_with_parent()
    mouth = Mouth()
    import cv2

    from fieldfuse.errors import FieldfuseError

    cv2.setNumThreads(1)
    try:
        work(Path(sys.argv[1]), mouth)
    except FieldfuseError as error:
        mouth.say(event="error", kind=type(error).__name__, message=str(error))
    except (OSError, RuntimeError):  # SQLite's and COLMAP's own errors come as RuntimeError, often without their cause
        reason = unwritable(Path(sys.argv[1]).parent)
        if reason is None:
            raise
        mouth.say(event="error", kind="OutputError", message=reason)
    return 0


if __name__ == "__main__":
    sys.exit(main())
