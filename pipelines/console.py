"""Progress on the terminal, and the user's wish to stop: Ctrl-C once ends the stage cleanly, twice ends at once."""

from __future__ import annotations

import _thread
import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import IO, Any

from fieldfuse.errors import FieldfuseError
from fieldfuse.progress import Progress

AGAIN = 0.02  # seconds until an interrupt that got lost is raised again
PLAIN_EVERY = 10.0  # seconds between two lines where there is no terminal
STOPPING = "stopping: the current stage is brought to an end (Ctrl-C again to quit at once)"


def clock(seconds: float) -> str:
    """`75` → `1:15`."""
    whole = round(seconds)
    if whole >= 3600:
        return f"{whole // 3600}:{whole % 3600 // 60:02d}:{whole % 60:02d}"
    return f"{whole // 60}:{whole % 60:02d}"


class ConsoleProgress(Progress):
    """Silent on the terminal, but it listens: the base of the two that show something."""

    def __init__(self, stream: IO[str] | None = None) -> None:
        self.stream = stream or sys.stderr
        self._stop = threading.Event()
        self._phase = (0.0, 0.0, 0.0, "")  # when it began, done at that time, total, stage
        self.name = ""

    def begin(self, stage: str) -> None:
        """A stage starts."""
        self.name = stage
        self._phase = (time.monotonic(), 0.0, 0.0, stage)

    def finish(self, stage: str, seconds: float, cached: bool) -> None:
        """A stage is finished, or was found finished."""

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Work that is one stage."""
        self.begin(name)
        start = time.monotonic()
        yield
        self.finish(name, time.monotonic() - start, cached=False)

    def say(self, text: str) -> None:
        """A remark of its own line."""

    def close(self) -> None:
        """Leave the terminal as it was."""

    def stopping(self) -> bool:
        return self._stop.is_set()

    def request_stop(self) -> None:
        """What a first Ctrl-C does."""
        self._stop.set()

    def resume(self) -> None:
        """What the user stopped is kept; the short stages after it may run."""
        self._stop.clear()

    def seconds_left(self, done: float, total: float) -> float | None:
        """Estimate from the pace since this count began; None while it is too early to say."""
        began, first, known, stage = self._phase
        now = time.monotonic()
        if total != known or done < first or stage != self.name:
            self._phase = (now, done, total, self.name)
            return None
        if done <= first or now - began < 0.5:
            return None
        return max(0.0, (total - done) * (now - began) / (done - first))

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Turn the first SIGINT or SIGTERM into `stopping()`, the second into KeyboardInterrupt, once Open3D is not just being loaded."""
        signals = 0
        again: list[threading.Timer] = []

        def handler(number: int, frame: FrameType | None) -> None:
            nonlocal signals
            signals += 1
            if signals > 1:
                if not _loading("open3d"):
                    raise KeyboardInterrupt
                later()
                return
            self.request_stop()
            self.say(STOPPING)

        def unraisable(lost: sys.UnraisableHookArgs) -> None:
            # Python drops what is raised in `__del__` and in callbacks of C code; the interrupt is raised again a moment later.
            if signals > 1 and issubclass(lost.exc_type, KeyboardInterrupt):
                later()
            else:
                hook(lost)

        def later() -> None:
            again.append(threading.Timer(AGAIN, _thread.interrupt_main))
            again[-1].daemon = True
            again[-1].start()

        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = {number: signal.signal(number, handler) for number in (signal.SIGINT, signal.SIGTERM)}
        hook, sys.unraisablehook = sys.unraisablehook, unraisable
        try:
            yield
        except FieldfuseError:
            raise
        except Exception as error:
            # A library that is interrupted while it loads answers with an error of its own (Open3D: ImportError).
            if signals > 1:
                raise KeyboardInterrupt from error
            raise
        finally:
            sys.unraisablehook = hook
            for timer in again:
                timer.cancel()
            for number, old in before.items():
                signal.signal(number, old)
            self.close()


def _loading(name: str) -> bool:
    """Whether a library is being imported. Open3D, interrupted then, ends the process with code 1 later on, whatever code it is given:
    what it has allocated by then looks like a leak to it."""
    return getattr(getattr(sys.modules.get(name), "__spec__", None), "_initializing", False)


class PlainProgress(ConsoleProgress):
    """Now and then a line, for log files and pipes."""

    def __init__(self, stream: IO[str] | None = None, every: float = PLAIN_EVERY) -> None:
        super().__init__(stream)
        self.every = every
        self._last = 0.0

    def begin(self, stage: str) -> None:
        super().begin(stage)
        self._last = time.monotonic()

    def update(self, done: float, total: float, note: str = "") -> None:
        left = self.seconds_left(done, total)
        now = time.monotonic()
        if now - self._last < self.every:
            return
        self._last = now
        share = f" {100 * done / total:.0f}%" if total > 0 else ""
        rest = f", {clock(left)} left" if left is not None else ""
        self.say(f"{self.name}{share}{rest}{f', {note}' if note else ''}")

    def finish(self, stage: str, seconds: float, cached: bool) -> None:
        self.say(f"{stage}: {'reused' if cached else f'{seconds:.1f} s'}")

    def say(self, text: str) -> None:
        self.stream.write(text + "\n")
        self.stream.flush()


class RichProgress(ConsoleProgress):
    """One line a stage with a bar and the time left."""

    def __init__(self, stream: IO[str] | None = None) -> None:
        super().__init__(stream)
        from rich.console import Console
        from rich.progress import BarColumn, TaskID, TextColumn
        from rich.progress import Progress as Bars

        self._bars = Bars(
            TextColumn("{task.description:<10}"),
            BarColumn(bar_width=24),
            TextColumn("{task.percentage:>3.0f}%"),
            TextColumn("{task.fields[left]:<14}"),
            TextColumn("{task.fields[note]}", markup=False),
            console=Console(file=self.stream, highlight=False),
            refresh_per_second=5,
        )
        self._task: TaskID | None = None
        self._shown = 0.0

    def begin(self, stage: str) -> None:
        super().begin(stage)
        self._bars.start()
        self._task = self._bars.add_task(stage, total=None, left="", note="")

    def update(self, done: float, total: float, note: str = "") -> None:
        left = self.seconds_left(done, total)
        now = time.monotonic()
        if self._task is None or (now - self._shown < 0.1 and done < total):
            return
        self._shown = now
        self._bars.update(self._task, completed=done, total=total or None, left="" if left is None else f"{clock(left)} left", note=note)

    def finish(self, stage: str, seconds: float, cached: bool) -> None:
        if self._task is None:
            self._bars.start()
            self._task = self._bars.add_task(stage, total=1, left="", note="")
        self._bars.update(self._task, total=1, completed=1, left="reused" if cached else clock(seconds), note="")
        self._task = None

    def say(self, text: str) -> None:
        self._bars.console.print(text, markup=False)

    def close(self) -> None:
        self._bars.stop()


def make_progress(quiet: bool = False, stream: IO[str] | None = None) -> ConsoleProgress:
    """Bars on a terminal, lines elsewhere, nothing with `quiet`."""
    stream = stream or sys.stderr
    if quiet:
        return ConsoleProgress(stream)
    if stream.isatty() and os.environ.get("TERM") != "dumb":
        return RichProgress(stream)
    return PlainProgress(stream)


def table_lines(data: dict[str, Any]) -> Iterator[str]:
    """The report's numbers as one table."""
    from fieldfuse.evaluation.terminal import WIDEST, report_text  # rich and the metrics are needed only here

    yield str(report_text(data, min(columns(sys.stdout) or WIDEST, WIDEST))).rstrip()


def columns(stream: IO[str]) -> int | None:
    """How many characters a line of the terminal has; None where there is no terminal."""
    return shutil.get_terminal_size().columns if stream.isatty() else None
