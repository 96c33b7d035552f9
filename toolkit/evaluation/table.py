"""The headline numbers of a run as one table for the terminal."""

from __future__ import annotations

import io
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from fieldfuse.evaluation import words
from fieldfuse.evaluation.report import report_data

WIDEST = 100  # characters
METHODS = (("field", "field"), ("network", "networks alone"), ("tsdf", "TSDF"))


def headline_table(data: dict[str, Any]) -> Table:
    """One row a method (field, networks alone, TSDF, nearest picture), facts of the run in the caption. `data` as for `write_report`."""
    data = report_data(data)
    unit = words.unit_of(data)
    evaluation = data["evaluation"]
    table = Table(box=box.SIMPLE_HEAD, title_justify="left", caption_justify="left", caption_style="")
    depth = any((evaluation.get(key) or {}).get("depth_abs_err") is not None for key, _ in METHODS)
    for name in ("", "PSNR", "SSIM", "LPIPS", *([f"depth error\n({unit})"] if depth else []), "render\na view"):
        table.add_column(name, justify="left" if name == "" else "right", no_wrap=name != "")  # the names give way, never a number
    for key, title in METHODS:
        score = evaluation.get(key)
        if score is not None:
            table.add_row(
                title,
                words.decimal(score["psnr"]),
                words.decimal(score["ssim"], 3),
                words.decimal(score["lpips"], 3),
                *([words.significant(score["depth_abs_err"])] if depth else []),
                words.duration(score["seconds_per_view"]),
            )
            if score.get("key_frames") is not None:
                table.add_row(f"  {words.counted(score['key_frames'], 'key frame')} in {words.duration(score.get('seconds'))}")
            if score.get("psnr_masked") is not None:
                table.add_row(f"  on its surface, {words.share(score.get('coverage'))} of the pixels", words.decimal(score["psnr_masked"]))
    floor = evaluation.get("nearest_image")
    if floor is not None and floor.get("psnr") is not None:
        table.add_row("nearest training picture", words.decimal(floor["psnr"]))
    table.caption = Text("\n".join(facts(data)))
    return table


def facts(data: dict[str, Any]) -> list[str]:
    """Short lines on capture, field and time. `data` as `report_data` answers it."""
    capture, poses, field = data["capture"], data["poses"], data["field"]
    lines = []
    if capture["frames"] is not None:
        line = words.counted(capture["frames"], "frame")
        if poses["registered"] is not None and poses["total"] is not None:
            line += f", {poses['registered']} of {poses['total']} with a pose"
        lines.append(line)
    if field["voxels"] is not None:
        voxels, blocks = words.whole(field["voxels"]), words.whole(field["blocks"])
        lines.append(f"field of {voxels} voxels in {blocks} blocks, {words.size(field['bytes'])} in memory")
    if data["seconds_total"] is not None:
        earlier = any(stage.get("cached") for stage in data.get("stages") or [])
        lines.append(f"{words.duration(data['seconds_total'])} in all{', with what was made before' if earlier else ''}")
    return lines


def table(data: dict[str, Any], width: int = WIDEST) -> str:
    """`headline_table` as plain text lines of at most `width` characters; the facts alone when nothing was scored."""
    whole = headline_table(data)
    if whole.row_count == 0:
        return "".join(f"{line}\n" for line in facts(report_data(data)))
    stream = io.StringIO()
    Console(file=stream, width=width, color_system=None, force_terminal=False).print(whole)
    return "\n".join(line.rstrip() for line in stream.getvalue().splitlines()) + "\n"
