"""The surface of a field: its depth at the training cameras, polished by the training images as they were taken, made to agree, fused."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from fieldfuse import memory
from fieldfuse.camera import Array, Intrinsics
from fieldfuse.capture.types import Capture, Views
from fieldfuse.config import ExportSettings, Settings
from fieldfuse.memory import PICTURE_BYTES, SURFACE_BYTES, pixels, require_pictures
from fieldfuse.progress import SILENT, Progress

if TYPE_CHECKING:
    from fieldfuse.effects.correct import Corrections
    from fieldfuse.poses.scene import Scene
    from fieldfuse.render.field import Field
    from fieldfuse.tsdf.mesh import Mesh
    from fieldfuse.tsdf.volume import TsdfVolume

SMALL_PART = 0.002  # components of a mesh with less than this share of its area are specks
RENDERED_SIDE = 400  # pixels; the images show what is finer (`export.mesh_size`), and rendering it takes long


def spread(count: int, most: int) -> list[int]:
    """At most `most` of `count` indices, evenly spread."""
    return sorted({round(i) for i in np.linspace(0, count - 1, min(count, most))}) if count and most else []


def at_most(lens: Intrinsics, long_side: int) -> Intrinsics:
    """The camera, made smaller if its long side is larger; sides stay even, as video needs."""
    factor = min(1.0, long_side / max(lens.width, lens.height))
    if factor == 1.0:
        return lens
    return lens.scaled(*(max(2, round(side * factor / 2) * 2) for side in (lens.width, lens.height)))


@dataclass(frozen=True)
class Originals:
    """The images as they were taken, of which a fit has smaller ones.

    Attributes:
        posed: the capture whose frames are the views, in the same order.
        corrections: of colours, as the views have them.
    """

    posed: Capture
    corrections: Corrections | None = None

    def at(self, indices: Array, shown: Views, side: int) -> tuple[list[Intrinsics], Iterable[Array]]:
        """Cameras and images of the frames `indices`, which are the views `shown`: as large as they were taken, up to `side` pixels along
        the long side, corrected as those of the fit, and read one at a time; those of the fit where the originals are no larger."""
        from fieldfuse.capture.prepare import images_at, target_size

        lenses = []
        for index, small in zip(indices, shown.intrinsics, strict=True):
            taken = self.posed.frames[index].intrinsics
            size = (small.width, small.height) if taken is None else target_size(taken.width, taken.height, side)
            lenses.append(small.scaled(*size) if max(size) > max(small.width, small.height) else small)
        if all(lens == small for lens, small in zip(lenses, shown.intrinsics, strict=True)):
            return lenses, shown.images

        def read() -> Iterator[Array]:
            import cv2

            for lens, name, (_, image) in zip(lenses, shown.names, images_at(self.posed, indices, side), strict=True):
                if image.shape[:2] != (lens.height, lens.width):
                    image = cv2.resize(image, (lens.width, lens.height), interpolation=cv2.INTER_AREA)
                tone = None if self.corrections is None else self.corrections.tone(name)
                yield image if tone is None else tone.undone(image, lens)[0]

        return lenses, read()

    def finer(self, views: Views, train: Array, export: ExportSettings) -> tuple[Views, list[Intrinsics]]:
        """The views `train` with their images as they were taken, and the cameras of depth maps for them, `export.mesh_size` at most.

        Where there is too little memory for that, images stay as large as the fit has them.
        """
        side, shown = export.mesh_size, views.subset(train)
        lenses, images = self.at(train, shown, side)
        rendered = min(1.0, export.mesh_views / max(len(lenses), 1))
        wanted = int((PICTURE_BYTES + SURFACE_BYTES * rendered) * sum(map(pixels, lenses)))
        if lenses != shown.intrinsics and memory.bounded(wanted) < wanted:
            lenses, images = shown.intrinsics, shown.images
        return replace(shown, images=list(images), intrinsics=lenses), [at_most(lens, side) for lens in lenses]


def surface_of_field(
    field: Field, views: Views, scene: Scene, settings: Settings, originals: Originals, progress: Progress = SILENT
) -> TsdfVolume:
    """The field's surface in the region of interest, working frame. Held-out images are not looked at.

    Raises:
        InputError: the field has no surface, or there is too little memory.
        Interrupted: the user asked to stop.
    """
    from fieldfuse.export.surface import field_volume
    from fieldfuse.render.image import make_renderer, render_view
    from fieldfuse.stereo.depth_refinement import FieldDepths, Polisher, settled

    shown, cameras = originals.finer(views, np.flatnonzero(~views.test), settings.export)
    chosen = spread(len(shown), settings.export.mesh_views)
    lenses = [cameras[index] for index in chosen]
    require_pictures(lenses, kept=True, advice="lower export.mesh_views or export.mesh_size", each=SURFACE_BYTES)
    view = make_renderer(field, settings.engine)
    polisher = Polisher(shown, cameras, scene.near, scene.far, scene.median_depth)
    seen = shown.subset(np.array(chosen))
    measured = seen.depths if settings.fit.depth > 0 and settings.fit.depth_from != "off" else []
    return field_volume(
        lambda lens, pose: render_view(field, at_most(lens, RENDERED_SIDE), pose, view),
        shown.world_from_camera[chosen],
        lenses,
        region=scene.surface_box(),
        polish=[partial(polisher.polished, index, measured=measured[at] if measured else None) for at, index in enumerate(chosen)],
        settle=lambda *given: settled(FieldDepths(*given), seen, lenses, scene.median_depth, measured, progress),
        progress=progress,
    )


def whole_mesh(volume: TsdfVolume, smooth: int) -> Mesh:
    """The volume's surface without specks, smoothed `smooth` times."""
    return volume.mesh().cleaned(min_area_share=SMALL_PART).smoothed(smooth)
