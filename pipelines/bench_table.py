"""`fieldfuse bench table FILES --into PAGE`: measured numbers put into a Markdown page, so that none of them is typed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

Files = Annotated[
    list[Path],
    typer.Argument(help="results.json, tradeoff.json, compare.json; or report.json of runs.", show_default=False),
]


def table(
    files: Files,
    into: Annotated[Path, typer.Option(help="Markdown page; what stands between the table's marks is replaced.", show_default=False)],
    data: Annotated[Path | None, typer.Option(help="Folder of the captures; in commands it is shown as DATA.", show_default=False)] = None,
    name: Annotated[
        str | None, typer.Option(help="Name of the table; default: of the folder that the file lies in.", show_default=False)
    ] = None,
) -> None:
    """Put measured tables into a Markdown page, between marks, so that no number in it is typed."""
    from fieldfuse.evaluation.suites.tables import put_between_marks

    for title, text in sections(files, name, data):
        put_between_marks(into, title, text)


def sections(files: list[Path], name: str | None, data: Path | None) -> list[tuple[str, str]]:
    """What `files` hold, as names and Markdown.

    Raises:
        InputError: a file holds no results, or there is one name for several tables.
    """
    from fieldfuse.errors import InputError
    from fieldfuse.evaluation.run_table import is_report, run_table
    from fieldfuse.pipelines.kept import ANY, read_kept

    held = [(path, read_kept(path, ANY)) for path in files]
    planned = [found for _, found in held if isinstance(found, dict) and isinstance(found.get("budget"), dict)]
    if planned and len(planned) == len(held):
        from fieldfuse.evaluation.budget_table import budget_table

        return [(name or "total-budget", _whole(files[0], lambda: budget_table(planned, _commands(planned, data))))]
    if all(is_report(found) for _, found in held):
        runs = [found for _, found in held]
        return [(name or "runs", _whole(files[0], lambda: run_table(runs, _commands(runs, data))))]
    if name is not None and len(held) > 1:
        raise InputError(f"--name {name} is for one table, and {len(held)} files are given; leave it out")
    out = []
    for path, found in held:
        title = name or path.resolve().parent.name
        out.append((title, _whole(path, lambda path=path, found=found, title=title: _table(path, found, title, data))))
    return out


def _table(path: Path, measured: Any, title: str, data: Path | None) -> str:
    """The Markdown of one file's content."""
    from fieldfuse.evaluation.captures_table import captures_table
    from fieldfuse.evaluation.compare_table import compare_table
    from fieldfuse.evaluation.suites import suite_of
    from fieldfuse.evaluation.suites.tables import suite_table
    from fieldfuse.evaluation.tradeoff_page import tradeoff_data
    from fieldfuse.evaluation.tradeoff_table import tradeoff_table
    from fieldfuse.pipelines.kept import TRADEOFF, fitting

    found = {**measured, "command": _commands([measured], data)[0]}
    if "methods" in found:
        return compare_table(found, title)
    if "captures" in found:
        return captures_table(found)
    found["rows"] = list(measured["rows"])
    if "suite" in found:
        return suite_table(suite_of(found["suite"]), found)
    fitting(measured, TRADEOFF, path)
    return tradeoff_table(tradeoff_data(found), title)


def _commands(measured: list[Any], data: Path | None) -> list[str]:
    from fieldfuse.evaluation.suites.tables import portable

    return [portable(str(one["command"]), data and data.resolve()) for one in measured]


def _whole(path: Path, make: Any) -> str:
    """The text; a file of another form is refused.

    Raises:
        InputError: it does not hold measurements.
    """
    from fieldfuse.errors import InputError, first_line

    try:
        return str(make())
    except (LookupError, TypeError, AttributeError, ValueError, ArithmeticError) as error:
        raise InputError(
            f"{path} holds no results of a benchmark or a trade-off ({first_line(error)}); give results.json, tradeoff.json or compare.json"
        ) from error
