"""`fieldfuse selftest --stability`: the hard cases for the numbers, run on this machine."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fieldfuse.pipelines.options import Json, Quiet, Threads

if TYPE_CHECKING:
    from fieldfuse.evaluation.selftest.case import Measure, Outcome


def selftest(
    stability: Annotated[
        bool, typer.Option("--stability", help="Hard cases for every kernel, against float64 references; always.", show_default=False)
    ] = True,
    fast: Annotated[bool, typer.Option("--fast", help="Leave out the cases that take longer or much memory.")] = False,
    only: Annotated[str | None, typer.Option(help="Only cases whose title holds this text.", show_default=False)] = None,
    every: Annotated[bool, typer.Option("--all", help="Show every number, not only the one nearest to its bound.")] = False,
    threads: Threads = None,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Run the hard cases: each kernel where numbers usually break. Ends with 1 if a bound is missed."""
    from fieldfuse.pipelines.thread_limits import bound_threads

    bound_threads({"flags": {"threads": threads}})
    from fieldfuse.pipelines.job import set_threads

    set_threads(threads)
    outcomes = run(fast, only, quiet or json)
    if json:
        import json as writer

        typer.echo(writer.dumps([_plain(outcome) for outcome in outcomes], indent=1))
    else:
        show(outcomes, every)
    if not all(outcome.good for outcome in outcomes):
        raise typer.Exit(1)


def run(fast: bool, only: str | None, quiet: bool) -> list[Outcome]:
    """Run the chosen cases, naming each on stderr unless `quiet`.

    Raises:
        InputError: no case has that text in its title.
    """
    import numpy as np

    from fieldfuse.errors import InputError
    from fieldfuse.evaluation.selftest.case import all_cases, run_cases

    chosen = [case for case in all_cases() if not (fast and case.slow) and (only is None or only.lower() in case.title.lower())]
    if not chosen:
        raise InputError(f"there is no case with {only!r} in its title; run `fieldfuse selftest --stability` to see all")

    def finished(outcome: Outcome) -> None:
        if not quiet:
            sys.stderr.write(f"{'ok' if outcome.good else 'BAD'}  {outcome.case.title} ({outcome.seconds:.1f} s)\n")

    with np.errstate(all="ignore"):  # overflow in a hard case is the point of it; what counts is the result
        return run_cases(chosen, finished)


def nearest_bound(measures: list[Measure]) -> Measure:
    """The measure that comes nearest to its bound, or misses it by most."""
    return max(measures, key=lambda measure: (not measure.good, measure.error / measure.bound if measure.bound > 0 else measure.error))


def show(outcomes: list[Outcome], every: bool) -> None:
    """A table of case, quantity, error and bound on stdout; what misses its bound is always in it."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, pad_edge=False, header_style="bold")
    for column, way in (("case", "left"), ("quantity", "left"), ("error", "right"), ("bound", "right"), ("", "left")):
        table.add_column(column, justify=way, overflow="fold")  # type: ignore[arg-type]
    for outcome in outcomes:
        if outcome.failure:
            table.add_row(Text(outcome.case.title), Text(outcome.failure), "", "", Text("failed", style="red"))
        rows = outcome.measures if every else [measure for measure in outcome.measures if not measure.good]
        if outcome.measures and not rows:
            rows = [nearest_bound(outcome.measures)]
        for measure in rows:
            verdict = Text("ok", style="green") if measure.good else Text("missed", style="red")
            table.add_row(Text(outcome.case.title), Text(measure.quantity), f"{measure.error:.2g}", f"{measure.bound:.2g}", verdict)
    console = Console(highlight=False)
    if not console.is_terminal:
        console = Console(highlight=False, width=140)
    console.print(table)
    numbers = sum(len(outcome.measures) for outcome in outcomes)
    bad = sum(not outcome.good for outcome in outcomes)
    console.print(
        f"\n{len(outcomes)} cases, {numbers} numbers, {sum(o.seconds for o in outcomes):.0f} s: {f'{bad} BAD' if bad else 'all good'}"
    )


def _plain(outcome: Outcome) -> dict[str, Any]:
    return {
        "group": outcome.case.group,
        "case": outcome.case.name,
        "seconds": round(outcome.seconds, 3),
        "failure": outcome.failure,
        "good": outcome.good,
        "measures": [
            {"quantity": m.quantity, "error": m.error if abs(m.error) < 1e308 else str(m.error), "bound": m.bound, "good": m.good}
            for m in outcome.measures
        ],
    }
