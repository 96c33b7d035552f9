"""The comparison's table for the terminal."""

from __future__ import annotations

import io
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from toolkit.evaluate.compare import compare_data, matching_line, table

LABELS = 60  # columns for the measures' names
WIDTH = 22  # for each method


def comparison_text(data: dict[str, Any]) -> str:
    """A column a method, a row a measure; the best of a row has a star. `data` as for `compare_data`."""
    data = compare_data(data)
    out = Table(box=box.SIMPLE_HEAD)
    out.add_column("", no_wrap=True)
    for method in data["methods"]:
        out.add_column(Text(method["title"]), justify="right")
    for title, rows in table(data):
        out.add_row(Text(title, style="bold"))
        for row in rows:
            out.add_row(Text(f"  {row.label}"), *(f"{cell.text} *" if cell.best else f"{cell.text}  " for cell in row.cells))
    stream = io.StringIO()
    width = LABELS + WIDTH * len(data["methods"])
    Console(file=stream, width=width, color_system=None, force_terminal=False).print(out)
    text = "\n".join(line.rstrip() for line in stream.getvalue().splitlines()).strip("\n") + "\n"
    matching = matching_line(data)
    return text if matching is None else f"{text}{matching}\n"
