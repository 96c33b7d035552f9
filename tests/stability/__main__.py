"""`python -m tests.stability kills|stops|fuzz [--count N] [--seed 1] [--jobs 2] [--only NAME] [--page docs/stability.md]`.

Kills, stops or damaged files by the hundred; a part of the page is replaced by what came of it.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from tests.stability import kills, stops
from tests.stability.fuzz import drive
from tests.stability.page import replace_part


def main() -> int:
    parser = argparse.ArgumentParser(prog="stability")
    parser.add_argument("what", choices=("kills", "stops", "fuzz"))
    parser.add_argument("--count", type=int, help="kills (default 50), or damaged files (default 100,000)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2, help="processes that read damaged files")
    parser.add_argument("--only", action="append", default=[], help="a kind of run, or a target of damaged files; may be repeated")
    parser.add_argument("--page", type=Path, help="a page of which the part `kills`, `stops` or `fuzz` is replaced")
    chosen = parser.parse_args()
    if chosen.what == "kills":
        wrong, lines = kills.survey(chosen.count or 50, chosen.seed)
    elif chosen.what == "stops":
        wrong, lines = stops.survey(chosen.only or list(stops.KINDS))
    else:
        wrong, lines = drive.survey(chosen.count or 100_000, chosen.seed, chosen.jobs, chosen.only)
    sys.stdout.write("\n".join([*wrong, *lines]) + "\n")
    if chosen.page is not None:
        replace_part(chosen.page, chosen.what, lines)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
