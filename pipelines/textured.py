"""A mesh with a texture of the training images, as large as they were taken."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fieldfuse.export.surface import Originals
from fieldfuse.pipelines.stages import Stage
from fieldfuse.tone import exposed

if TYPE_CHECKING:
    from fieldfuse.pipelines.job import Job
    from fieldfuse.pipelines.prepare import Prepared
    from fieldfuse.tsdf.mesh import Mesh

TSDF_TEXTURE = "tsdf_texture"  # the stage
TEXTURED = "textured.glb"
TRIANGLES = 80_000  # detail is in the texture
TEXEL_BYTES = 40  # while a texture is made and packed


def texture_tsdf(job: Job, ready: Prepared) -> None:
    """`tsdf/textured.glb`, a stage of its own: what the TSDF's seconds are compared with has no texture in it."""
    path = job.folder / "tsdf" / TEXTURED

    def make() -> Path:
        from fieldfuse.evaluation.geometry import read_mesh

        mesh = read_mesh(path.with_name("mesh.ply")).transformed(ready.scene.working_from_input)
        put_textured(job, ready, [path], mesh.with_normals())
        return path

    settings = [job.settings.export.texture_size, TRIANGLES]
    job.run(Stage(TSDF_TEXTURE, make, lambda made: [made], lambda: path, ["tsdf", "views"], settings, version=2))


def put_textured(job: Job, ready: Prepared, paths: Iterable[Path], mesh: Mesh) -> None:
    """A coarser mesh (working frame, with normals) with a texture of the training images, in the input's frame, as .glb or .usdz."""
    from fieldfuse import memory
    from fieldfuse.export.mesh import write_textured
    from fieldfuse.export.texture import LARGEST, Photos, textured
    from fieldfuse.export.usd import write_usdz

    largest = LARGEST
    while largest > 1024 and TEXEL_BYTES * largest**2 > memory.bounded(TEXEL_BYTES * LARGEST**2):
        largest //= 2
    thin = mesh.decimated(TRIANGLES)
    train, shown = np.flatnonzero(~ready.views.test), ready.training
    lenses, images = Originals(ready.posed, ready.corrections).at(train, shown, job.settings.export.texture_size)
    photos = Photos(images, lenses, shown.world_from_camera, shown.valid, shown.weight)
    atlas, texture = textured(thin, photos, largest, job.progress)
    texture = exposed(texture, ready.views.exposure)
    for path in paths:
        write = write_usdz if path.suffix == ".usdz" else write_textured
        write(path, thin, atlas, texture, ready.scene.working_from_input)
