"""Progress lines, time left, and what Ctrl-C does."""

from __future__ import annotations

import io
import os
import re
import signal
import sys
import time
from types import SimpleNamespace

import pytest

from fieldfuse.pipelines.console import ConsoleProgress, PlainProgress, RichProgress, clock, make_progress
from fieldfuse.pipelines.info import for_people, show_effects


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_clock() -> None:
    assert [clock(seconds) for seconds in (0, 59.6, 75, 3725)] == ["0:00", "1:00", "1:15", "1:02:05"]


def test_choice_of_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    assert type(make_progress(quiet=True, stream=Terminal())) is ConsoleProgress
    assert type(make_progress(stream=io.StringIO())) is PlainProgress
    assert type(make_progress(stream=Terminal())) is RichProgress


def test_time_left_follows_the_pace_of_this_count() -> None:
    progress = ConsoleProgress()
    progress.begin("fit")
    assert progress.seconds_left(0, 10) is None
    time.sleep(0.6)
    left = progress.seconds_left(5, 10)
    assert left is not None and 0.4 < left < 1.5
    assert progress.seconds_left(1, 400) is None  # another count began


def test_plain_lines_now_and_then() -> None:
    stream = io.StringIO()
    progress = PlainProgress(stream, every=0.05)
    progress.begin("poses")
    for done in range(20):
        progress.update(done, 20, "matching")
        time.sleep(0.01)
    progress.finish("poses", 12.34, cached=False)
    progress.finish("views", 3.0, cached=True)
    lines = stream.getvalue().splitlines()
    assert lines[-2:] == ["poses: 12.3 s", "views: reused"]
    assert 1 <= len(lines) - 2 <= 6
    assert lines[0].startswith("poses ") and "%" in lines[0] and lines[0].endswith("matching")


def test_bars_show_stage_share_and_note() -> None:
    stream = Terminal()
    progress = RichProgress(stream)
    with progress.listening():
        progress.finish("capture", 1.0, cached=True)
        progress.begin("field")
        progress.update(5, 10, "level 2")
        progress.finish("field", 65.0, cached=False)
    text = stream.getvalue()
    assert "capture" in text and "reused" in text and "field" in text and "1:05" in text


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_first_signal_asks_second_ends(number: int) -> None:
    before = signal.getsignal(number)
    progress = PlainProgress(io.StringIO())
    with pytest.raises(KeyboardInterrupt), progress.listening():
        os.kill(os.getpid(), number)
        assert progress.stopping()
        os.kill(os.getpid(), number)
        time.sleep(0.1)
    assert signal.getsignal(number) is before
    assert isinstance(progress.stream, io.StringIO) and "stopping" in progress.stream.getvalue()


@pytest.mark.parametrize(("signals", "expected"), [(1, ImportError), (2, KeyboardInterrupt)])
def test_a_library_that_hides_the_second_signal_does_not_make_it_an_error(signals: int, expected: type[BaseException]) -> None:
    def load() -> None:
        try:
            for _ in range(signals):
                signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            raise ImportError("initialization failed") from None
        raise ImportError("no such library")

    with pytest.raises(expected), ConsoleProgress().listening():
        load()


def test_a_second_signal_waits_while_open3d_is_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Half of it would end the process with another code than it is given."""
    half = SimpleNamespace(__spec__=SimpleNamespace(_initializing=True))
    monkeypatch.setitem(sys.modules, "open3d", half)
    loaded = False
    with pytest.raises(KeyboardInterrupt), ConsoleProgress().listening():
        for _ in range(2):
            signal.raise_signal(signal.SIGINT)
        time.sleep(0.1)
        half.__spec__._initializing, loaded = False, True
        for _ in range(500):
            time.sleep(0.01)
    assert loaded


def test_a_second_signal_that_is_lost_in_del_still_ends(capsys: pytest.CaptureFixture[str]) -> None:
    """Python reports what is raised in `__del__` and goes on: numba frees its compilers that way, while a fit begins."""

    class Freed:
        def __del__(self) -> None:
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)
            time.sleep(0)  # where the handler runs at the latest

    hook = sys.unraisablehook
    progress = PlainProgress(io.StringIO())
    with pytest.raises(KeyboardInterrupt), progress.listening():
        Freed()
        for _ in range(500):
            time.sleep(0.01)
    assert progress.stopping() and sys.unraisablehook is hook
    assert "Traceback" not in capsys.readouterr().err


def test_other_errors_in_del_are_told_as_ever() -> None:
    class Freed:
        def __del__(self) -> None:
            raise ValueError("bad")

    told: list[type[BaseException]] = []
    hook, sys.unraisablehook = sys.unraisablehook, lambda lost: told.append(lost.exc_type)
    try:
        with ConsoleProgress().listening():
            Freed()
    finally:
        sys.unraisablehook = hook
    assert told == [ValueError]


def test_evidence_of_effects_stands_below_the_table_where_lines_are_short(monkeypatch: pytest.MonkeyPatch) -> None:
    reason = "points that pictures share are 0.64% of their depth off the sensor's, 0.62% with a depth camera that stands beside"
    held = {"before": 0.0064, "after": 0.0062, "unit": "of depth"}
    entry = {"effect": "depth_offset", "there": False, "number": 0.02, "threshold": 0.12, "held_out": held, "reason": reason}
    for columns, lines in ((80, 6), (200, 3)):
        monkeypatch.setattr("sys.stdout", terminal := Terminal())
        monkeypatch.setenv("COLUMNS", str(columns))
        monkeypatch.setenv("NO_COLOR", "1")
        show_effects({"effects": [entry], "looked_at": {"frames": 3, "points": 9}, "seconds": 1.0})
        shown = re.sub(r"\x1b\[[0-9;]*m", "", terminal.getvalue()).strip()
        assert reason in " ".join(shown.split()) and "0.0064 → 0.0062 of depth" in shown
        assert len([line for line in shown.splitlines() if line.strip()]) <= lines


def test_scores_have_as_many_digits_as_in_the_report() -> None:
    score = {"views": 3, "psnr": 22.841526, "ssim": 0.8804669, "lpips": 0.0859564}
    assert for_people({"scores": {"nearest_image": score}})["scores"] == ["nearest image: views 3, PSNR 22.84 dB, SSIM 0.880, LPIPS 0.086"]
