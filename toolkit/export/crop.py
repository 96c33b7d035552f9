"""A part of a field: within a region (a box, or the hull of what the cameras have in common), and without what floats in the air.

What is exported is made of the part, so that mesh, points, page and video show the same.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from fieldfuse.backends.numba.march import mark_pass
from fieldfuse.camera import Array, Intrinsics, pixel_grid, project, unproject
from fieldfuse.capture.types import Views
from fieldfuse.config import crop_box
from fieldfuse.errors import InputError
from fieldfuse.export.surface import at_most, spread
from fieldfuse.poses.region import OBJECT, Region
from fieldfuse.poses.scene import Scene
from fieldfuse.progress import SILENT, Progress
from fieldfuse.render.bake import SEEN, seen_voxels
from fieldfuse.render.composite import STOP
from fieldfuse.render.field import Field
from fieldfuse.render.image import make_renderer, render_view
from fieldfuse.render.numba_renderer import make_space, make_volume
from fieldfuse.threads import share
from fieldfuse.volume.edit import dilate, erase_empty_blocks
from fieldfuse.volume.topology import BLOCK, VOXELS

CHUNK = 1024  # blocks at a time
CELLS = 32  # along each axis of the region of interest, that the common view is made of
COMMON = 0.5  # share of the cameras that see what is common to them
TWO = 2  # cameras that have to see what is no floater
LEAST_KEPT = 0.1  # of what training images show: a crop by itself that keeps less has missed what is looked at
LEAST_INSIDE = 0.97  # of the pixels that show what is in the region: they have to stay opaque
CHECKED, SIDE = 12, 160  # renders that show what a crop does, and their long side in pixels
MARKED_SIDE = 320  # of the views that show what two cameras see
OPAQUE = 0.5


def region_of(crop: str, scene: Scene, views: Views) -> Region | None:
    """The region (working frame) that the setting `export.crop` means; None: everything.

    Args:
        views: training views, working frame.

    Raises:
        InputError: there is no such region.
    """
    if (corners := crop_box(crop)) is not None:
        return Region.box(np.array(corners[0]), np.array(corners[1])).moved(scene.working_from_input)
    if crop == "off" or (crop == "auto" and scene.layout != OBJECT):
        return None
    return common_view(scene, views) if crop == "hull" else Region.box(*scene.surface_box())


def common_view(scene: Scene, views: Views) -> Region:
    """The convex hull of what half of the cameras see of the region of interest.

    Raises:
        InputError: they see nothing in common.
    """
    low, high = scene.surface_box()
    step = (high - low) / CELLS
    cells = np.stack(np.meshgrid(*(np.arange(CELLS) + 0.5,) * 3, indexing="ij"), axis=-1).reshape(-1, 3) * step + low
    count = np.zeros(len(cells), int)
    for camera, pose in zip(views.intrinsics, views.world_from_camera, strict=True):
        pixels, depth = project(camera, pose, cells)
        count += (depth > scene.near) & ((pixels >= 0) & (pixels <= [camera.width, camera.height])).all(axis=1)
    seen = cells[count >= COMMON * len(views)]
    corners = np.stack(np.meshgrid(*((-0.5, 0.5),) * 3, indexing="ij"), axis=-1).reshape(-1, 3) * step
    found = Region.hull((seen[:, None] + corners).reshape(-1, 3)) if len(seen) else None
    if found is None:
        raise InputError("half of the cameras see nothing in common that a hull could hold; crop by box, or by the numbers of one")
    return found


def cropped(field: Field, region: Region) -> Field:
    """The field without the voxels whose middle lies outside `region` (working frame), and with nothing behind it."""
    size, cell = field.grid.voxel, np.arange(VOXELS)
    local = torch.from_numpy(np.stack([cell & 7, cell >> 3 & 7, cell >> 6], axis=1) + 0.5)
    keep = torch.zeros_like(field.occupied, device="cpu").view(-1, VOXELS)
    keys = field.topology.keys.cpu().double()
    for start in range(0, len(keys), CHUNK):
        middles = (keys[start : start + CHUNK, None] * BLOCK + local) * size - field.space.extent
        places = field.space.to_working(middles.view(-1, 3)).numpy()
        keep[start : start + CHUNK] = torch.from_numpy(region.inside(places)).view(-1, VOXELS)
    return replace(_with(field, keep.view(-1).to(field.device)), sky=None)


def cleaned(field: Field, intrinsics: Sequence[Intrinsics], world_from_camera: Array, progress: Progress = SILENT) -> Field:
    """The field without parts that are connected to nothing that two cameras see, and without what no camera sees.

    A part is a set of voxels that touch each other at faces, of those that hold more than `bake.SEEN` of some pixel's light, and those
    beside them.

    Args:
        intrinsics, world_from_camera: pinhole cameras, (N, 4, 4), working frame; of the training views.

    Raises:
        Interrupted: the user asked to stop.
    """
    here = field.to("cpu")
    weight, cameras = _seen(here, intrinsics, world_from_camera, progress)
    # Of a surface rays meet single voxels, between which others lie: with those beside them they hang together.
    seen = torch.from_numpy(weight > SEEN)
    solid = (dilate(here.topology, seen, 1, grow=False)[1] & here.occupied).numpy()
    label = _parts(here, solid)
    good = np.zeros(int(label.max(initial=-1)) + 1, bool)
    good[label[solid & (cameras >= TWO)]] = True
    stays = np.zeros(len(solid), bool)
    stays[solid] = good[label[solid]]
    return _with(field, torch.from_numpy(stays).to(field.device))


def seen_part(field: Field, intrinsics: Sequence[Intrinsics], world_from_camera: Array, progress: Progress = SILENT) -> Field:
    """The field without what pages leave out, since no camera sees it (`bake.seen_voxels`).

    Args:
        intrinsics, world_from_camera: pinhole cameras, (N, 4, 4), working frame; of the training views.

    Raises:
        Interrupted: the user asked to stop.
    """
    return _with(field, seen_voxels(field.to("cpu"), intrinsics, world_from_camera, progress=progress).to(field.device))


def kept_share(field: Field, part: Field, region: Region | None, views: Views) -> tuple[float, float]:
    """Of what some views (working frame) show of the field: the share of the light that `part` still stops, and the share of pixels that
    still are opaque, of those that show what is in the region."""
    before, after = make_renderer(field), make_renderer(part)
    light, left, inside, stay = 1e-9, 0.0, 0, 0
    for index in spread(len(views), CHECKED):
        lens, pose = at_most(views.intrinsics[index], SIDE), views.world_from_camera[index]
        whole, rest = render_view(field, lens, pose, before), render_view(part, lens, pose, after)
        light, left = light + float(whole.opacity.sum()), left + float(rest.opacity.sum())
        depth = whole.depth.reshape(-1)
        shows = (depth > 0) & (whole.opacity.reshape(-1) > OPAQUE)
        if region is not None:
            places = unproject(lens, pose, pixel_grid(lens.width, lens.height), depth)
            shows &= region.inside(places)
        inside, stay = inside + int(shows.sum()), stay + int((shows & (rest.opacity.reshape(-1) > OPAQUE)).sum())
    return left / light, stay / max(inside, 1)


def _with(field: Field, keep: torch.Tensor) -> Field:
    rows = [field.density_rows.detach(), field.feature_rows.detach()]
    topology, occupied, (density, feature) = erase_empty_blocks(field.topology, field.occupied & keep, rows)
    return replace(field, topology=topology, occupied=occupied, density_rows=density, feature_rows=feature)


def _seen(field: Field, intrinsics: Sequence[Intrinsics], world_from_camera: Array, progress: Progress) -> tuple[Array, Array]:
    """(M · 512,) the largest weight with which a pixel of some view sees each voxel, and how many views see it at all, up to 255."""
    space, volume, threads = make_space(field), make_volume(field), torch.get_num_threads()
    small = [at_most(camera, MARKED_SIDE) for camera in intrinsics]
    cameras = np.array([(c.fx, c.fy, c.cx, c.cy, c.width, c.height) for c in small], np.float32).reshape(-1, 6)
    poses = np.ascontiguousarray(world_from_camera[:, :3], np.float32)
    most, count = (np.zeros((threads, len(field.occupied)), kind) for kind in (np.uint16, np.uint8))

    def part(thread: int) -> None:
        marks = np.zeros(len(field.occupied), np.uint16)
        for view in range(thread, len(cameras), threads):
            if progress.stopping():
                return
            if thread == 0:
                progress.update(view, len(cameras), "looking for floaters")
            marks.fill(0)
            mark_pass(space, volume, cameras, poses, view, view + 1, 1, np.float32(STOP), marks)
            np.maximum(most[thread], marks, out=most[thread])
            count[thread] += (count[thread] < 255 // threads) & (marks >> 4 > math.floor(SEEN * 4095))

    share(part, range(threads), threads)
    progress.check()
    return (most.max(0) >> 4).astype(np.float32) / 4095, count.sum(0, dtype=np.int32)


def _parts(field: Field, solid: Array) -> Array:
    """(M · 512,) int32 the number of the part of each solid voxel; −1 elsewhere."""
    number = np.cumsum(solid, dtype=np.int64) - 1
    padded = np.append(solid, False)
    pairs: list[Array] = []
    for start in range(0, field.blocks, CHUNK):
        stop = min(start + CHUNK, field.blocks)
        rows = field.topology.halo_chunk(start, stop).view(-1, BLOCK + 2, BLOCK + 2, BLOCK + 2).numpy()
        here = rows[:, 1:-1, 1:-1, 1:-1].ravel()
        for beside in (rows[:, 2:, 1:-1, 1:-1], rows[:, 1:-1, 2:, 1:-1], rows[:, 1:-1, 1:-1, 2:]):
            both = padded[here] & padded[beside.ravel()]
            pairs.append(np.stack([number[here[both]], number[beside.ravel()[both]]]))
    links = np.concatenate(pairs, axis=1) if pairs else np.zeros((2, 0), np.int64)
    total = int(solid.sum())
    graph = coo_array((np.ones(links.shape[1], bool), (links[0], links[1])), shape=(total, total))
    out = np.full(len(solid), -1, np.int32)
    if total:
        out[solid] = connected_components(graph, directed=False)[1]
    return out
