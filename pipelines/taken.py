"""Pictures as they were taken: a fit has smaller ones, and what is made of its field may have more of them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

import numpy as np

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.errors import InputError

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
    """A sentence when `as_taken` could not read the training pictures, since they are gone."""
    train = np.flatnonzero(~views.test)
    shown = views.subset(train)
    if as_taken(job, posed, train, shown, side)[0] == shown.intrinsics:
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


def as_taken(job: Job, posed: Capture, indices: Array, shown: Views, side: int) -> tuple[list[Intrinsics], Iterable[Array]]:
    """Cameras and pictures of the frames `indices`, which are the views `shown`: as large as they were taken, up to `side` pixels along
    the long side, corrected as those of the fit, and read one at a time; those of the fit where the originals are no larger."""
    from fieldfuse.capture.prepare import pictures_at, target_size
    found = job.corrections
    lenses = []
    for index, small in zip(indices, shown.intrinsics, strict=True):
        taken = posed.frames[index].intrinsics
        size = (small.width, small.height) if taken is None else target_size(taken.width, taken.height, side)
        lenses.append(small.scaled(*size) if max(size) > max(small.width, small.height) else small)
    if all(lens == small for lens, small in zip(lenses, shown.intrinsics, strict=True)):
        return lenses, shown.images

    def read() -> Iterator[Array]:
        import cv2

        for lens, name, (_, picture) in zip(lenses, shown.names, pictures_at(posed, indices, side), strict=True):
            if picture.shape[:2] != (lens.height, lens.width):
                picture = cv2.resize(picture, (lens.width, lens.height), interpolation=cv2.INTER_AREA)
            tone = None if found is None else found.tone(name)
            yield picture if tone is None else tone.undone(picture, lens)[0]

    return lenses, read()
