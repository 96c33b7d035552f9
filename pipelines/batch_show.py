"""What `fieldfuse batch` shows while runs are at work: a table that renews itself on a terminal, lines elsewhere."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from typing import IO, TYPE_CHECKING, Any

from fieldfuse.evaluation import words
from fieldfuse.pipelines.console import ConsoleProgress

if TYPE_CHECKING:
    from rich.table import Table

ORDER = {"running": 0, "failed": 1, "stopped": 2, "done": 3, "waiting": 4}
COLOURS = {"running": "cyan", "failed": "red", "stopped": "yellow", "done": "green", "waiting": "dim"}
AROUND = 6  # lines of the terminal that are not rows of the table
Row = dict[str, Any]


class Display(ConsoleProgress):
    """Silent, but it listens to Ctrl-C and passes it on; the base of the two that show something."""

    def __init__(self, rows: list[Row], stop: Callable[[], None], stream: IO[str] | None = None) -> None:
        super().__init__(stream)
        self.rows, self._passed_on = rows, stop

    def request_stop(self) -> None:
        super().request_stop()
        self._passed_on()

    def changed(self, row: Row) -> None:
        """A run was begun, or has ended."""


class Lines(Display):
    """A line whenever a run begins or ends."""

    def changed(self, row: Row) -> None:
        self.say(line(row))

    def say(self, text: str) -> None:
        self.stream.write(text + "\n")
        self.stream.flush()


class LiveTable(Display):
    """All runs, those at work first, as many as the terminal has lines for."""

    def __init__(self, rows: list[Row], stop: Callable[[], None], stream: IO[str] | None = None) -> None:
        super().__init__(rows, stop, stream)
        from rich.console import Console
        from rich.live import Live

        self._console = Console(file=self.stream, highlight=False)
        self._live = Live(console=self._console, get_renderable=self._table, refresh_per_second=2)
        self._live.start()

    def _table(self) -> Table:
        from rich import box
        from rich.table import Table
        from rich.text import Text

        out = Table(box=box.SIMPLE_HEAD)
        for name in ("run", "state", "stage", "left", "PSNR", "node"):
            out.add_column(name, overflow="ellipsis", no_wrap=name != "stage", justify="right" if name in ("left", "PSNR") else "left")
        room = max(3, self._console.height - AROUND)
        rows = sorted(self.rows, key=lambda row: ORDER[row["state"]])
        for row in rows[:room]:
            stage = row["error"] or " ".join([row["stage"] or "", "" if row["share"] is None else f"{row['share']}%"])
            cells = [row["name"], Text(row["state"], COLOURS[row["state"]]), stage, row["left"] or "", words.decimal(row["psnr"])]
            out.add_row(*(cell if isinstance(cell, Text) else Text(cell) for cell in [*cells, row["node"] or ""]))
        counts = {state: sum(row["state"] == state for row in rows) for state in ORDER}
        out.caption = ", ".join(f"{count} {state}" for state, count in counts.items() if count)
        return out

    def say(self, text: str) -> None:
        self._console.print(text, markup=False)

    def close(self) -> None:
        self._live.stop()


def line(row: Row) -> str:
    """A run's state in words."""
    place = f" on {row['node']}" if row["node"] else ""
    if row["state"] == "running":
        return f"{row['name']}: begun{place}"
    if row["state"] == "done":
        return f"{row['name']}: {words.decimal(row['psnr'])} dB in {words.duration(row['seconds'])}{place}"
    return f"{row['name']}: {row['state']}{': ' + row['error'] if row['error'] else ''}"


def make_display(rows: list[Row], stop: Callable[[], None], quiet: bool, stream: IO[str] | None = None) -> Display:
    """A table on a terminal, lines elsewhere, nothing with `quiet`."""
    stream = stream or sys.stderr
    if quiet:
        return Display(rows, stop, stream)
    return (LiveTable if stream.isatty() and os.environ.get("TERM") != "dumb" else Lines)(rows, stop, stream)
