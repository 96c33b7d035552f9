"""`fieldfuse render DIR`: pictures or a video of a run's field, along an orbit, at the held-out views, or along cameras of your own."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fieldfuse.pipelines.options import Baked, Config, Device, Json, OptionalOut, Pairs, Quiet, Target, Threads, gather


def render(
    target: Target,
    out: OptionalOut = None,
    views: Annotated[str, typer.Option(help="orbit, or test: the held-out views.")] = "orbit",
    cameras: Annotated[
        Path | None, typer.Option(help="A transforms.json with the cameras to render, in the capture's frame.", show_default=False)
    ] = None,
    to: Annotated[
        Path | None, typer.Option(help="An .mp4 file, or a folder for PNG pictures. Default: in DIR/renders.", show_default=False)
    ] = None,
    frames: Annotated[int, typer.Option(min=2, help="Pictures of the orbit.")] = 90,
    fps: Annotated[float, typer.Option(min=1, max=1000, help="Pictures a second of a video.")] = 30,
    image_size: Annotated[int | None, typer.Option(min=16, help="Long side of the pictures in pixels.", show_default=False)] = None,
    baked: Baked = False,
    device: Device = None,
    threads: Threads = None,
    config: Config = None,
    pairs: Pairs = None,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Render the field of a run (of a source, it is fitted first)."""
    from fieldfuse.pipelines.thread_limits import bound_threads

    options = gather(None, config, pairs, device=device, threads=threads)
    bound_threads(options)
    from fieldfuse.pipelines.console import make_progress
    from fieldfuse.pipelines.render_path import Shot, render_run

    data = render_run(target, out, options, Shot(views, cameras, frames, image_size, baked, to, fps), make_progress(quiet))
    if json:
        import json as writer

        typer.echo(writer.dumps(data, indent=1))
    elif not quiet:
        typer.echo(f"{data['pictures']} pictures of {data['width']}×{data['height']} in {data['seconds']:.1f} s: {data['to']}")
        if data["others"]:
            typer.echo(f"note: {data['to']} holds {data['others']} other pictures, which are not of this command")
