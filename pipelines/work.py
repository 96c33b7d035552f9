"""What the commands that work on a run have in common: progress on stderr, the result on stdout."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

from fieldfuse.pipelines.options import Options, Place, bound_threads, show

PAGE = "exports/field.html"


def work(place: Place, options: Options, goals: Iterable[str], settings: dict[str, Any], **how: Any) -> None:
    """Make `goals` in the run's folder and show the report's numbers; `how`: as `fieldfuse.pipelines.reconstruct.run_job` takes it."""
    bound_threads(settings)
    from fieldfuse.pipelines.console import make_progress, table_lines
    from fieldfuse.pipelines.reconstruct import run_job

    data = run_job(place, settings, goals, make_progress(options.quiet), **how)

    def lines() -> Iterator[str]:
        yield from table_lines(data)
        yield from (f"note: {warning}" for warning in data.get("warnings", []))
        yield from (str(place.folder / PAGE) for export in data.get("exports", []) if export["path"] == PAGE)
        yield str(place.folder / ("report.html" if data.get("evaluation") else "exports/cameras"))

    show(data, options, lines)
