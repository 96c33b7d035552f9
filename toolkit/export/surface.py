"""The surface of a field: its depth at the training cameras, polished by the training images as they were taken, made to agree, fused."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import cv2
import numpy as np

from fieldfuse import memory
from fieldfuse.camera import Array, Intrinsics
from fieldfuse.capture.types import Capture, Views
from fieldfuse.config import ExportSettings, Settings
from fieldfuse.errors import InputError
from fieldfuse.memory import PICTURE_BYTES, SURFACE_BYTES, pixels, require_pictures
from fieldfuse.poses.region import Region
from fieldfuse.progress import SILENT, Progress

if TYPE_CHECKING:
    from fieldfuse.effects.correct import Corrections
    from fieldfuse.poses.scene import Scene
    from fieldfuse.render.field import Field
    from fieldfuse.render.image import Rendered
    from fieldfuse.tsdf.mesh import Mesh
    from fieldfuse.tsdf.volume import DepthFrame, TsdfVolume

SMALL_PART = 0.002  # components of a mesh with less than this share of its area are specks
RENDERED_SIDE = 400  # pixels; the images show what is finer (`export.mesh_size`), and rendering it takes long
STEEPEST = 4.0  # tangent of the angle between view and surface normal (76°) beyond which a depth step is taken as an edge
OPAQUE = 0.7  # opacity from which a pixel has a surface
SMALLEST_EDGE = 0.02  # share of depth: smaller steps are never an edge
AFTERWARDS = 0.2  # of the time that rendering takes, for the progress

Render = Callable[[Intrinsics, Array], "Rendered"]  # intrinsics, world_from_camera → colour, depth, opacity


@dataclass(frozen=True)
class Refinement:
    """What makes rendered depth better.

    Attributes:
        polish: for each view, depth (H, W) → better depth, 0 = none, and bool where images show it; see `stereo/depth_refinement.py`.
        settle: of all views the reliable depth, all depth that is opaque enough, and where images show it → better depth, 0 = none; see
            `stereo/depth_refinement.py`.
    """

    polish: Sequence[Callable[[Array], tuple[Array, Array]]] | None = None
    settle: Callable[[list[Array], list[Array], list[Array]], list[Array]] | None = None


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
    field: Field,
    views: Views,
    scene: Scene,
    settings: Settings,
    originals: Originals,
    progress: Progress = SILENT,
    crop: Region | None = None,
) -> TsdfVolume:
    """The field's surface in the region of interest, working frame, and within `crop`. Held-out images are not looked at.

    Raises:
        InputError: the field has no surface, or there is too little memory.
        Interrupted: the user asked to stop.
    """
    from fieldfuse.render.coarse_to_fine import render_coarse_to_fine
    from fieldfuse.render.image import make_renderer
    from fieldfuse.stereo.depth_refinement import FieldDepths, Polisher, settled

    shown, cameras = originals.finer(views, np.flatnonzero(~views.test), settings.export)
    chosen = spread(len(shown), settings.export.mesh_views)
    lenses = [cameras[index] for index in chosen]
    require_pictures(lenses, kept=True, advice="lower export.mesh_views or export.mesh_size", each=SURFACE_BYTES)
    view = make_renderer(field, settings.engine)
    polisher = Polisher(shown, cameras, scene.near, scene.far, scene.median_depth)
    seen = shown.subset(np.array(chosen))
    measured = seen.depths if settings.fit.depth > 0 and settings.fit.depth_from != "off" else []
    refinement = Refinement(
        [partial(polisher.polished, index, measured=measured[at] if measured else None) for at, index in enumerate(chosen)],
        lambda *given: settled(FieldDepths(*given), seen, lenses, scene.median_depth, measured, progress),
    )

    def render(lens: Intrinsics, pose: Array) -> Rendered:
        return render_coarse_to_fine(field, at_most(lens, RENDERED_SIDE).pinhole(), pose, view)

    region = Region.box(*scene.surface_box())
    region = region if crop is None else region.both(crop)
    return field_volume(render, shown.world_from_camera[chosen], lenses, None, region, refinement, progress)


def field_volume(
    render: Render,
    poses: Array,
    cameras: Sequence[Intrinsics],
    voxel_size: float | None = None,
    region: Region | None = None,
    refinement: Refinement = Refinement(),
    progress: Progress = SILENT,
) -> TsdfVolume:
    """Render all (N, 4, 4) poses and fuse their reliable depth; its `mesh()` and `points()` are the field's surface.

    Every view also empties what others put in front of its surface, which removes most floaters.

    Args:
        cameras: one a pose.
        voxel_size: working units; None: from the rendered depth, made coarser until it fits into memory.
        region: what is kept, working frame; None: all.

    Raises:
        InputError: no view shows a surface, or the given voxel size is too fine for the memory.
        Interrupted: the user asked to stop.
    """
    from fieldfuse.tsdf.fuse import fuse_held

    poses = np.asarray(poses, dtype=np.float64).reshape(-1, 4, 4)
    if len(cameras) != len(poses) or not len(poses):
        raise InputError(f"a surface needs one camera a pose, there are {len(cameras)} cameras and {len(poses)} poses")
    frames: list[DepthFrame] = []
    opaque: list[Array] = []
    shown: list[Array] = []
    for index, (camera, pose) in enumerate(zip(cameras, poses, strict=True)):
        progress.check()
        frame, solid, visible = _rendered_frame(render, camera, pose, None if refinement.polish is None else refinement.polish[index])
        frames.append(frame)
        opaque.append(solid)
        shown.append(visible)
        progress.update(index + 1, (1 + AFTERWARDS) * len(poses), "views made for the surface")
    if refinement.settle is not None:
        depths = refinement.settle([frame.depth for frame in frames], opaque, shown)
        # Planes and what is left beside them have edges of their own.
        for at, (frame, depth) in enumerate(zip(frames, depths, strict=True)):
            frames[at] = replace(frame, depth=reliable_depth(depth, np.ones_like(depth), frame.depth_intrinsics.fx))
    del opaque, shown
    return fuse_held(
        frames if region is None else [_within(frame, region) for frame in frames],
        voxel_size,
        # What images show beyond what was rendered makes depth better, not voxels finer: those would keep its noise.
        focal=min(frame.colour_intrinsics.fx for frame in frames),
        nothing="no rendered view shows a surface (nothing is opaque) to make a mesh of; fit the field longer or check its poses",
        progress=progress,
    )


def reliable_depth(depth: Array, opacity: Array, focal: float) -> Array:
    """(H, W) depth with 0 where it cannot be trusted: little opacity, or beside a depth edge, where it lies between two surfaces.

    An edge is a range over 3×3 pixels larger than a plane seen at 76° would have. Missing neighbours do not make an edge.
    """
    depth = np.where(np.isfinite(depth) & (depth > 0) & (opacity >= OPAQUE), depth, 0).astype(np.float32)
    window = np.ones((3, 3), np.uint8)
    farthest = cv2.dilate(depth, window)
    nearest = cv2.erode(np.where(depth > 0, depth, np.float32(np.inf)), window)
    step = np.maximum(SMALLEST_EDGE, 2 * STEEPEST / focal)
    return np.asarray(np.where(farthest - nearest <= step * depth, depth, np.float32(0)))


def _rendered_frame(
    render: Render, intrinsics: Intrinsics, pose: Array, polish: Callable[[Array], tuple[Array, Array]] | None
) -> tuple[DepthFrame, Array, Array]:
    """One view: a frame of its reliable depth, polished before; (H, W) all depth that is opaque enough; where images show it.

    What is rendered may be smaller than the camera, whose images then show what is finer.
    """
    from fieldfuse.stereo.maps import enlarged
    from fieldfuse.tsdf.mesh import as_bytes
    from fieldfuse.tsdf.volume import DepthFrame

    rendered = render(intrinsics, pose)
    depth, opacity = np.asarray(rendered.depth), np.asarray(rendered.opacity, dtype=np.float32)
    camera, size = intrinsics.pinhole(), (intrinsics.width, intrinsics.height)
    small = camera.scaled(depth.shape[1], depth.shape[0])
    if small != camera:
        depth = enlarged(depth, *size)
        opacity = np.asarray(cv2.resize(opacity, size, interpolation=cv2.INTER_LINEAR), dtype=np.float32)
    depth, shown = (depth, np.ones(depth.shape, bool)) if polish is None else polish(depth)
    opaque = np.where(np.isfinite(depth) & (opacity >= OPAQUE), depth, 0).astype(np.float32)
    frame = DepthFrame(reliable_depth(depth, opacity, camera.fx), as_bytes(np.asarray(rendered.rgb)), camera, small, pose)
    return frame, opaque, shown


def _within(frame: DepthFrame, region: Region) -> DepthFrame:
    """The frame without depth of points outside the region."""
    depth, camera, pose = frame.depth, frame.depth_intrinsics, frame.world_from_camera
    u = ((np.arange(camera.width) + 0.5 - camera.cx) / camera.fx).astype(np.float32)
    v = ((np.arange(camera.height) + 0.5 - camera.cy) / camera.fy).astype(np.float32)[:, None]
    inside = depth > 0
    # In the camera's frame a side of the region bounds the depth times what grows evenly along rows and columns: no points are made.
    for (x, y, z), offset in zip(region.normals @ pose[:3, :3], region.offsets - region.normals @ pose[:3, 3], strict=True):
        inside &= depth * (np.float32(x) * u + (np.float32(y) * v + np.float32(z))) <= offset
    return replace(frame, depth=np.where(inside, depth, np.float32(0)))


def whole_mesh(volume: TsdfVolume, smooth: int) -> Mesh:
    """The volume's surface without specks, smoothed `smooth` times."""
    return volume.mesh().cleaned(min_area_share=SMALL_PART).smoothed(smooth)
