"""How much memory a fit takes: what the start needs is refused with numbers, a finer level that does not fit is not made."""

from __future__ import annotations

import torch

from fieldfuse import memory
from fieldfuse.capture.types import Views
from fieldfuse.config import Settings
from fieldfuse.errors import InputError
from fieldfuse.render.field import Field
from fieldfuse.training.engine import chosen_engine
from fieldfuse.training.schedule import Schedule
from fieldfuse.volume.topology import BLOCK, VOXELS

POOL_BYTES = 15  # a pixel: colour, distance, and where some are left out its place, that twice while they are put together
HALF = BLOCK // 2
WRITTEN, TOUCHED = 0.85, 0.5  # shares of a level's rows: that lie in pages with corners of voxels, that a gradient comes to
SUMS = 2**23  # bytes a thread, for the gradients of a batch
BESIDE = 1.5  # blocks at a finer level, by those that hold voxels: some hold nothing but corners of their neighbours' voxels


def row_bytes(settings: Settings, device: torch.device) -> int:
    """Memory of one lattice corner at its most, with engines that hold all of it: its values, gradients and the optimiser's state."""
    channels = settings.field.channels
    values = 4 * (1 + channels)
    if chosen_engine(settings, device) == "torch":
        return values + 4 * (channels + 3) + 8
    return 3 * values + 4 + 1  # gradients and moments; steps and a mark


def require_start(views: Views, start: Field | None, settings: Settings, device: torch.device) -> None:
    """Refuse a fit whose pixels, or whose field to go on from, do not fit.

    Raises:
        InputError: with what is needed and what is free.
    """
    pixels = sum(image.shape[0] * image.shape[1] for image in views.images)
    memory.require(POOL_BYTES * pixels, f"a fit to {pixels / 1e6:.0f} million pixels", "lower --image-size, or give fewer pictures")
    if start is not None:
        if chosen_engine(settings, device) == "numba":
            needed = compiled_bytes(start, torch.ones_like(start.occupied), start.resolution, settings, replaced=False)
        else:
            needed = 2 * len(start.density_rows) * row_bytes(settings, device)
        where = f"going on from a field of {start.blocks:,} blocks"
        there = _there(device)
        if there is not None and needed > there:
            sizes = f"about {needed / memory.GIB:.1f} GB of memory and {there / memory.GIB:.1f} GB is free"
            raise InputError(f"{where} needs {sizes}; fit it anew")


def compiled_bytes(field: Field, keep: torch.Tensor, finer: int, settings: Settings, replaced: bool = True) -> int:
    """Memory that the compiled engine takes beyond what there is when the voxels `keep` (M · 512,) go on in a lattice of `finer` voxels a
    side: while rows are made, or while they are fitted, whichever is more, less the memory of the field's rows if they are `replaced`.
    Blocks are counted; what of a level's rows is written to and touched is what it was on captures."""
    from fieldfuse.volume.compiled import corner_nodes, finer_blocks

    channels, threads = settings.field.channels, settings.threads or torch.get_num_threads()
    values, kept = 4 * (1 + channels), field.occupied & keep
    rows = VOXELS * len(finer_blocks(field.topology, kept, finer / field.resolution))
    packed = int(corner_nodes(field.topology, kept).sum()) * values
    layers = corner_nodes(field.topology, field.occupied).view(-1, BLOCK * BLOCK).any(1)  # a layer of a block is a page
    freed = int(layers.sum()) * BLOCK * BLOCK * values if replaced else 0
    fitted = rows * (WRITTEN * values + 4 + threads * (4 + 2) + TOUCHED * 2 * (2 + channels)) + threads * SUMS
    return max(0, max(rows * (values + 3) + packed, int(fitted)) - freed)


def level_rows(keep: torch.Tensor, ratio: float) -> int:
    """About how many lattice corners a level has that is `ratio` times as fine, where the voxels `keep` (M · 512,) stay."""
    bricks = keep.view(-1, 2, HALF, 2, HALF, 2, HALF).any(6).any(4).any(2)
    return int(BESIDE * int(bricks.sum()) * (ratio / 2) ** 3 * VOXELS)


def fits(field: Field, keep: torch.Tensor, plan: Schedule, settings: Settings, notes: list[str]) -> bool:
    """Whether there is room for the next level; when not, the level at hand is the last, and `notes` says so with the numbers."""
    finer = plan.ladder[plan.level + 1]
    if chosen_engine(settings, field.device) == "numba":
        needed = compiled_bytes(field, keep, finer, settings)
    else:
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
