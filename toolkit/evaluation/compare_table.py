"""A comparison of methods as a section of Markdown: every measure a row, every method a column, the best marked."""

from __future__ import annotations

from typing import Any

from fieldfuse.evaluation.compare import compare_data, matching_line, table
from fieldfuse.evaluation.suites.tables import machine_line


def compare_table(data: dict[str, Any], name: str) -> str:
    """A section of Markdown. `data` as `compare.json` holds it."""
    data = compare_data(data)
    titles = [method["title"] for method in data["methods"]]
    lines = [f"### {name}", "", machine_line(data["machine"]), "", f"    {data['command']}", ""]
    lines += ["| " + " | ".join(["", *titles]) + " |", "| " + " | ".join(["---"] * (len(titles) + 1)) + " |"]
    for group, rows in table(data):
        lines.append("| " + " | ".join([f"**{group}**", *[""] * len(titles)]) + " |")
        for row in rows:
            cells = [f"**{cell.text}**" if cell.best else cell.text for cell in row.cells]
            lines.append("| " + " | ".join([f"{row.label} ({row.note})" if row.note else row.label, *cells]) + " |")
    matching = matching_line(data)
    return "\n".join([*lines, *(["", matching] if matching is not None else [])]) + "\n"
