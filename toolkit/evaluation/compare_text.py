"""The comparison's table for the terminal."""

from __future__ import annotations

import io
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from fieldfuse.evaluation.compare import compare_data, matching_line, table

LABELS = 60  # columns for the measures' names
WIDTH = 22  # for each method
NARROW_LABELS, NARROW = 40, 17  # the same on a terminal that is too narrow for these: what is longer is wrapped


def comparison_text(data: dict[str, Any], width: int | None = None) -> str:
    """A column a method, a row a measure; the best of a row has a star. `data` as for `compare_data`.

    With a `width` in characters lines are no longer than that: names are wrapped, and methods that do not fit beside the others follow
    below them.
    """
    data = compare_data(data)
    count = len(data["methods"])
    whole = LABELS + WIDTH * count
    some = count if width is None or width >= whole else max(1, (width - NARROW_LABELS) // NARROW)
    parts = [_part(data, range(first, min(first + some, count)), min(width or whole, whole)) for first in range(0, count, some)]
    text = "\n".join(parts)
    matching = matching_line(data)
    return text if matching is None else f"{text}{matching}\n"


def _part(data: dict[str, Any], methods: range, width: int) -> str:
    """The table of some of the methods."""
    out = Table(box=box.SIMPLE_HEAD)
    out.add_column("", max_width=NARROW_LABELS - 2 if width < LABELS + WIDTH * len(data["methods"]) else None)
    for index in methods:
        out.add_column(Text(data["methods"][index]["title"]), justify="right")
    for title, rows in table(data):
        out.add_row(Text(title, style="bold"))
        for row in rows:
            cells = [row.cells[index] for index in methods]
            out.add_row(Text(f"  {row.label}"), *(f"{cell.text} *" if cell.best else f"{cell.text}  " for cell in cells))
    stream = io.StringIO()
    Console(file=stream, width=width, color_system=None, force_terminal=False).print(out)
    return "\n".join(line.rstrip() for line in stream.getvalue().splitlines()).strip("\n") + "\n"
