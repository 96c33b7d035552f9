"""What the commands that work on a run have in common: progress on stderr, the result on stdout."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

from fieldfuse.pipelines.options import Options, Place, bound_threads, show

PAGE = "exports/field.html"


def work(
    place: Place,
    options: Options,
    goals: Iterable[str],
    settings: dict[str, Any],
    *,
    go_on: bool = False,
    formats: list[str] | None = None,
    total_budget: float | None = None,
) -> None:
    """Make `goals` (none: camera poses alone) in the run's folder and show the report's numbers; see `reconstruct.reconstruct`."""
    bound_threads(settings)
    from fieldfuse.pipelines.console import make_progress, table_lines
    from fieldfuse.pipelines.job import open_job
    from fieldfuse.pipelines.stages import BEFORE

    with open_job(place, settings, make_progress(options.quiet), BEFORE if goals else BEFORE[:2]) as job:
        from fieldfuse.pipelines.reconstruct import find_poses, reconstruct  # torch and more, for which no refusal waits

        data = reconstruct(job, frozenset(goals), go_on, formats, total_budget) if goals else find_poses(job)

    def lines() -> Iterator[str]:
        yield from table_lines(data)
        yield from (f"note: {warning}" for warning in data.get("warnings", []))
        yield from (str(place.folder / PAGE) for export in data.get("exports", []) if export["path"] == PAGE)
        yield str(place.folder / ("report.html" if data.get("evaluation") else "exports/cameras"))

    show(data, options, lines)
