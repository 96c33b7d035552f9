"""Memory that the later stages need, estimated before each begins; what does not fit is refused with the numbers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from fieldfuse import memory
from fieldfuse.camera import Intrinsics

if TYPE_CHECKING:
    from fieldfuse.capture.types import Views
    from fieldfuse.render.field import Field

# Measured at 900×900: 200 bytes a pixel for a picture by torch (34 by a baked field), 240 for SSIM, 201 for LPIPS, 110 for PSNR.
RENDER_BYTES = 260  # a pixel of the picture that is being rendered: rays, samples of a part of them, colour, depth, opacity
SCORE_BYTES = 320  # a pixel of the picture that is being scored
KEPT_BYTES = 8  # a pixel of a picture that is kept until all are there: colour, depth, mask
SURFACE_BYTES = 40  # the same when depth maps are made to agree before they become a surface: 33 measured
PICTURE_BYTES = 8  # of a picture that depth is polished by: its colours, and its grey levels with those beside them
ROW_COPIES = 3  # of a field's values while it is baked: its own, sorted ones for the range, the bytes
MESH_COPIES = 6  # of a mesh file's size in memory while meshes are compared: float64, a tree to search in, samples


def pixels(lens: Intrinsics) -> int:
    return lens.width * lens.height


def require_pictures(lenses: Sequence[Intrinsics], kept: bool, advice: str = "lower --image-size", each: int = KEPT_BYTES) -> None:
    """Refuse to render pictures, all of which are held in memory when they are `kept` (`each` byte a pixel), that do not fit.

    Raises:
        InputError: with what is needed and what is free.
    """
    if lenses:
        largest, whole = max(map(pixels, lenses)), sum(map(pixels, lenses)) if kept else 0
        what = f"rendering {len(lenses)} pictures of up to {largest / 1e6:.1f} million pixels"
        memory.require(RENDER_BYTES * largest + each * whole, what, advice)


def require_scores(views: Views, methods: int) -> None:
    """Refuse to score the held-out pictures of so many methods when a picture's measures do not fit.

    Raises:
        InputError: with what is needed and what is free.
    """
    lenses = [lens for lens, test in zip(views.intrinsics, views.test, strict=True) if test]
    if lenses:
        largest = max(map(pixels, lenses))
        what = f"scoring {methods * len(lenses)} pictures of up to {largest / 1e6:.1f} million pixels"
        memory.require(SCORE_BYTES * largest, what, "run again with a lower --image-size")


def require_baking(field: Field) -> None:
    """Refuse to bake a field whose copies do not fit.

    Raises:
        InputError: with what is needed and what is free.
    """
    size = sum(values.numel() * values.element_size() for values in (field.density_rows, field.feature_rows))
    memory.require(ROW_COPIES * size, f"baking a field of {field.blocks:,} blocks", "fit it at a lower resolution (field.resolution)")


def require_meshes(paths: Sequence[Path]) -> None:
    """Refuse to compare meshes that do not fit.

    Raises:
        InputError: with what is needed and what is free.
    """
    size = sum(path.stat().st_size for path in paths if path.is_file())
    memory.require(MESH_COPIES * size, f"comparing {len(paths)} meshes", "make them with a coarser tsdf.voxel_size")


def require_file(path: Path, what: str) -> None:
    """Refuse to read a file of prepared data whose content does not fit; a file that is not there is another's concern.

    Raises:
        InputError: with what is needed and what is free.
    """
    if path.is_file():
        memory.require(path.stat().st_size, what, "run again with a lower --image-size, or give fewer pictures")
