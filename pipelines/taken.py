"""Pictures as they were taken: a fit has smaller ones, and what is made of its field may have more of them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

from toolkit.camera import Array, Intrinsics

if TYPE_CHECKING:
    from pipelines.job import Job
    from toolkit.capture.types import Capture, Views


def as_taken(job: Job, posed: Capture, indices: Array, shown: Views, side: int) -> tuple[list[Intrinsics], Iterable[Array]]:
    """Cameras and pictures of the frames `indices`, which are the views `shown`: as large as they were taken, up to `side` pixels along
    the long side, corrected as those of the fit, and read one at a time; those of the fit where the originals are no larger."""
    from toolkit.capture.prepare import pictures_at, target_size
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
