"""`python -m benchmarks.mutation --out DIR`: how many of some sixty planted faults the tests find.

Each fault is planted alone in a throw-away copy of a checkout. The tests nearest to it run until one fails, at most `--seconds`: first
those that are not slow, then the others. A test that fails without the fault, too, does not count.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Annotated

import typer

from benchmarks.experiment import Experiment, Folder, Row, application, chosen, markdown, section, show
from benchmarks.mutation.faults import FAULTS, Fault
from benchmarks.mutation.planted import Copy
from fieldfuse.pipelines.console import make_progress
from fieldfuse.pipelines.options import Quiet

ROOT = Path(__file__).parents[2]
MOST_FILES = 20
FILTERS = ("not slow", "slow")


def mutation(
    out: Folder = None,
    checkout: Annotated[Path, typer.Option(help="The state to try: a checkout of any commit.", show_default=False)] = ROOT,
    python: Annotated[Path, typer.Option(help="Interpreter that runs its tests.", show_default=False)] = Path(sys.executable),
    seconds: Annotated[float, typer.Option(help="Seconds a fault at most.")] = 100,
    only: Annotated[str | None, typer.Option(help="Some of the faults, separated by commas.", show_default=False)] = None,
    quiet: Quiet = False,
) -> None:
    """Plant faults in a copy of the product, one at a time, and see whether its tests find them."""
    faults = {fault.name: fault for fault in FAULTS}
    wanted = chosen(only, faults, "--only")
    with tempfile.TemporaryDirectory(prefix="mutation-") as folder:
        copy = Copy(checkout.resolve(), Path(folder), python.absolute())
        plan = [{"fault": name, "kind": faults[name].kind} for name in wanted]
        state = f"{checkout.resolve()} {seconds:g}"
        experiment = Experiment("mutation", plan, lambda entry: outcome(copy, faults[entry["fault"]], seconds), table, state)
        data = experiment.conduct(out, make_progress(quiet))
    show(section(data, table), quiet)


def outcome(copy: Copy, fault: Fault, seconds: float) -> Row:
    """Whether and by which test a fault is found.

    Returns:
        `file` (None: its line is not in this product), `caught`, `by` (a test), `seconds`, `complete` (whether all tests chosen were run),
        `tests` (files), `unreliable` (tests that fail without the fault).
    """
    unreliable: list[str] = []
    begin = time.monotonic()
    place = copy.find(fault)
    if place is None:
        return {"file": None, "caught": False, "by": None, "seconds": 0.0, "complete": False, "tests": 0, "unreliable": []}
    file = place[0]
    with copy.planted(*place):
        tests = copy.imports.tests_of(file, MOST_FILES)
        by, complete = None, True
        for marked in FILTERS:
            left = seconds - (time.monotonic() - begin)
            by, all_run = copy.run(tests, left, marked) if left > 5 and tests else (None, False)
            complete &= all_run
            if by is not None:
                break
    spent = time.monotonic() - begin
    if by is not None and copy.run([by], 2 * seconds, "")[0] is not None:
        unreliable.append(by)
    row = {"file": file, "caught": by is not None and not unreliable, "by": by, "seconds": round(spent, 1), "complete": complete}
    return {**row, "tests": len(tests), "unreliable": unreliable}


def table(data: Row) -> str:
    """Markdown: how many faults of each kind were found, and a line for each fault."""
    rows = [row for row in data["rows"] if row["file"] is not None]
    kinds, found = Counter(row["kind"] for row in rows), Counter(row["kind"] for row in rows if row["caught"])
    lines = [[kind, count, found[kind]] for kind, count in sorted(kinds.items())]
    lines.append(["all", len(rows), sum(found.values())])

    def verdict(row: Row) -> str:
        if row["caught"]:
            return row["by"].removeprefix("tests/")
        return f"**not found**{' (that test fails without it, too)' if row['unreliable'] else '' if row['complete'] else ' in time'}"

    each = [[row["fault"], row["kind"], row["file"], verdict(row), f"{row['seconds']:.0f}"] for row in rows]
    gone = [row["fault"] for row in data["rows"] if row["file"] is None]
    remark = f"\nNot in this product: {'; '.join(gone)}.\n" if gone else ""
    return markdown(("kind", "faults", "found"), lines) + "\n" + markdown(("fault", "kind", "file", "found by", "seconds"), each) + remark


app = application(mutation)
