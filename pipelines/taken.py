"""Pictures as they were taken: a fit has smaller ones, and what is made of its field may have more of them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from fieldfuse.errors import InputError
from fieldfuse.export.surface import Originals

if TYPE_CHECKING:
    from fieldfuse.capture.types import Capture, Views
    from fieldfuse.pipelines.job import Job

MESHES = ("ply", "obj", "glb")  # as `export.formats` has them
TEXTURE = "texture"
SURFACES = {"points", *MESHES, TEXTURE}
GONE = (
    "the folder of the capture, {}, is not there any more, and its pictures are needed; put it back (or repeat the run's own command with "
    "its new place) and run the command again"
)
LOST = "the capture's picture {} is not there any more; put it back and run the command again"
WITHOUT = "the finer field's points and meshes cannot be made: {}, or leave them out with --set 'export.formats=[{}]'"


def needs_originals(job: Job, formats: Iterable[str]) -> list[tuple[str, set[str], int]]:
    """What of `formats` is made of pictures as they were taken: how a sentence on it begins, the formats, and the pictures' long side."""
    surfaces, export = SURFACES & set(formats), job.settings.export
    found = [("points and meshes were", surfaces, export.mesh_size), ("the texture was", surfaces & {TEXTURE}, export.texture_size)]
    return [one for one in found if one[1]]


def missing_originals(job: Job, posed: Capture, views: Views, side: int) -> str | None:
    """A sentence when `Originals.at` could not read the training pictures, since they are gone."""
    train = np.flatnonzero(~views.test)
    shown = views.subset(train)
    if Originals(posed).at(train, shown, side)[0] == shown.intrinsics:
        return None  # the run has them
    lost = next((path for index in train if not (path := posed.frames[index].image).is_file()), None)
    if lost is None:
        return None
    return LOST.format(lost) if posed.root.is_dir() or lost.is_relative_to(job.folder.path) else GONE.format(posed.root)


def require_originals(job: Job, posed: Capture, views: Views) -> None:
    """Before a field is replaced: what the run exports can be made of the next one, too. The run's settings stay as they were, else.

    Raises:
        InputError: the capture's pictures are needed for that, and are gone.
    """
    formats = job.settings.export.formats
    for _, _, side in needs_originals(job, formats):
        if gone := missing_originals(job, posed, views, side):
            job.folder.restore()
            raise InputError(WITHOUT.format(gone, ",".join(name for name in formats if name not in SURFACES)))
