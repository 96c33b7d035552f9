"""`python -m tests.stability.fuzz --inputs 100000 [--seed 1] [--jobs 2] [--only field] [--page docs/stability.md]`."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from tests.stability.fuzz.drive import Result, fuzz
from tests.stability.page import replace_part


def main() -> int:
    parser = argparse.ArgumentParser(prog="fuzz", description="Damaged and hostile files for every reader.")
    parser.add_argument("--inputs", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--only", action="append", default=[], help="a target's name; may be repeated")
    parser.add_argument("--page", type=Path, help="a page of which a part is replaced by the result")
    parser.add_argument("--part", default="fuzz", help="that part's name")
    chosen = parser.parse_args()

    shown = 0

    def told(result: Result) -> None:
        nonlocal shown
        sys.stderr.write(f"{result.inputs} inputs, {len(result.problems)} problems\n")
        for problem in result.problems[shown:]:
            sys.stdout.write(json.dumps(problem) + "\n")
        sys.stdout.flush()
        shown = len(result.problems)

    result = fuzz(chosen.inputs, chosen.seed, chosen.jobs, chosen.only, told)
    told(result)
    if chosen.page is not None:
        replace_part(chosen.page, chosen.part, result.lines())
    sys.stderr.write("\n".join(result.lines()) + "\n")
    return 1 if result.problems else 0


if __name__ == "__main__":
    sys.exit(main())
