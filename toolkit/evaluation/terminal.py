"""The headline numbers of a run and of a comparison as tables for the terminal."""

from __future__ import annotations

import io
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from fieldfuse.evaluation import words
from fieldfuse.evaluation.report import report_data, score_rows

WIDEST = 100  # characters
LABELS, COLUMN = 60, 22  # columns for the names of a comparison's measures, and for each method
NARROW_LABELS, NARROW = 40, 17  # the same on a terminal that is too narrow for these: what is longer is wrapped


def report_text(data: dict[str, Any], width: int = WIDEST) -> str:
    """One row a method (field, networks alone, splats, TSDF, nearest image), then facts of the run, in lines of at most `width` characters;
    the facts alone when nothing was scored. `data` as for `write_report`."""
    data = report_data(data)
    rows = score_rows(data)
    out = Table(box=box.SIMPLE_HEAD, title_justify="left", caption_justify="left", caption_style="")
    depth = any(row.get("depth_abs_err") is not None for row in rows)
    for name in ("", "PSNR", "SSIM", "LPIPS", *([f"depth error\n({words.unit_of(data)})"] if depth else []), "render\na view"):
        out.add_column(name, justify="left" if name == "" else "right", no_wrap=name != "")  # the names give way, never a number
    for row in rows:
        if row["part"]:
            out.add_row(f"  {row['note']}" if row["title"] == "TSDF" else row["title"], words.decimal(row["psnr"]))
            continue
        cells = [words.decimal(row["psnr"]), words.decimal(row["ssim"], 3), words.decimal(row["lpips"], 3)]
        cells += [words.significant(row["depth_abs_err"])] if depth else []
        out.add_row(row["title"], *cells, words.duration(row["seconds_per_view"]))
        if row["note"]:
            out.add_row(f"  {row['note']}")
    facts = _facts(data)
    out.caption = Text("\n".join(facts))
    return _printed(out, width) if out.row_count else "".join(f"{line}\n" for line in facts)


def _facts(data: dict[str, Any]) -> list[str]:
    """Short lines on capture, field and time."""
    capture, poses, field = data["capture"], data["poses"], data["field"]
    lines = []
    if capture["frames"] is not None:
        line = words.counted(capture["frames"], "frame")
        if poses["registered"] is not None and poses["total"] is not None:
            line += f", {poses['registered']} of {poses['total']} with a pose"
        lines.append(line)
    if poses.get("scaling"):
        lines.append(f"lengths in metres: {poses['scaling']['text']}")
    if field["voxels"] is not None:
        voxels, blocks = words.whole(field["voxels"]), words.whole(field["blocks"])
        lines.append(f"field of {voxels} voxels in {blocks} blocks, {words.size(field['bytes'])} in memory")
    if data["seconds_total"] is not None:
        earlier = any(stage.get("cached") for stage in data["stages"])
        lines.append(f"{words.duration(data['seconds_total'])} in all{', with what was made before' if earlier else ''}")
    return lines


def comparison_text(data: dict[str, Any], width: int | None = None) -> str:
    """A column a method, a row a measure; the best of a row has a star. `data` as for `compare_data`.

    With a `width` in characters lines are no longer than that: names are wrapped, and methods that do not fit beside the others follow
    below them.
    """
    from fieldfuse.evaluation.compare import compare_data, matching_line, table  # with Open3D

    data = compare_data(data)
    count = len(data["methods"])
    full = LABELS + COLUMN * count
    some = count if width is None or width >= full else max(1, (width - NARROW_LABELS) // NARROW)
    text = []
    for first in range(0, count, some):
        methods = range(first, min(first + some, count))
        out = Table(box=box.SIMPLE_HEAD)
        out.add_column("", max_width=NARROW_LABELS - 2 if width is not None and width < full else None)
        for index in methods:
            out.add_column(Text(data["methods"][index]["title"]), justify="right")
        for title, rows in table(data):
            out.add_row(Text(title, style="bold"))
            for row in rows:
                cells = [row.cells[index] for index in methods]
                out.add_row(Text(f"  {row.label}"), *(f"{cell.text} *" if cell.best else f"{cell.text}  " for cell in cells))
        text.append(_printed(out, min(width or full, full)).strip("\n") + "\n")
    matching = matching_line(data)
    return "\n".join(text) + ("" if matching is None else f"{matching}\n")


def _printed(table: Table, width: int) -> str:
    stream = io.StringIO()
    Console(file=stream, width=width, color_system=None, force_terminal=False).print(table)
    return "\n".join(line.rstrip() for line in stream.getvalue().splitlines()) + "\n"
