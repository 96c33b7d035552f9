"""The many frames of a film: where a picture is smooth, only some of its pixels are rendered."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing

import torch

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.progress import SILENT, Progress
from fieldfuse.render.coarse_to_fine import colours_of
from fieldfuse.render.field import Field
from fieldfuse.render.image import make_renderer, render_view
from fieldfuse.threads import in_order

COARSEST = 4  # pixels: frames are 47 to 55 dB from whole renders, which is less than H.264 takes


def film(field: Field, lenses: Sequence[Intrinsics], poses: Array, progress: Progress = SILENT) -> Iterator[Array]:
    """(H, W, 3) float32 colours of each pinhole camera (N, 4, 4), working frame, in order.

    On the CPU frames are made side by side, from coarse to fine; elsewhere whole.

    Raises:
        Interrupted: the user asked to stop.
    """
    on_cpu = field.device.type == "cpu"
    threads = torch.get_num_threads() if on_cpu else 1
    view = make_renderer(field, threads=1) if on_cpu else make_renderer(field)

    def frame(index: int) -> Array:
        lens, pose = lenses[index], poses[index]
        return colours_of(field, view, lens, pose, COARSEST) if on_cpu else render_view(field, lens, pose, view).rgb

    with closing(in_order(frame, range(len(lenses)), threads)) as frames:
        for index, made in enumerate(frames):
            progress.check()
            progress.update(index + 1, len(lenses))
            yield made
