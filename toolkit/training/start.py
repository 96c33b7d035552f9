"""The classical start of a fit: the space, the lattice's levels, and which coarse voxels could hold something at all.

No network and no learning: a voxel takes part when enough training views see it, and, for captures with alpha, when no view sees
through it (the visual hull), or, with depth, when no view measured past it (space carving).
"""

from __future__ import annotations

import cv2
import numpy as np
import torch

from fieldfuse.backends.constants import DIRECTION
from fieldfuse.camera import Array, invert
from fieldfuse.capture.types import Views
from fieldfuse.config import FieldSettings
from fieldfuse.nerfusion.decoder import Deferred, PerSample, make_decoder
from fieldfuse.poses.scene import Scene
from fieldfuse.volume.space import Space

Tensor = torch.Tensor
SHELL = 1.0  # width of the contracted shell, in half sizes of the region
MARGIN = 1.05  # the region grows by this much, so that its border is not cut
ROOM_MARGIN = 1.4  # the same where nothing exists outside and no alpha shows where the object ends: what is cut off is never seen
# Of the median depth: the undistorted region is at least as large. A small object on a desk fills few pixels; with the region drawn
# tightly around it, the desk lies where voxels are stretched, which cost 5 dB on the validation views of such a capture.
LEAST_REACH = 0.9
NEAR = 0.8  # of the scene's nearest depth: where a fit's rays begin
COARSEST = 32
HARMONICS = {"none": 0, "low": 4, "full": DIRECTION, "auto": DIRECTION}  # of the viewing direction, lowest first, that a decoder sees
THIN = -4.5  # raw density of what is unknown: thin enough that every voxel along a ray is tried, thick enough that none is ignored
FINEST = 1024
USUAL, FINER = 512, 768  # finer than usual is worth a level of its own from `FINER` on; `schedule.py` decides whether it is made
PIXELS = 2.0  # of the training views, a voxel in the middle of the scene
OBJECT_PIXELS = 1.3  # the same where alpha cuts the object out: fewer voxels are in play, so they may be finer
SEEN_BY = 3  # training views that must see a voxel: fewer do not determine its depth …
# … but with fewer views than FEW_VIEWS most places are seen by one or two. What is left out there is missing from every render: with
# 3 to 12 views it cost up to 9 dB on validation views, while with all of them nothing was gained or lost. With so few the fit may
# also start from the networks.
FEW_VIEWS = 24
EMPTIED = 0.02  # share of the views that may err about a voxel being empty
WHOLE = 0.87  # voxels from the middle of one to its corners: half the diagonal


def new_decoder(settings: FieldSettings) -> Deferred | PerSample:
    """A decoder of these settings, blind for the harmonics that `settings.view` does not have: their weights are zero and stay zero, so
    that field files, kernels and renderers are the same for all."""
    decoder = make_decoder(settings.decoder, settings.channels, settings.width)
    direction_weights(decoder)[:, HARMONICS[settings.view] :] = 0.0
    return decoder


def direction_weights(decoder: Deferred | PerSample) -> Tensor:
    """(hidden, 16) the weights that take the direction; a view of the parameter."""
    first = decoder.layers[0] if isinstance(decoder, Deferred) else decoder.colour[0]
    assert isinstance(first, torch.nn.Linear)
    return first.weight.detach()[:, -DIRECTION:]


def unseen_harmonics(decoder: Deferred | PerSample) -> Tensor:
    """(16,) bool: harmonics that the decoder does not see and must not learn to."""
    return (direction_weights(decoder) == 0).all(0)


def make_space(scene: Scene, background: bool, margin: float = MARGIN) -> Space:
    """The region of interest as a cube with everything else around it, or as a bare box."""
    x, y, z = (float(v) for v in scene.centre)
    if background:
        return Space((x, y, z), max(float(np.max(scene.half_size)) * MARGIN, LEAST_REACH * scene.median_depth), SHELL)
    half = float(np.max(scene.half_size)) * margin
    bx, by, bz = (float(v) * margin / half for v in scene.half_size)
    return Space((x, y, z), half, 0.0, (bx, by, bz))


def space_of(views: Views, scene: Scene, background: str = "auto") -> Space:
    """The space that fits of these views use. `background`: auto (as the scene has it) | on | off."""
    wanted = scene.has_background if background == "auto" else background == "on"
    return make_space(scene, wanted and views.background is None, MARGIN if views.background is not None else ROOM_MARGIN)


def colour_behind(views: Views) -> Tensor:
    """(3,) float32 colour behind everything: known for captures with alpha, else the mean of the training images."""
    if views.background is not None:
        return torch.tensor(views.background, dtype=torch.float32)
    train = np.flatnonzero(~np.asarray(views.test))
    return torch.from_numpy(np.mean([cv2.mean(np.ascontiguousarray(views.images[i]))[:3] for i in train], axis=0) / 255).float()


def finest_resolution(space: Space, views: Views, scene: Scene) -> int:
    """Voxels a side so that one voxel in the middle of the scene spans `PIXELS` pixels of the training views.

    Finer lattices fitted worse at equal seconds (more unknowns than the pixels determine).
    """
    focal = float(np.median([camera.fx for camera in views.intrinsics]))
    pixels = PIXELS if views.background is None else OBJECT_PIXELS
    wanted = 2 * space.extent * space.half / (pixels * scene.median_depth / focal)
    return worth_a_level(int(np.clip(round(wanted / 32) * 32, 64, FINEST)))


def worth_a_level(resolution: int) -> int:
    """As many voxels a side, or `USUAL` where these are little finer than that."""
    return resolution if resolution >= FINER else min(resolution, USUAL)


def levels(finest: int) -> list[int]:
    """Resolutions from coarse to fine: doublings of the coarsest, then the finest itself."""
    out = [COARSEST]
    while out[-1] * 2 <= finest:
        out.append(out[-1] * 2)
    if out[-1] < finest:
        if finest / out[-1] <= 1.3:
            out[-1] = finest
        else:
            out.append(finest)
    return out


def possible(space: Space, resolution: int, places: Tensor, views: Views) -> Tensor:
    """(N, 3) voxels → the ones that can hold something, judged from the training views alone."""
    seen, emptied, count = _judged(space, resolution, places, views)
    keep = (seen >= (SEEN_BY if count >= FEW_VIEWS else 1)) & (emptied <= EMPTIED * count)
    return places[torch.from_numpy(keep)] if keep.any() else places


def emptied_by_views(space: Space, resolution: int, places: Tensor, views: Views, reach: float = WHOLE) -> Tensor:
    """(N, 3) voxels → (N,) bool, those where alpha (or, without it, measured depth) of the training views shows nothing.

    Args:
        reach: voxels about the middle of each that have to be empty.
    """
    _, emptied, count = _judged(space, resolution, places, views, reach)
    return torch.from_numpy(emptied > EMPTIED * count)


def radii(space: Space, resolution: int, places: Tensor, reach: float) -> tuple[Array, Array]:
    """(N, 3) voxels → (N, 3) their middles, and (N,) the length of `reach` voxels there, working units: contracted voxels are larger the
    farther out they are."""
    voxel = 2 * space.extent / resolution
    centre = (places.double() + 0.5) * voxel - space.extent
    norm = np.maximum(centre.abs().amax(1).numpy(), 1.0)
    stretch = np.ones(1) if space.shell == 0 else np.minimum((space.shell / np.maximum(space.extent - norm, voxel)) ** 2 / space.shell, 1e6)
    radius = reach * voxel * space.half * np.maximum(stretch, 1.0)
    return space.to_working(centre).numpy(), np.broadcast_to(radius, len(centre))


def _judged(space: Space, resolution: int, places: Tensor, views: Views, reach: float = WHOLE) -> tuple[Array, Array, int]:
    """(N, 3) voxels → (N,) how many training views see each, how many show it empty, and how many there are."""
    points, radius = radii(space, resolution, places, reach)
    train = np.flatnonzero(~views.test)
    seen, emptied = np.zeros(len(points), np.int32), np.zeros(len(points), np.int32)
    for index in train:
        visible, empty = _look(views, int(index), points, radius)
        seen += visible
        emptied += empty
    return seen, emptied, len(train)


def _look(views: Views, index: int, points: Array, radius: Array) -> tuple[Array, Array]:
    """(N,) bool: the ball around each point touches the image; and the image shows the whole ball empty."""
    camera, pose = views.intrinsics[index], invert(views.world_from_camera[index])
    local = points @ pose[:3, :3].T + pose[:3, 3]
    depth = np.maximum(local[:, 2], 1e-6)
    u, v = local[:, 0] / depth * camera.fx + camera.cx, local[:, 1] / depth * camera.fy + camera.cy
    reach = radius / depth * max(camera.fx, camera.fy)
    visible = (local[:, 2] > 0) & (u > -reach) & (u < camera.width + reach) & (v > -reach) & (v < camera.height + reach)
    empty = np.zeros(len(points), bool)
    alpha = views.alpha[index] if views.alpha else None
    measured = views.depths[index] if views.depths else None
    if alpha is None and measured is None:
        return visible, empty
    judged = visible & (local[:, 2] > radius) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    size = np.ceil(np.log2(np.maximum(reach, 1))).astype(int)  # the window around a pixel: the next power of two
    judged &= 2**size < 0.25 * camera.width
    for step in np.unique(size[judged]):
        rows = np.flatnonzero(judged & (size == step))
        window = np.ones((2 * 2**step + 1,) * 2, np.uint8)
        y, x = v[rows].astype(int), u[rows].astype(int)
        if alpha is not None:
            empty[rows] = cv2.dilate(alpha, window)[y, x] == 0
        elif measured is not None:  # a hole is 0, the smallest there is, so it empties nothing
            empty[rows] = cv2.erode(measured, window)[y, x] > local[rows, 2] + 2 * radius[rows]
    return visible, empty
