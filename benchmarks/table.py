"""`python -m benchmarks.table FILES --into PAGE`: measured numbers put into a Markdown page, so that none of them is typed."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import typer

from benchmarks.experiment import Row, application, checked, portable, program, put_between_marks, section
from benchmarks.run_tables import budget_table, compare_table, is_report, mean_load, run_table, tradeoff_table
from fieldfuse.errors import InputError
from fieldfuse.evaluation.tradeoff import tradeoff_data
from fieldfuse.pipelines import schemas


def table(
    files: Annotated[
        list[Path],
        typer.Argument(help="JSON of a benchmark, tradeoff.json, compare.json; or report.json of runs.", show_default=False),
    ],
    into: Annotated[Path, typer.Option(help="Markdown page; what stands between the table's marks is replaced.", show_default=False)],
    data: Annotated[Path | None, typer.Option(help="Folder of the captures; in commands it is shown as DATA.", show_default=False)] = None,
    name: Annotated[
        str | None, typer.Option(help="Name of the table; default: of the folder that the file lies in.", show_default=False)
    ] = None,
) -> None:
    """Put measured tables into a Markdown page, between marks, so that no number in it is typed."""
    for title, text in sections(files, name, data):
        put_between_marks(into, title, text)


def sections(files: list[Path], name: str | None, data: Path | None) -> list[tuple[str, str]]:
    """What `files` hold, as names and Markdown.

    Raises:
        InputError: a file holds no results, or there is one name for several tables.
    """
    found = [(path, schemas.read_checked(path, Any)) for path in files]
    contents = [content for _, content in found]
    budgets = [content for content in contents if isinstance(content, dict) and isinstance(content.get("budget"), dict)]
    make = budget_table if budgets and len(budgets) == len(found) else run_table if all(map(is_report, contents)) else None
    if make is not None:
        title = name or ("runs" if make is run_table else "total-budget")
        return [(title, checked(files[0], lambda: make(contents, [_command(content, data) for content in contents])))]
    if name is not None and len(found) > 1:
        raise InputError(f"--name {name} is for one table, and {len(found)} files are given; leave it out")
    titles = [name or path.resolve().parent.name for path in files]
    return [
        (title, checked(path, partial(_section, path, content, title, data))) for (path, content), title in zip(found, titles, strict=True)
    ]


def _section(path: Path, content: Any, title: str, data: Path | None) -> str:
    """The Markdown of one file's content."""
    whole: Row = {**content, "command": _command(content, data)}
    if "experiment" in whole:
        return section(whole, _table_of(whole["experiment"]))
    if "methods" in whole:
        return section({**whole, "title": title}, compare_table)
    schemas.checked(content, schemas.Tradeoff, path)
    whole = tradeoff_data({**whole, "rows": list(content["rows"])})
    return section({**whole, "title": title, "machine": mean_load(whole)}, tradeoff_table)


def _table_of(name: str) -> Callable[[Row], str]:
    """The function `table` of a benchmark."""
    if name not in [path.stem for path in Path(__file__).parent.iterdir()]:
        raise LookupError(f"no benchmark {name!r}")
    make: Callable[[Row], str] = import_module(f"benchmarks.{name}").table
    return make


def _command(content: Any, data: Path | None) -> str:
    return portable(str(content["command"]), data and data.resolve())


app = application(table)
if __name__ == "__main__":
    program(app)
