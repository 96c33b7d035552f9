"""What the commands that work on a run have in common: progress on stderr, the result on stdout."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from fieldfuse.pipelines.console import make_progress, show_table

PAGE = "exports/field.html"  # the field to walk through


def work(
    target: Path,
    out: Path | None,
    options: dict[str, Any],
    goals: Iterable[str],
    *,
    quiet: bool,
    as_json: bool,
    trusted: Iterable[str] | None = None,
    go_on: bool = False,
) -> None:
    """Make `goals` in the run's folder and show the report's numbers."""
    from fieldfuse.pipelines.thread_limits import bound_threads

    bound_threads(options)
    from fieldfuse.pipelines.reconstruct import BEFORE, run_job

    data = run_job(target, out, options, goals, make_progress(quiet), BEFORE if trusted is None else trusted, go_on)
    show(data, quiet, as_json, folder=target if out is None else out)


def show(data: dict[str, Any], quiet: bool, as_json: bool, folder: Path) -> None:
    """The result on stdout: JSON, or a table and where the report is."""
    if as_json:
        sys.stdout.write(json.dumps(data, indent=1) + "\n")
    elif not quiet:
        show_table(data)
        for warning in data.get("warnings", []):
            sys.stdout.write(f"note: {warning}\n")
        for export in data.get("exports", []):
            if export["path"] == PAGE:
                sys.stdout.write(f"{folder / PAGE}\n")
        sys.stdout.write(f"{folder / ('report.html' if data.get('evaluation') else 'exports/cameras')}\n")
