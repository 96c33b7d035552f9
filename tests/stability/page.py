"""`docs/stability.md`: the parts between `<!-- NAME -->` and `<!-- /NAME -->` are written by programs, the rest by people.

`pytest tests/stability/hard --page docs/stability.md` runs every hard case and replaces the part `cases`.
"""

from __future__ import annotations

import math
import re
from pathlib import Path

from tests.stability.hard.within import Within


def replace_part(page: Path, name: str, lines: list[str]) -> None:
    """Write `lines` between the marks of the part `name`.

    Raises:
        ValueError: the page has no such part.
    """
    text = page.read_text(encoding="utf-8")
    pattern = re.compile(rf"(<!-- {name} -->\n).*?(<!-- /{name} -->)", re.DOTALL)
    if not pattern.search(text):
        raise ValueError(f"{page} has no part between <!-- {name} --> and <!-- /{name} -->")
    body = "\n".join(lines) + "\n"
    page.write_text(pattern.sub(lambda match: match[1] + body + match[2], text), encoding="utf-8")


def number(value: float) -> str:
    return "0" if value == 0 else f"{value:.1e}" if math.isfinite(value) and not 0.01 <= abs(value) < 1000 else f"{value:.3g}"


def case_lines(cases: list[Within]) -> list[str]:
    """A table: each case's measure that comes nearest to its bound."""
    numbers = sum(len(case.measures) for case in cases)
    bad = [case for case in cases if not case.good]
    silent = sum(not math.isfinite(measure.error) for case in cases for measure in case.measures)
    out = [
        f"{len(cases)} cases, {numbers} numbers; {len(bad)} cases missed a bound; {silent} errors were NaN or infinite.",
        "",
        "| case | numbers | worst quantity | error | bound |",
        "| --- | --- | --- | --- | --- |",
    ]
    for case in cases:
        if case.failure or not case.measures:
            out.append(f"| {case.title} | | failed: {case.failure} | | |")
            continue
        worst = max(case.measures, key=lambda measure: (not measure.good, _share(measure.error, measure.bound)))
        quantity = worst.quantity.replace("|", "·")
        out.append(f"| {case.title} | {len(case.measures)} | {quantity} | {number(worst.error)} | {number(worst.bound)} |")
    return out


def _share(error: float, bound: float) -> float:
    return error / bound if bound > 0 else error
