"""What every reader returns: a `Capture` of `Frame`s, plain data that is also a JSON file; and `Views`, the pixels made ready."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from fieldfuse.camera import Array, Intrinsics
from fieldfuse.tone import Tone

MODEL_NAMES = "model_names"  # in `Capture.extra`: of frames by name, what COLMAP's model calls their images
CUT = "cut"  # in `Capture.extra`: into what views images are cut, in a sentence (`sphere`)
SAME_EXPOSURE = 1e-3  # gains are written with six digits, and their mean is 1 by no more


@dataclass(frozen=True)
class Frame:
    """One image of a capture. Paths are absolute; nothing is decoded yet."""

    name: str  # unique within the capture; frames are sorted by it (natural order: 2 before 10)
    image: Path  # the image, or the video (or `.sens` file) that holds it
    intrinsics: Intrinsics | None = None  # None: unknown, poses are to find it
    world_from_camera: Array | None = None  # (4, 4) float64, OpenCV axes, the input's own frame; None: unknown
    depth: Path | None = None  # image of z-depth, or the `.sens` file that holds it, as it holds the frame
    depth_intrinsics: Intrinsics | None = None  # None: the same camera as the image
    mask: Path | None = None  # image; 0 = do not use this pixel
    split: str | None = None  # "train" or "test" where the source has one
    video_index: int | None = None  # frame number when `image` is a video
    focal_prior: float | None = None  # pixels, from EXIF, when intrinsics are unknown
    as_stored: bool = False  # of a video: its frames are not turned, and those count too that its edit list hides
    confidence: Path | None = None  # image of the depth map's size; 0 = the sensor does not trust this depth
    white: float | None = None  # value of the image's channels that is shown as white; None: the largest that they can have, or 1
    linear: bool | None = None  # the channels hold linear light, not sRGB's curve; None: as is usual for the file's format
    balance: tuple[float, float, float] | None = None  # white balance with which a camera raw file is developed; None: the camera's
    depth_pose: Array | None = None  # (4, 4) image's camera from the depth camera, units of the poses; None: both at the same place
    mask_excludes: bool = False  # the mask is the other way round: what is not 0 is not used
    mask_is_alpha: bool = False  # nothing is there where the mask is 0, as the image shows: it is cut out
    # Of a view that was cut out of a panorama or a fisheye image (`sphere`): that image's name, of which all views have one place and time,
    # and (4, 4) its camera from the view's
    instant: str | None = None
    source_from_view: Array | None = None


@dataclass(frozen=True)
class Capture:
    """A source as found on disk, in its own frame of reference."""

    kind: str  # "video", or a name of `detect.READERS`
    root: Path
    frames: tuple[Frame, ...]
    ordered: bool = False  # neighbours in the list are neighbours in time
    metric: bool = False  # one unit of the poses is one metre
    depth_scale: float = 1000.0  # stored depth values per unit of length
    alpha: bool = False  # images have alpha that separates object from nothing
    up: tuple[float, float, float] | None = None  # up-direction in the input's frame, where the source defines it
    points: Array | None = None  # (N, 3) sparse points in the input's frame, when the source has them
    warnings: tuple[str, ...] = ()
    extra: dict[str, Any] = field(default_factory=dict)  # facts for reports, e.g. {"listed": 67, "missing": 17, "fps": 30.0}
    film: bool = False  # the frames are images, but as many as a video's, and some are still to be chosen

    @property
    def posed(self) -> bool:
        return bool(self.frames) and all(frame.world_from_camera is not None and frame.intrinsics is not None for frame in self.frames)

    @property
    def filmed(self) -> bool:
        """Whether some of the frames are still to be chosen: they are inside a video or a `.sens` file, or are a film's."""
        return bool(self.frames) and (self.film or self.frames[0].video_index is not None)

    @property
    def has_depth(self) -> bool:
        return any(frame.depth is not None for frame in self.frames)

    def with_frames(self, frames: Iterable[Frame], *warnings: str) -> Capture:
        return replace(self, frames=tuple(frames), warnings=self.warnings + tuple(warnings))


@dataclass
class Views:
    """Images made ready for fitting and measuring: undistorted once, resized once, in the working frame.

    All lists have one entry a frame. Images may differ in size.
    """

    names: list[str]
    images: list[Array]  # (H, W, 3) uint8 RGB; captures with alpha are already composited on `background`
    intrinsics: list[Intrinsics]  # pinhole, for exactly these sizes
    world_from_camera: Array  # (N, 4, 4) float64, working frame
    test: Array  # (N,) bool: held out; nothing that fits appearance may look at these
    valid: list[Array | None] = field(default_factory=list)  # (H, W) bool, None: every pixel
    alpha: list[Array | None] = field(default_factory=list)  # (H, W) uint8, None: opaque
    depths: list[Array | None] = field(default_factory=list)  # (H, W) float32 along z, working units, 0 = missing; aligned to the image
    background: tuple[float, float, float] | None = None  # colour behind everything for captures with alpha; None: unknown
    matched: bool = False  # `depths` were found by matching images, not measured
    rough: bool = False  # `depths` were found by matching small images: less exact than a sensor's, or than those of matching in full
    weight: list[float] = field(default_factory=list)  # share of a view's pixels that a fit draws rays from; empty: all of all views
    photos: list[Array | None] = field(default_factory=list)  # held-out images as they were before colours were corrected, uint8
    tones: list[Tone | None] = field(default_factory=list)  # what was taken out of each image's colours; None, empty: nothing

    def __len__(self) -> int:
        return len(self.names)

    def subset(self, indices: list[int] | Array) -> Views:
        """The views at `indices`, sharing the pixels."""
        keep = [int(i) for i in indices]
        lists: dict[str, Any] = {
            one.name: [values[i] for i in keep] if values else []
            for one in fields(self)
            if isinstance(values := getattr(self, one.name), list)
        }
        return replace(self, **lists, world_from_camera=self.world_from_camera[keep], test=np.asarray(self.test)[keep])

    @property
    def exposure(self) -> float:
        """How much brighter the training images were taken than they are here, in the mean of logarithms and linear light. Exactly 1
        where nothing was taken out of their colours."""
        gains = [1.0 if tone is None else tone.gain for tone, test in zip(self.tones, self.test, strict=False) if not test]
        exposure = float(np.exp(np.mean([np.mean(np.log(gain)) for gain in gains]))) if gains else 1.0
        return 1.0 if abs(exposure - 1) < SAME_EXPOSURE else exposure

    def toned(self) -> dict[str, Tone]:
        """What was taken out of the images' colours, by their names; without those of which nothing was."""
        return {name: tone for name, tone in zip(self.names, self.tones, strict=False) if tone is not None}

    def photo(self, index: int) -> Array:
        """(H, W, 3) uint8: what a rendering of view `index` is held against, the image in the colours in which it was taken."""
        photo = self.photos[index] if self.photos else None
        return self.images[index] if photo is None else photo

    def as_taken(self, index: int, shown: Array) -> Array:
        """A rendering (H, W, 3) in [0, 1] of view `index` with what was taken out of the image's colours put back."""
        tone = self.tones[index] if self.photos and self.photos[index] is not None else None
        return shown if tone is None else tone.applied(shown, self.intrinsics[index])
