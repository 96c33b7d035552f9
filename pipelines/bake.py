"""`fieldfuse bake DIR`: a run's field as a small file that is rendered straight from disk."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from fieldfuse.pipelines.options import Options, Place, bound_threads, show, takes

SEEN = 0.01  # as `fieldfuse.render.bake` has it


@takes("threads config pairs quiet json")
def bake(
    place: Place,
    seen: Annotated[
        float, typer.Option(min=0, max=1, help="Voxels in which no training pixel has more of its light are left out; 0 keeps all.")
    ] = SEEN,
    to: Annotated[Path | None, typer.Option(help="The file. Default: DIR/exports/baked.safetensors.", show_default=False)] = None,
    *,
    options: Options,
) -> None:
    """Quantise the field of a run to bytes and say what that costs at the held-out views."""
    settings = options.settings()
    bound_threads(settings)
    data = bake_run(place, settings, seen, to, options.quiet)

    def lines() -> Iterator[str]:
        loss = "" if data["loss"] is None else f", {data['loss']:.2f} dB below the field ({data['psnr']:.2f}) at the held-out views"
        size, before = data["bytes"] / 1e6, data["field_bytes"] / 1e6
        yield f"{data['voxels']:,} voxels in {size:.1f} MB (field: {before:.1f} MB){loss}: {data['to']}"

    show(data, options, lines)


def bake_run(place: Place, options: dict[str, Any], seen: float, to: Path | None, quiet: bool) -> dict[str, Any]:
    """Bake the field of a run, write it, read it back, and compare both at the held-out views.

    Returns:
        `to`, `bytes` and `field_bytes`, `voxels` and `field_voxels`, and the mean `psnr` of the field and the `loss` of the baked one at
        the held-out views (null when there are none).

    Raises:
        InputError: a folder without a field and without its source, or a decoder that cannot be baked.
        OutputError: the file cannot be written.
    """
    import numpy as np

    from fieldfuse.evaluation.metrics import psnr
    from fieldfuse.evaluation.score import as_photo, entry
    from fieldfuse.pipelines.console import make_progress
    from fieldfuse.pipelines.fields import finished_field
    from fieldfuse.pipelines.job import open_job
    from fieldfuse.pipelines.pictures import baked, baked_place
    from fieldfuse.pipelines.prepare import prepare
    from fieldfuse.pipelines.rendered import to_picture
    from fieldfuse.pipelines.stages import BEFORE
    from fieldfuse.render.bake_file import read_baked, write_baked
    from fieldfuse.render.image import make_renderer, render_view

    with open_job(place, options, make_progress(quiet), (*BEFORE, "field")) as job:
        ready = prepare(job)
        views, field = ready.views, finished_field(job, ready).field.to("cpu")
        target = to or baked_place(job)
        with job.progress.stage("bake"):
            write_baked(target, baked(job, field, views, seen), ready.scene.working_from_input)
            small = read_baked(target)
            shown = [(one, make_renderer(one)) for one in (field, small.to_field())]
            scores = []
            for index in map(int, np.flatnonzero(views.test)):
                job.progress.check()
                lens, pose = views.intrinsics[index], views.world_from_camera[index]
                truth, valid = views.photo(index), entry(views.valid, index)
                # In 8 bits, as the report's are: without them a good field would have some hundredths of a decibel more here.
                renders = [to_picture(render_view(one, lens, pose, view)) for one, view in shown]
                pair = [psnr(as_photo(render, views, index), truth, valid) for render in renders]
                if None not in pair:
                    scores.append(pair)
    mean = np.mean(np.array(scores, np.float64), 0) if scores else None
    return {
        "to": str(target),
        "bytes": target.stat().st_size,
        "field_bytes": field.bytes,
        "voxels": small.voxels,
        "field_voxels": field.voxels,
        "psnr": None if mean is None else round(float(mean[0]), 3),
        "loss": None if mean is None else round(float(mean[0] - mean[1]), 3),
    }
