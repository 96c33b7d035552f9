"""`fieldfuse view DIR`: walk through a run's field in the browser."""

from __future__ import annotations

from typing import Annotated

import typer

from fieldfuse.pipelines.options import Baked, Config, Device, OptionalOut, Pairs, Quiet, Target, Threads, gather

KEPT = "cameras_kept.json"


def view(
    target: Target,
    out: OptionalOut = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Where the page is served; the next free one if it is taken. 0: any.")] = 8080,
    host: Annotated[str, typer.Option(help="Address to listen at. 0.0.0.0: others in the network can look, too.")] = "127.0.0.1",
    image_size: Annotated[int, typer.Option(min=64, max=4096, help="Long side in pixels of a picture at rest.")] = 800,
    baked: Baked = False,
    device: Device = None,
    threads: Threads = None,
    config: Config = None,
    pairs: Pairs = None,
    quiet: Quiet = False,
) -> None:
    """Walk through the field of a run in the browser (of a source, it is fitted first). Ctrl-C ends it."""
    from fieldfuse.pipelines.thread_limits import bound_threads

    options = gather(None, config, pairs, device=device, threads=threads)
    bound_threads(options)
    from fieldfuse.pipelines.console import make_progress
    from fieldfuse.pipelines.job import open_job
    from fieldfuse.pipelines.live import Live, Shown, require_server
    from fieldfuse.pipelines.pictures import camera_of
    from fieldfuse.pipelines.reconstruct import BEFORE, stand
    from fieldfuse.pipelines.steps_results import fit_radiance_field

    require_server(host)
    with open_job(target, out, options, make_progress(quiet), (*BEFORE, "field")) as job:
        _, _, _, scene, ready = stand(job)
        field, _ = fit_radiance_field(job, ready, scene)
        render, place = camera_of(job, field, ready, scene, baked), (out or target) / KEPT
        shown = Shown(job.source.name, render, ready, scene.median_depth, place, scene.working_from_input)
    with Live(shown, host, port, image_size) as live:  # the run's folder is free again: others may work in it
        typer.echo(f"{live.address} shows the field; Ctrl-C ends it")
        live.wait()
