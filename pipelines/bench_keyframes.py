"""`fieldfuse bench keyframes`: how many key frames a second the networks fuse on this machine."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from fieldfuse.pipelines.options import Device, Quiet, Seed, Threads

FAR = 3.0  # metres, as in the paper
TITLES = {
    "time": "time", "rate": "key frames/s", "mean_ms": "ms each", "late_ms": "95% within, ms", "known": "voxels known", "peak_mb": "MB",
}  # fmt: skip


def keyframes(
    key_frames: Annotated[int, typer.Option("--key-frames", min=2, max=500, help="Key frames of the walk.")] = 30,
    width: Annotated[int, typer.Option(min=64, max=4096, help="Pixels of a picture's long side.")] = 640,
    voxel: Annotated[float, typer.Option(min=0.005, max=1.0, help="Side of the finest voxels, metres.")] = 0.04,
    levels: Annotated[int, typer.Option(min=1, max=4, help="Lattices, each finer than the one before; 1: the paper's single one.")] = 2,
    repetitions: Annotated[int, typer.Option(min=1, help="Times that all are fused; the first has loading and compiling in it.")] = 3,
    device: Device = None,
    threads: Threads = None,
    seed: Seed = None,
    to: Annotated[Path | None, typer.Option("--json", help="Write the rows to this JSON file.", show_default=False)] = None,
    quiet: Quiet = False,
) -> None:
    """Fuse key frames of a walk through a made-up room, and say how many a second: pictures encoded, swept, held against each other."""
    from fieldfuse.pipelines.thread_limits import bound_threads

    bound_threads({"flags": {"threads": threads}})
    import os
    import time

    import torch

    from fieldfuse.evaluation.key_frames import NEAR, key_frame_rates, walk
    from fieldfuse.evaluation.speed import machine
    from fieldfuse.files import write_json
    from fieldfuse.nerfusion.fusion import FusionOptions
    from fieldfuse.pipelines.console import make_progress
    from fieldfuse.pipelines.job import set_threads
    from fieldfuse.steps import choose_device

    threads = threads or os.cpu_count() or 1
    set_threads(threads)
    where = torch.device(choose_device(device or "auto"))
    progress, rows = make_progress(quiet), list[dict[str, Any]]()
    with progress.listening():
        progress.begin("room")
        began = time.monotonic()
        way = walk(key_frames, width, voxel, levels, seed or 0, where)
        progress.finish("room", time.monotonic() - began, False)
        progress.begin("key frames")
        for row in key_frame_rates(way, FusionOptions(levels, NEAR, FAR), where, repetitions, progress):
            rows.append(row)
            progress.say(f"{row['rate']:g} key frames/s, {row['mean_ms']:g} ms each; {row['known']:,} voxels known")
    about = machine(threads) | {"device": torch.cuda.get_device_name(where) if where.type == "cuda" else "cpu"}
    if to is not None:
        write_json(to, {"machine": about, "width": width, "voxel": voxel, "levels": levels, "key_frames": rows})
    if not quiet:
        show(rows, about)


def show(rows: list[dict[str, Any]], about: dict[str, Any]) -> None:
    """A table on standard output."""
    from rich.console import Console
    from rich.table import Table

    from fieldfuse.evaluation.words import counted

    table = Table(box=None, pad_edge=False, header_style="bold")
    columns = [name for name in TITLES if name in rows[0]]
    for name in columns:
        table.add_column(TITLES[name], justify="right")
    for row in rows:
        table.add_row(*(f"{row[name]:,}" for name in columns))
    console = Console(highlight=False)
    console.print(table)
    console.print(f"{about['device']}; {about['machine']}, {about['cores']} cores, {counted(about['threads'], 'thread')}")
