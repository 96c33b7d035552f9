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
from fieldfuse.volume.compiled import finer_blocks
from fieldfuse.volume.edit import corner_nodes
from fieldfuse.volume.topology import BLOCK, VOXELS

POOL_BYTES = 15  # a pixel: colour, distance, and where some are left out its place, that twice while they are put together
WRITTEN, TOUCHED = 0.85, 0.5  # shares of a level's rows: that lie in pages with corners of voxels, that a gradient comes to
SUMS = 2**23  # bytes a thread, for the gradients of a batch


def require_start(views: Views, start: Field | None, settings: Settings, device: torch.device) -> None:
    """Refuse a fit whose pixels, or whose field to go on from, do not fit.

    Raises:
        InputError: with what is needed and what is free.
    """
    pixels = sum(image.shape[0] * image.shape[1] for image in views.images)
    memory.require(POOL_BYTES * pixels, f"a fit to {pixels / 1e6:.0f} million pixels", "lower --image-size, or give fewer images")
    if start is None:
        return
    needed = level_bytes(start, torch.ones_like(start.occupied), start.resolution, settings, replaced=False)
    free = _free(device)
    if free is not None and needed > free:
        sizes = f"about {needed / memory.GIB:.1f} GB of memory and {free / memory.GIB:.1f} GB is free"
        raise InputError(f"going on from a field of {start.blocks:,} blocks needs {sizes}; fit it anew")


def level_bytes(field: Field, keep: torch.Tensor, finer: int, settings: Settings, replaced: bool = True) -> int:
    """Memory that an engine takes beyond what there is when the voxels `keep` (M · 512,) go on in a lattice of `finer` voxels a side.

    Blocks are counted; what of a level's rows is written to and touched is what it was on captures. On the CPU it is what is needed while
    rows are made, or while they are fitted, whichever is more, less the memory of the field's rows if they are `replaced`.
    """
    channels, threads = settings.field.channels, settings.threads or torch.get_num_threads()
    values, kept = 4 * (1 + channels), field.occupied & keep
    rows = VOXELS * len(finer_blocks(field.topology, kept, finer / field.resolution))
    engine = chosen_engine(settings, field.device)
    if engine != "numba":  # these hold all of it: values, gradients, the optimiser's state
        return rows * (values + 4 * (channels + 3) + 8 if engine == "torch" else 3 * values + 4 + 1)
    packed = int(corner_nodes(field.topology, kept).sum()) * values
    layers = corner_nodes(field.topology, field.occupied).view(-1, BLOCK * BLOCK).any(1)  # a layer of a block is a page
    freed = int(layers.sum()) * BLOCK * BLOCK * values if replaced else 0
    fitted = rows * (WRITTEN * values + 4 + threads * (4 + 2) + TOUCHED * 2 * (2 + channels)) + threads * SUMS
    return max(0, max(rows * (values + 3) + packed, int(fitted)) - freed)


def fits(field: Field, keep: torch.Tensor, plan: Schedule, settings: Settings, notes: list[str]) -> bool:
    """Whether there is room for the next level; when not, the level at hand is the last, and `notes` has the numbers."""
    finer, free = plan.ladder[plan.level + 1], _free(field.device)
    needed = level_bytes(field, keep, finer, settings)
    if free is None or needed <= free:
        return True
    del plan.ladder[plan.level + 1 :]
    notes.append(
        f"the field stayed at {field.resolution}³, because {finer}³ would take about {needed / memory.GIB:.1f} GB of memory and "
        f"{free / memory.GIB:.1f} GB is free"
    )
    return False


def _free(device: torch.device) -> int | None:
    if device.type == "cuda":
        return int(torch.cuda.mem_get_info(device)[0])
    free = memory.available()
    return None if free is None else max(0, free - memory.SPARE)
