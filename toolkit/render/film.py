"""The many frames of a film: where a picture is smooth, only some of its pixels are rendered."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from functools import partial

import numpy as np
import torch

from fieldfuse.camera import Array, Intrinsics, rays
from fieldfuse.progress import SILENT, Progress
from fieldfuse.render.field import Field
from fieldfuse.render.image import View, make_renderer, render_view
from fieldfuse.render.sky import on_sky
from fieldfuse.threads import in_order

SMOOTH = 8 / 255  # between pixels whose colours differ by less, the mean will do: frames are 47 to 60 dB from whole renders


def film(field: Field, lenses: Sequence[Intrinsics], poses: Array, progress: Progress = SILENT) -> Iterator[Array]:
    """(H, W, 3) float32 colours of each pinhole camera (N, 4, 4), working frame, in order.

    On the CPU frames are made side by side, as `refined` makes them; elsewhere whole.

    Raises:
        Interrupted: the user asked to stop.
    """
    on_cpu = field.device.type == "cpu"
    threads = torch.get_num_threads() if on_cpu else 1
    view = make_renderer(field, threads=1) if on_cpu else make_renderer(field)

    def frame(index: int) -> Array:
        lens, pose = lenses[index], poses[index]
        return refined(lens, partial(_colours, field, view, lens, pose)) if on_cpu else render_view(field, lens, pose, view).rgb

    with closing(in_order(frame, range(len(lenses)), threads)) as frames:
        for index, made in enumerate(frames):
            progress.check()
            progress.update(index + 1, len(lenses))
            yield made


def _colours(field: Field, view: View, lens: Intrinsics, pose: Array, pixels: Array) -> Array:
    """(N, 3) at (N, 2) pixel centres."""
    origins, directions, _ = rays(lens, pose, pixels)
    values = view(origins, directions)
    return on_sky(values.colour, values.opacity, directions, field.background, field.sky).numpy()


def refined(lens: Intrinsics, colours: Callable[[Array], Array]) -> Array:
    """(H, W, 3) float32: every second pixel of every second row is rendered; then those between four, then those between these, if the
    four differ by more than `SMOOTH` in a channel, else they are their mean.

    Args:
        colours: (N, 2) pixel centres → (N, 3).
    """
    height, width = lens.height, lens.width
    out = np.zeros((height + height % 2, width + width % 2, 3), np.float32)

    def fill(row: int, column: int, around: Sequence[Array] | None) -> None:
        place = out[row::2, column::2]
        wanted = np.ones(place.shape[:2], bool)
        if around is not None:
            low = high = total = around[0]
            for one in around[1:]:
                low, high, total = np.minimum(low, one), np.maximum(high, one), total + one
            place[:] = total / len(around)
            wanted = (high - low).max(axis=2) > SMOOTH
        v, u = np.nonzero(wanted)
        if len(v):
            place[wanted] = colours(np.stack([2 * u + column + 0.5, 2 * v + row + 0.5], axis=1))

    fill(0, 0, None)
    known = np.pad(out[::2, ::2], ((0, 1), (0, 1), (0, 0)), mode="edge")
    fill(1, 1, [known[:-1, :-1], known[1:, :-1], known[:-1, 1:], known[1:, 1:]])
    even, odd = np.pad(out[::2, ::2], ((0, 1), (0, 1), (0, 0)), mode="edge"), np.pad(out[1::2, 1::2], ((1, 0), (1, 0), (0, 0)), mode="edge")
    fill(0, 1, [even[:-1, :-1], even[:-1, 1:], odd[:-1, 1:], odd[1:, 1:]])
    fill(1, 0, [even[:-1, :-1], even[1:, :-1], odd[1:, :-1], odd[1:, 1:]])
    return out[:height, :width]
