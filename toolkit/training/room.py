"""How much memory a fit takes: what the start needs is refused with numbers, a finer level that does not fit is not made."""

from __future__ import annotations

import torch

from toolkit import memory
from toolkit.capture.types import Views
from toolkit.config import Settings
from toolkit.errors import InputError
from toolkit.render.field import Field
from toolkit.training.engine import chosen_engine
from toolkit.training.schedule import Schedule
from toolkit.volume.topology import BLOCK, VOXELS

POOL_BYTES = 15  # a pixel: colour, distance, and where some are left out its place, that twice while they are put together
HALF = BLOCK // 2
BESIDE = 1.5  # blocks at a finer level, by those that hold voxels: some hold nothing but corners of their neighbours' voxels


def row_bytes(settings: Settings, device: torch.device) -> int:
    """Memory of one lattice corner at its most: its values, the optimiser's state, and what threads gather for it."""
    channels, threads = settings.field.channels, settings.threads or torch.get_num_threads()
    values = 4 * (1 + channels)
    chosen = chosen_engine(settings, device)
    if chosen == "torch":
        return values + 4 * (channels + 3) + 8
    if chosen == "triton":
        return 3 * values + 4 + 1  # gradients and moments; steps and a mark
    return values + 4 + threads * (4 + 10 + 4 * channels + 2 * (2 + channels))  # moments have two bytes


def require_start(views: Views, start: Field | None, settings: Settings, device: torch.device) -> None:
    """Refuse a fit whose pixels, or whose field to go on from, do not fit.

    Raises:
        InputError: with what is needed and what is free.
    """
    pixels = sum(image.shape[0] * image.shape[1] for image in views.images)
    memory.require(POOL_BYTES * pixels, f"a fit to {pixels / 1e6:.0f} million pixels", "lower --image-size, or give fewer pictures")
    if start is not None:
        needed = 2 * len(start.density_rows) * row_bytes(settings, device)
        where = f"going on from a field of {start.blocks:,} blocks"
        there = _there(device)
        if there is not None and needed > there:
            sizes = f"about {needed / memory.GIB:.1f} GB of memory and {there / memory.GIB:.1f} GB is free"
            raise InputError(f"{where} needs {sizes}; fit it anew")


def level_rows(keep: torch.Tensor, ratio: float) -> int:
    """About how many lattice corners a level has that is `ratio` times as fine, where the voxels `keep` (M · 512,) stay."""
    bricks = keep.view(-1, 2, HALF, 2, HALF, 2, HALF).any(6).any(4).any(2)
    return int(BESIDE * int(bricks.sum()) * (ratio / 2) ** 3 * VOXELS)


def fits(field: Field, keep: torch.Tensor, plan: Schedule, settings: Settings, notes: list[str]) -> bool:
    """Whether there is room for the next level; when not, the level at hand is the last, and `notes` says so with the numbers."""
    finer = plan.ladder[plan.level + 1]
    needed = level_rows(keep, finer / field.resolution) * row_bytes(settings, field.device)
    there = _there(field.device)
    if there is None or needed <= there:
        return True
    del plan.ladder[plan.level + 1 :]
    notes.append(
        f"the field stayed at {field.resolution}³, because {finer}³ would take about {needed / memory.GIB:.1f} GB of memory and "
        f"{there / memory.GIB:.1f} GB is free"
    )
    return False


def _there(device: torch.device) -> int | None:
    if device.type == "cuda":
        return int(torch.cuda.mem_get_info(device)[0])
    there = memory.available()
    return None if there is None else max(0, there - memory.SPARE)
