"""`fieldfuse view DIR`: walk through a run's field in the browser."""

from __future__ import annotations

from contextlib import ExitStack
from typing import Annotated

import typer

from fieldfuse.pipelines.options import Options, Place, bound_threads, takes

CAMERAS = "cameras_kept.json"


@takes("baked device threads config pairs quiet")
def view(
    place: Place,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Where the page is served; the next free one if it is taken. 0: any.")] = 8080,
    host: Annotated[str, typer.Option(help="Address to listen at. 0.0.0.0: others in the network can look, too.")] = "127.0.0.1",
    image_size: Annotated[int, typer.Option(min=64, max=4096, help="Long side in pixels of a picture at rest.")] = 800,
    *,
    options: Options,
) -> None:
    """Walk through the field of a run in the browser (of a source, it is fitted first). Ctrl-C ends it."""
    settings = options.settings()
    bound_threads(settings)
    from fieldfuse.pipelines.console import make_progress
    from fieldfuse.pipelines.fields import finished_field
    from fieldfuse.pipelines.job import open_job
    from fieldfuse.pipelines.page_server import PageServer, has_parts
    from fieldfuse.pipelines.pictures import camera_of
    from fieldfuse.pipelines.prepare import prepare
    from fieldfuse.pipelines.stages import BEFORE
    from fieldfuse.pipelines.viewer import Live, Shown, require_server

    require_server(host)
    with open_job(place, settings, make_progress(options.quiet), (*BEFORE, "field")) as job:
        ready = prepare(job)
        render = camera_of(job, finished_field(job, ready).field, ready.views, ready.scene, options.baked)
        shown = Shown(job.source.name, render, ready, place.folder / CAMERAS)
    exports = place.folder / "exports"
    with ExitStack() as stack:  # the run's folder is free again: others may work in it
        live = stack.enter_context(Live(shown, host, port, image_size))
        typer.echo(f"{live.address} shows the field; Ctrl-C ends it")
        if has_parts(exports):
            page = stack.enter_context(PageServer(exports, host, live.port + 1))
            typer.echo(f"{page.address} is the page of its exports, with all details")
        live.wait()
