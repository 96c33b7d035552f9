"""Results of a benchmark as Markdown, with the paper's numbers beside them, and such tables put into a page between marks."""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from fieldfuse.errors import InputError
from fieldfuse.evaluation import words
from fieldfuse.evaluation.suites.base import PAPER, Suite, summary
from fieldfuse.files import atomic_path

MEASURES = ("psnr", "ssim", "lpips")
DIGITS = {"psnr": 2, "ssim": 3, "lpips": 3}
COLUMNS = ("scene", "PSNR", "SSIM", "LPIPS", "training / test views", "pixels", "fit", "whole", "voxels")
REPORTED = "reported, not measured"
BEGIN, END = "<!-- measured: {} -->", "<!-- end of {} -->"


def suite_table(suite: Suite, data: dict[str, Any]) -> str:
    """A section of Markdown: protocol, machine, command, one table a variant. `data` as `fieldfuse bench` writes it."""
    lines = [f"### {suite.title}", "", f"Protocol: {suite.protocol}."]
    if suite.differs:
        lines.append(f"Not as in the paper: {suite.differs}.")
    lines += ["", machine_line(data["machine"]), "", f"    {data['command']}", ""]
    for variant in suite.variants:
        rows = [row for row in data["rows"] if row["variant"] == variant.key]
        if rows:
            lines += [f"**{variant.title[:1].upper()}{variant.title[1:]}**", "", *table(rows, variant.reported, len(suite.scenes)), ""]
    return "\n".join(lines).rstrip() + "\n"


def table(rows: Sequence[dict[str, Any]], reported: dict[str, float], scenes: int) -> list[str]:
    """Lines of a table: a row a scene, their mean when there are several, and what the paper reports."""
    lines = [row_line(COLUMNS), row_line(["---"] * len(COLUMNS))]
    for row in rows:
        if row.get("error"):
            lines.append(row_line([row["scene"], f"not made: {row['error']}", *[""] * (len(COLUMNS) - 2)]))
            continue
        size = f"{row['width']}×{row['height']}"
        facts = [f"{row['train']} / {row['test']}", size, *(words.duration(row[key]) for key in ("fit_seconds", "seconds"))]
        lines.append(row_line([row["scene"], *_scores(row), *facts, words.whole(row["voxels"])]))
    made = [row for row in rows if not row.get("error")]
    empty = [""] * (len(COLUMNS) - 1 - len(MEASURES))
    if len(made) > 1:
        lines.append(row_line([f"mean of {len(made)}", *_scores(summary(made, MEASURES)), *empty]))
    if reported:
        whose = f"{PAPER}, mean of all its scenes" if scenes == 0 else f"{PAPER}, mean of {scenes}"
        lines.append(
            row_line([f"*{whose}: {REPORTED}*", *(f"*{text}*" if text != words.NONE else text for text in _scores(reported)), *empty])
        )
    return lines


def _scores(row: dict[str, Any]) -> list[str]:
    return [words.decimal(row.get(key), DIGITS[key]) for key in MEASURES]


def row_line(cells: Sequence[str]) -> str:
    """A row of a Markdown table."""
    return "| " + " | ".join(str(cell).replace("|", "/") for cell in cells) + " |"


def machine_line(machine: dict[str, Any]) -> str:
    """What it was measured on, in a sentence."""
    load = machine.get("load")
    busy = "" if load is None else f", load {load:.1f} (where it is above the cores, times are upper bounds)"
    return (
        f"Measured {machine.get('measured', '')} on a machine of {machine.get('cores')} cores, threads: {machine.get('threads')},"
        f" device: {machine.get('device', 'cpu')}{busy}:"
    )


def portable(command: str, data: Path | None) -> str:
    """A command without this machine's places: what lies in the folder `data` becomes DATA/…, other absolute paths their last part."""
    words_of = shlex.split(command)
    for index, word in enumerate(words_of):
        if data is not None and Path(word).is_absolute() and Path(word).is_relative_to(data):
            words_of[index] = (Path("DATA") / Path(word).relative_to(data)).as_posix()
        elif Path(word).is_absolute():
            before = words_of[index - 1] if index else ""
            words_of[index] = f"runs/{Path(word).name}" if before in ("--out", "-o") else Path(word).name
    return shlex.join(words_of)


def put_between_marks(page: Path, name: str, text: str) -> None:
    """Replace what stands between the marks of `name` in a Markdown page by `text`; marks that are not there are added at its end.

    Raises:
        InputError: the page cannot be read, or one of its marks is missing.
    """
    if not re.fullmatch(r"[\w .-]+", name):
        raise InputError(f"{name!r} cannot be the name of a table; use letters, digits, dots and dashes")
    begin, end = BEGIN.format(name), END.format(name)
    try:
        old = page.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not text in UTF-8"
        raise InputError(f"cannot read the page {page} ({reason}); give a Markdown file") from error
    block = f"{begin}\n{text.strip()}\n{end}"
    if (begin in old) != (end in old) or old.count(begin) > 1 or old.count(end) > 1:
        raise InputError(f"{page} must hold both marks of {name!r} once, or neither: {begin} and {end}")
    if begin in old:
        before, rest = old.split(begin, 1)
        after = rest.split(end, 1)[1]
        new = before + block + after
    else:
        new = old.rstrip("\n") + f"\n\n{block}\n"
    with atomic_path(page) as temporary:
        temporary.write_text(new, encoding="utf-8")
