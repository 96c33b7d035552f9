"""The evidence of effects as a table: for `fieldfuse info SOURCE --effects`, where nothing is reconstructed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

BESIDE = 140  # characters that a line must have for the evidence to stand in the table


def effects_facts(target: Path, quiet: bool) -> dict[str, Any]:
    """What an earlier run found, or what its pictures and given poses show now.

    Raises:
        InputError: a source without poses: shared points cannot be told from wrong matches without them.
    """
    from fieldfuse.capture import open_capture
    from fieldfuse.effects.depth_camera import DEPTH_OFFSET, look_for_offset
    from fieldfuse.effects.diagnostics import diagnose
    from fieldfuse.errors import InputError
    from fieldfuse.pipelines.console import make_progress
    from fieldfuse.pipelines.folder import is_run_folder
    from fieldfuse.pipelines.kept import EFFECTS, read_kept

    if is_run_folder(target):
        if not (target / "effects.json").is_file():
            raise InputError(f"{target} holds no effects.json; run the job again without effects=off")
        return {key: value for key, value in read_kept(target / "effects.json", EFFECTS).items() if key != "corrections"}
    capture = open_capture(target)
    posed = [frame for frame in capture.frames if frame.world_from_camera is not None and frame.intrinsics is not None]
    if len(posed) < 3:
        raise InputError(
            f"{target} comes without camera poses, which the evidence needs; find them first: fieldfuse poses {target} --out DIR, "
            "copy DIR/exports/cameras/transforms.json into the capture's folder, then fieldfuse info THERE/transforms.json --effects"
        )
    progress = make_progress(quiet)
    with progress.listening():
        progress.begin("effects")
        shown = capture.with_frames(posed)
        found = diagnose(shown, progress=progress)
        findings = dict(found.findings)
        if shown.has_depth:
            with found.timing.by(DEPTH_OFFSET):
                findings[DEPTH_OFFSET] = look_for_offset(shown, range(len(posed)), found.seen, progress)[0]
    progress.finish("effects", found.seconds + found.timing.of(DEPTH_OFFSET), False)
    return {
        "effects": [{**finding.to_dict(), "seconds": found.timing.of(name)} for name, finding in findings.items()],
        "seconds": round(found.seconds + found.timing.of(DEPTH_OFFSET), 3),
        "looked_at": found.facts,
    }


def show(data: dict[str, Any]) -> None:
    """The table on standard output, one effect a row; where lines are short what speaks for each stands below it."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from fieldfuse.evaluation.words import significant

    console = Console(highlight=False)
    if not console.is_terminal:
        console = Console(highlight=False, width=180)
    beside = console.width >= BESIDE
    table = Table(box=None, pad_edge=False, header_style="bold")
    for column in ("effect", "there", "number", "threshold", "held out", "s", *(["evidence"] if beside else [])):
        table.add_column(column, justify="right" if column in ("number", "threshold", "held out", "s") else "left", overflow="fold")
    for entry in data["effects"]:
        held = entry.get("held_out")
        change = "" if held is None else f"{significant(held['before'])} → {significant(held['after'])} {held['unit']}"
        there = "yes" if entry["there"] else "no"
        paid = f"{entry['seconds']:.2f}" if "seconds" in entry else ""
        last = [Text(entry["reason"])] if beside else []
        table.add_row(entry["effect"], there, f"{entry['number']:.3f}", f"{entry['threshold']:g}", change, paid, *last)
    console.print(table)
    if not beside:
        for entry in data["effects"]:
            console.print(f"\n{entry['effect']}: {entry['reason']}", markup=False)
        console.print()
    about = data["looked_at"]
    points = f", {about['points_seconds']:.1f} s of it for finding these points" if "points_seconds" in about else ""
    console.print(f"{about['frames']} pictures and {about['points']} shared points looked at in {data['seconds']:.1f} s{points}")
