"""A child process that may abort, hang or outlive us: started, listened to, and always cleaned up; both sides of it.

The child speaks JSON lines on its standard output; everything else that it (or a C++ library in it) writes goes to a log
file. Its standard input is a pipe that we hold open: when it closes, the child ends.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import math
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any

from fieldfuse.errors import PoseError
from fieldfuse.progress import SILENT, Progress

PR_SET_PDEATHSIG = 1
TICK = 0.2  # seconds between looks at whether the user stopped the run
SILENCE = 1800.0  # seconds without a word from the child after which it counts as hung
REPEATED = 60.0  # seconds between two reports that it is still at work
LOG_TAIL = 200  # lines of the log that are looked at for the reason of a crash


def run_child(
    module: str,
    arguments: list[str],
    log: Path,
    on_message: Callable[[dict[str, Any]], None],
    progress: Progress = SILENT,
    environment: dict[str, str] | None = None,
    silence: float = SILENCE,
) -> None:
    """Run `python -m module arguments` to its end, passing on each JSON line.

    Raises:
        PoseError: it died by a signal, left with an error, or stayed silent for `silence` seconds. Names the log.
        Interrupted: the user asked to stop; the child is dead by then.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("ab") as log_file:
        process = _start(["-m", module, *arguments], subprocess.PIPE, log_file, {**import_path(), **(environment or {})})
    try:
        _listen(process, log, on_message, progress, silence)
    finally:
        end(process)
    if process.returncode != 0:
        raise PoseError(f"the process that finds poses {end_reason(process.returncode)}; the last line of {log} is: {log_tail(log)}")


def run_logged(
    arguments: list[str],
    log: Path,
    tick: Callable[[float], None],
    longest: float = math.inf,
    environment: dict[str, str] | None = None,
    interrupt: Callable[[], bool] = lambda: False,
) -> int:
    """Run `python arguments` to its end; all that it writes goes to `log`.

    Args:
        tick: called again and again with the seconds that have passed; what it raises ends the child.
        interrupt: once it is true, the child gets one Ctrl-C.

    Returns:
        the exit code, negative for a signal.

    Raises:
        TimeoutError: it was ended after `longest` seconds.
    """
    with log.open("wb") as written:
        process = _start(arguments, written, written, environment or {})
    start, interrupted = time.monotonic(), False
    try:
        while process.poll() is None:
            seconds = time.monotonic() - start
            if seconds > longest:
                raise TimeoutError(f"it took longer than {longest:g} s and was ended")
            tick(seconds)
            if not interrupted and interrupt():
                interrupted = True
                process.send_signal(signal.SIGINT)
            time.sleep(TICK)
    finally:
        end(process)
    return int(process.returncode)


def _start(arguments: list[str], out: int | IO[bytes], errors: IO[bytes], environment: dict[str, str]) -> subprocess.Popen[bytes]:
    """Python with `arguments`. Its standard input is a pipe: the child ends when it closes."""
    command, env = [sys.executable, *arguments], {**os.environ, **environment}
    # In a session of its own Ctrl-C reaches us first, and we decide what the child does.
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=out, stderr=errors, env=env, start_new_session=True)


def end(process: subprocess.Popen[bytes]) -> None:
    """Make sure that `process` and what it started are gone."""
    if process.poll() is None:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
    for stream in (process.stdin, process.stdout):
        if stream is not None:
            with contextlib.suppress(OSError):
                stream.close()
    process.wait()


def log_tail(log: Path) -> str:
    """The last line of the log that is not part of a stack trace, cut to a sentence's length."""
    try:
        lines = [line.strip() for line in log.read_text(encoding="utf-8", errors="replace").splitlines()[-LOG_TAIL:] if line.strip()]
    except OSError:
        lines = []
    reasons = [line for line in lines if not line.startswith(("@", "***", "PC:"))] or lines
    return reasons[-1][-300:] if reasons else "(empty)"


def import_path() -> dict[str, str]:
    """So that the child finds this package where it is imported from a folder that only the parent's `sys.path` has."""
    package = Path(__file__).absolute().parents[1]
    if package.name != "fieldfuse":  # an editable install, which every Python of this environment finds
        return {}
    inherited = os.environ.get("PYTHONPATH")
    return {"PYTHONPATH": str(package.parent) if not inherited else os.pathsep.join([str(package.parent), inherited])}


def end_reason(code: int) -> str:
    """How a process ended, from its exit code."""
    if code >= 0:
        return f"failed with exit code {code}"
    try:
        return f"was ended by the signal {signal.Signals(-code).name}"
    except ValueError:
        return f"was ended by signal {-code}"


def _listen(
    process: subprocess.Popen[bytes], log: Path, on_message: Callable[[dict[str, Any]], None], progress: Progress, silence: float
) -> None:
    lines: queue.Queue[bytes | None] = queue.Queue()
    assert process.stdout is not None
    out = process.stdout

    def pump() -> None:
        with contextlib.suppress(OSError, ValueError):
            for line in out:
                lines.put(line)
        lines.put(None)

    threading.Thread(target=pump, daemon=True).start()
    last = time.monotonic()
    while True:
        progress.check()
        try:
            line = lines.get(timeout=TICK)
        except queue.Empty:
            if time.monotonic() - last > silence:
                raise PoseError(f"the process that finds poses said nothing for {silence:.0f} seconds and was ended; see {log}") from None
            continue
        last = time.monotonic()
        if line is None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(timeout=30)
            return
        with contextlib.suppress(json.JSONDecodeError):
            message = json.loads(line)
            if isinstance(message, dict):
                on_message(message)


# ------------------------------------------------------------------------------------------------- in the child


def die_with_parent() -> None:
    """Never outlive the parent: the kernel's signal on Linux, the end of standard input elsewhere and for good measure."""
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)

    def watch() -> None:
        while os.read(0, 1):  # not sys.stdin: its lock, held here, aborts the interpreter when it ends
            pass
        os._exit(3)

    threading.Thread(target=watch, daemon=True).start()


@contextlib.contextmanager
def alive(say: Callable[[], None]) -> Iterator[None]:
    """Say something now and every minute while a block is at work that may be silent for longer than `SILENCE`."""
    done = threading.Event()

    def repeat() -> None:
        while not done.wait(REPEATED):
            say()

    say()
    thread = threading.Thread(target=repeat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


class Messages:
    """To the parent. The real standard output is held here; file descriptor 1 then leads to the log, whatever C++ prints."""

    def __init__(self) -> None:
        self.pipe: IO[str] = os.fdopen(os.dup(1), "w", buffering=1, encoding="utf-8")
        os.dup2(2, 1)

    def send(self, **message: Any) -> None:
        try:
            self.pipe.write(json.dumps(message) + "\n")
            self.pipe.flush()
        except OSError:
            os._exit(3)  # nobody listens any more
