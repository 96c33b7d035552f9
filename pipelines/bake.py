"""`fieldfuse bake DIR`: a run's field as a small file that is rendered straight from disk."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from fieldfuse.pipelines.baking import SEEN
from fieldfuse.pipelines.options import Options, Place, bound_threads, show, takes


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
    import torch

    from fieldfuse.evaluation.images import psnr
    from fieldfuse.evaluation.score import as_photo
    from fieldfuse.pipelines.baking import default_place, write
    from fieldfuse.pipelines.console import make_progress
    from fieldfuse.pipelines.fields import finished_field
    from fieldfuse.pipelines.job import open_job
    from fieldfuse.pipelines.prepare import prepare
    from fieldfuse.pipelines.rendered import to_picture
    from fieldfuse.pipelines.stages import BEFORE
    from fieldfuse.render.bake_image import BakedRenderer
    from fieldfuse.render.image import make_renderer, render_view

    with open_job(place, options, make_progress(quiet), (*BEFORE, "field")) as job:
        ready = prepare(job)
        scene, views = ready.scene, ready.views
        field = finished_field(job, ready).field.to("cpu")
        job.progress.begin("bake")
        start = time.monotonic()
        target = to or default_place(job)
        baked = write(job, field, views, scene, seen, target)
        renderer, view = BakedRenderer(baked, torch.get_num_threads()), make_renderer(field)
        scores = []
        for index in np.flatnonzero(views.test):
            job.progress.check()
            lens, pose = views.intrinsics[index], views.world_from_camera[index]
            truth = views.photo(int(index))
            valid = views.valid[index] if views.valid else None
            # In 8 bits, as the report's are: without them a good field would have some hundredths of a decibel more here.
            pictures = to_picture(render_view(field, lens, pose, view)), to_picture(renderer.render(lens, pose))
            pair = [psnr(as_photo(picture, views, int(index)), truth, valid) for picture in pictures]
            if None not in pair:
                scores.append(pair)
        job.progress.finish("bake", time.monotonic() - start, False)
    mean = np.mean(np.array(scores, np.float64), 0) if scores else None
    return {
        "to": str(target),
        "bytes": target.stat().st_size,
        "field_bytes": field.bytes,
        "voxels": baked.voxels,
        "field_voxels": field.voxels,
        "psnr": None if mean is None else round(float(mean[0]), 3),
        "loss": None if mean is None else round(float(mean[0] - mean[1]), 3),
    }
