"""`fieldfuse render DIR`: pictures or a video of a run's field, along an orbit, at the held-out views, or along cameras of your own."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from fieldfuse.pipelines.options import Options, Place, bound_threads, show, takes


@dataclass(frozen=True)
class CameraPath:
    """Which cameras are rendered, and where to."""

    views: Annotated[str, typer.Option(help="orbit, or test: the held-out views.")] = "orbit"
    cameras: Annotated[
        Path | None,
        typer.Option(
            "--cameras",
            "--path",
            help="Cameras to render, in the capture's frame: a transforms.json, or a camera path as field.html and nerfstudio write it.",
            show_default=False,
        ),
    ] = None
    to: Annotated[
        Path | None, typer.Option(help="An .mp4 file, or a folder for PNG pictures. Default: in DIR/renders.", show_default=False)
    ] = None
    frames: Annotated[int, typer.Option(min=2, help="Pictures of the orbit.")] = 90
    fps: Annotated[
        float | None,
        typer.Option(min=1, max=1000, help="Pictures a second of a video. Default: the path's own, else 30.", show_default=False),
    ] = None
    image_size: Annotated[int | None, typer.Option(min=16, help="Long side of the pictures in pixels.", show_default=False)] = None


@takes("baked device threads config pairs quiet json")
def render(place: Place, path: CameraPath, options: Options) -> None:
    """Render the field of a run (of a source, it is fitted first)."""
    settings = options.settings()
    bound_threads(settings)
    from fieldfuse.pipelines.render_path import render_run

    data = render_run(place, path, settings, options.baked, options.quiet)

    def lines() -> Iterator[str]:
        yield f"{data['pictures']} pictures of {data['width']}×{data['height']} in {data['seconds']:.1f} s: {data['to']}"
        if data["others"]:
            yield f"note: {data['to']} holds {data['others']} other pictures, which are not of this command"

    show(data, options, lines)
