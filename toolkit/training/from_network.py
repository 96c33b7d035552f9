"""Direct inference: from key frames to a radiance field by the trained networks alone, without any per-scene optimisation.

Encoder → local volumes → fusion → global volume → field (NeRFusion, sections 3.1 and 3.2), one key frame after the other, so that the
field can be looked at while key frames come in. The space is the one that a fit of the same views uses, so a fit can go on from it.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from fieldfuse.capture.types import Views
from fieldfuse.config import NetworkSettings
from fieldfuse.errors import InputError
from fieldfuse.nerfusion import weights
from fieldfuse.nerfusion.extras.keyframe_depth import overlapping
from fieldfuse.nerfusion.fusion import Fused, FusionOptions, fuse_views
from fieldfuse.nerfusion.keyframes import KeyFrames
from fieldfuse.nerfusion.lattice import Lattice
from fieldfuse.nerfusion.model import NerfusionModel
from fieldfuse.nerfusion.weights import load_model
from fieldfuse.poses.scene import Scene
from fieldfuse.progress import SILENT, Progress
from fieldfuse.render.field import Field
from fieldfuse.render.fused import make_field, without_empty_blocks
from fieldfuse.training.background_sh import sky_behind
from fieldfuse.training.finer_colours import finer_colours
from fieldfuse.training.silhouettes import inside_silhouettes, visual_hull
from fieldfuse.training.start import colour_behind, space_of
from fieldfuse.volume.space import Space
from fieldfuse.volume.topology import BLOCK

SHIPPED = weights.SHIPPED
# Voxels that make up the median depth at least, on the finer of two lattices. One lattice of 24 alone loses 1.5 to 2.5 dB, while 104
# gain 0.25 dB for about three times the seconds (docs/measured/few_views.md), so none need be smaller than some pixels; a larger one shows.
VOXELS_TO_MEDIAN = 48.0
PIXELS = 5.0  # that a voxel spans at most: colours become finer afterwards (`finer_colours.py`) …
MEASURED_PIXELS = 3.5  # … where a sensor's depth is more exact about where surfaces are …
OBJECT_PIXELS = 2.6  # … and where alpha cuts the object out: fewer voxels are in play
LEAST, MOST = 32, 384  # resolution of the lattice


def load_networks(path: Path | str | None = None, device: torch.device | str = "cpu") -> NerfusionModel:
    """The shipped networks, or those in the file at `path`.

    Raises:
        InputError: the file is missing or does not hold networks.
    """
    return load_model(SHIPPED if path is None else path, device)


def voxels_to_median(views: Views, measured: bool = False) -> float:
    """Voxels that make up the median depth: 48, or as many as let a voxel there span no more than `PIXELS` of the views, fewer pixels where
    the views have alpha, and `MEASURED_PIXELS` where their measured depth is used."""
    pixels = PIXELS
    if measured and any(depth is not None for depth in views.depths):
        pixels = MEASURED_PIXELS
    elif any(alpha is not None for alpha in views.alpha):
        pixels = OBJECT_PIXELS
    return max(VOXELS_TO_MEDIAN, float(np.median([lens.fx for lens in views.intrinsics])) / pixels)


def lattice_of(space: Space, scene: Scene, voxels: float, levels: int) -> Lattice:
    """The finest of `levels` lattices: about `voxels` voxels to the median depth, within what memory allows."""
    unit = BLOCK * 2 ** (levels - 1)
    wanted = 2 * space.extent * space.half / (scene.median_depth / voxels)
    return Lattice(space, int(np.clip(unit * round(wanted / unit), max(LEAST, unit), MOST)))


class Inference:
    """The networks at work on one capture: iterate to fuse key frame after key frame, and take the field in between or at the end."""

    def __init__(
        self,
        model: NerfusionModel,
        views: Views,
        scene: Scene,
        keys: KeyFrames,
        background: str = "auto",
        settings: NetworkSettings | None = None,
    ) -> None:
        """
        Args:
            views: all views; only those not marked `test` are looked at.
            keys: indices into the training views.
            background: as in the settings.

        Raises:
            InputError: there is no training view or no key frame.
        """
        train = np.flatnonzero(~np.asarray(views.test))
        if len(train) == 0 or len(keys.indices) == 0:
            raise InputError("no training view is left for the networks; lower --holdout or give more images")
        self.model, self.keys, self.settings = model, keys, settings or NetworkSettings()
        self.measured = self.settings.depth_from == "sensor"
        self.train = views.subset(train)
        self.near, self.far, self.median_depth = scene.near, scene.far, scene.median_depth
        voxels = self.settings.voxels or voxels_to_median(self.train, self.measured)
        self.lattice = lattice_of(space_of(views, scene, background), scene, voxels, self.settings.levels)
        self.behind, self.sky = colour_behind(views).to(model.device), sky_behind(views)
        start = time.perf_counter()
        self.hull = visual_hull(self.lattice.space, self.train, model.device)
        self.seconds = time.perf_counter() - start
        self.fusion_seconds = self.encode_seconds = 0.0
        self.done = 0
        self._latest: Fused | None = None

    def frames(self, progress: Progress = SILENT) -> Iterator[int]:
        """Fuse the key frames in order; yields each one's index among the training views when it is in the volume.

        Raises:
            Interrupted: the user asked to stop.
        """
        own = self.settings
        options = FusionOptions(own.levels, self.near, self.far, measured=self.measured, precision=own.precision, empty=self.hull)
        # Things without texture that stand before nothing lead all sweeps astray in the same way; the hull is the better guide.
        agree = own.agreement and self.hull is None and (self.near > 0 or math.isfinite(self.far))
        others = overlapping(self.keys, self.train.world_from_camera, self.train.intrinsics, self.median_depth) if agree else None
        for fused in fuse_views(self.model, self.train, self.keys, self.lattice, options, progress, others):
            self._latest = fused
            self.seconds += fused.seconds
            self.fusion_seconds += fused.seconds
            self.encode_seconds += fused.encode_seconds
            self.done += 1
            yield fused.frame

    @torch.no_grad()
    def field(self, finished: bool = True) -> Field:
        """The field of the key frames so far, in memory of its own; it shares the networks' decoder. A fit can start from it.

        Args:
            finished: no more key frame will come: captures with alpha lose what lies outside of the silhouettes of all training views.

        Raises:
            InputError: no key frame has been fused yet.
        """
        if self._latest is None:
            raise InputError("no key frame has been fused yet, so there is no field; fuse one first")
        start = time.perf_counter()
        gamma, allowed = self.settings.gamma if self.settings.gamma < 1 else None, self._latest.allowed  # 1 prunes nothing
        made = make_field(self.model, self._latest.volume, self.behind, gamma, 0.5 * self.near, allowed=allowed)
        if finished and self.hull is not None:
            made = inside_silhouettes(made, self.train)
        made = replace(without_empty_blocks(made), sky=self.sky)
        self.seconds += time.perf_counter() - start
        return made

    def result(self, progress: Progress = SILENT, engine: str = "auto") -> Field:
        """What direct inference gives, when no more key frame will come: the field with colours looked up again if the settings have it;
        some seconds.

        Raises:
            InputError: no key frame has been fused yet.
            Interrupted: the user asked to stop.
        """
        made = self.field()
        start = time.perf_counter()
        if self.settings.recolour:
            made = finer_colours(made, self.train, self.median_depth, progress, engine)
        self.seconds += time.perf_counter() - start
        return made
