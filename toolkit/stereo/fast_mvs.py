"""Small depth maps in little time, which guide the fit of a capture without depth.

Matching in full takes 0.2 to 0.8 s an image, and most of what it is worth to a fit is there at a third of the pixels: light that ends
about where the surface is, from the first steps on. Size and number of the images follow from counts alone, so that a run is the same on
a slow machine, or a busy one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from dataclasses import field as default

import numpy as np

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.capture.types import Views
from fieldfuse.progress import SILENT, Progress
from fieldfuse.stereo.maps import depth_at
from fieldfuse.stereo.match import LENIENT, LONG_SIDE, StereoDepth, stereo_depths
from fieldfuse.stereo.plane_completion import continued
from fieldfuse.stereo.transients import consensus

SHARE = 0.15  # of the fit's seconds that matching is meant to take …
MOST_SHARE = 0.25  # … and may take with the smallest images before some of them are skipped
LEAST_SIDE = 128
PIXEL_SECONDS = 3e-6  # of a pixel of the smallest images, one thread …
GROWTH = 2.4  # … and the exponent of an image's seconds over its side: larger ones take more planes, too
FEWEST, SPARSEST = 24, 4  # where only every n-th image is matched: fewest images, and largest n; neighbours must stay near


@dataclass(frozen=True)
class Matched:
    """What matching gave a fit."""

    views: int  # images that were matched
    pixels: int  # long side of their depth maps
    share: float  # of their pixels that have depth
    bare: float  # share of their pixels whose depth is that of a plane that goes on, not matched itself; part of `share`
    depths: dict[int, StereoDepth] = default(default_factory=dict)  # as they were found, by the view's index

    def to_dict(self) -> dict[str, float]:
        return {"views": self.views, "pixels": self.pixels, "share": round(self.share, 4), "bare": round(self.bare, 4)}


def view_seconds(side: float, aspect: float) -> float:
    """Seconds that a nominal machine takes to match an image with this long side, whose short side is `aspect` of it."""
    return PIXEL_SECONDS * aspect * LEAST_SIDE**2 * (side / LEAST_SIDE) ** GROWTH


def plan(views: int, budget: float, aspect: float = 0.75) -> tuple[int, int] | None:
    """Long side of the depth maps and n, where every n-th image is matched, for a fit to `views` images of `budget` seconds; None: they
    are too many for so short a fit."""
    if views < 2:
        return None
    least = view_seconds(LEAST_SIDE, aspect)
    side = LEAST_SIDE * (SHARE * budget / (views * least)) ** (1 / GROWTH)
    if side >= LEAST_SIDE:
        return min(LONG_SIDE, int(side) // 8 * 8), 1
    every = int(np.ceil(views * least / (MOST_SHARE * budget)))
    return (LEAST_SIDE, every) if every == 1 or (every <= SPARSEST and views // every >= FEWEST) else None


def guided(
    views: Views, near: float, far: float, median_depth: float, budget: float, progress: Progress = SILENT
) -> tuple[Views, Matched | None]:
    """The views with the depth of training images that matching finds within a share of a fit's `budget` seconds.

    Held-out images are not looked at.

    Args:
        near, far, median_depth: of the scene, working units.

    Raises:
        InputError: no two training images can be matched, or there is no memory for it.
        Interrupted: the user asked to stop.
    """
    training = np.flatnonzero(~views.test)
    sizes = [(views.intrinsics[index].width, views.intrinsics[index].height) for index in training]
    chosen = plan(len(training), budget, float(np.median([min(size) / max(size) for size in sizes])) if sizes else 1.0)
    if chosen is None:
        return views, None
    side, every = chosen
    matched = training[::every]
    some = views.subset(matched)
    found = stereo_depths(some, near, far, median_depth, long_side=side, required=LENIENT, progress=progress)
    whole = continued(found, some, median_depth, progress, LENIENT)
    out = replace(with_depths(views, matched, whole), rough=True)
    share = float(np.mean([np.mean(out.depths[index] > 0) for index in matched]))
    bare = float(np.mean([np.mean((one.depth <= 0) & (more.depth > 0)) for one, more in zip(found, whole, strict=True)]))
    depths = dict(zip(map(int, matched), whole, strict=True))
    return out, Matched(len(matched), max(max(one.depth.shape) for one in found), share, bare, depths)


def with_depths(views: Views, indices: Array, found: list[StereoDepth]) -> Views:
    """Views where the images `indices` have the depth that was `found` for them, one after the other, and the others none."""
    depths: list[Array | None] = [None] * len(views)
    for index, one in zip(indices, found, strict=True):
        camera = views.intrinsics[index]
        depths[index] = depth_at(one, camera.width, camera.height)
    return replace(views, depths=depths, matched=True)


def warm_up() -> None:
    """Have the kernels compiled, or loaded, by matching three small images, letting a plane go on in them, and having them agree."""
    noise = np.random.default_rng(0).integers(0, 256, (24, 48, 3)).astype(np.uint8)
    camera = Intrinsics(32, 24, 32.0, 32.0, 16.0, 12.0)
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = np.arange(3) / 8  # 4 pixels at a depth of 1
    images, wall = [np.ascontiguousarray(noise[:, 4 * i : 4 * i + 32]) for i in range(3)], np.ones((24, 32), np.float32)
    views = Views(["a", "b", "c"], images, [camera] * 3, poses, np.zeros(3, bool))
    continued([replace(one, depth=wall, confidence=0.5 * wall) for one in stereo_depths(views, 0.5, 4.0, 1.0)], views, 1.0)
    consensus(camera, poses[0], [wall] * 3, images, [camera] * 3, poses)
