"""A short fit with and without: whether what was corrected helps what users see.

Some training frames are kept aside, brought to the others' colours and poses in the way held-out frames are, and scored. Every option
makes the same number of steps from the same seed on the same small images, so that the options differ by what they correct alone, and
the answer does not depend on how busy the machine is.
"""

from __future__ import annotations

import itertools
import time
from dataclasses import replace

import numpy as np

from fieldfuse.camera import Array
from fieldfuse.capture.prepare import prepare_views
from fieldfuse.capture.types import Capture, Views
from fieldfuse.config import CaptureSettings, Settings
from fieldfuse.effects.correct import Corrections
from fieldfuse.errors import InputError, PoseError
from fieldfuse.poses.scene import Scene, describe_scene
from fieldfuse.progress import SILENT, Progress
from fieldfuse.training.fit import fit_field

LONG_SIDE = 192  # pixels of a trial's images
RESOLUTION = 96  # voxels a side
STEPS = 360  # of one fit
BUDGET = 2.0  # seconds that these are taken for by the schedule, whatever they take
LONGEST = 30.0  # seconds after which a fit on a machine that is far too slow is given up


class Trial:
    """Short fits to some training frames of a posed capture.

    Args:
        capture: training frames; by its points, if it has any, the scene is found.
        validation: (F,) bool frames that are scored.
        settings: of the run.
    """

    def __init__(self, capture: Capture, validation: Array, settings: Settings, progress: Progress = SILENT) -> None:
        split = ["test" if aside else "train" for aside in validation]
        self.capture = capture.with_frames([replace(frame, split=part) for frame, part in zip(capture.frames, split, strict=True)])
        self.settings, self.progress = short(settings), progress
        self._scene: Scene | None = None
        self._made: tuple[Corrections, Views] | None = None

    def __call__(self, option: Corrections, seed: int = 0) -> Array | None:
        """(V,) PSNR of each validation frame after a fit with what `option` corrects; None: there is no answer.

        Args:
            option: corrections in which validation frames are placed and toned as if they were held out.
            seed: added to that of the settings.
        """
        try:
            return self._score(option.on_views(self._views(option)), seed)
        except (InputError, PoseError):  # whatever is wrong is reported where it is used
            return None

    def _views(self, option: Corrections) -> Views:
        """Images as they were taken, with the option's cameras; the last ones are kept."""
        if self._scene is None:
            self._scene = describe_scene(self.capture, self.progress)
        if self._made is None or not same_geometry(self._made[0], option):
            moved = option.on_capture(self.capture)
            views = prepare_views(moved, self._scene.working_from_input, self.settings.capture, self.progress)
            self._made = (option, views)
        return self._made[1]

    def _score(self, views: Views, seed: int) -> Array | None:
        assert self._scene is not None
        bounded, looks = _Bounded(self.progress), itertools.count()  # a clock that goes on with each look: `STEPS` steps on any machine
        settings = replace(self.settings, seed=self.settings.seed + seed)
        result = fit_field(views, self._scene, settings, bounded, ticks=lambda: next(looks) * BUDGET / STEPS)
        self.progress.check()
        return None if bounded.over or not result.held_out else np.array(result.held_out)


def same_geometry(one: Corrections, other: Corrections) -> bool:
    """Whether two corrections give the same cameras."""
    poses = one.poses.keys() == other.poses.keys() and all(np.array_equal(pose, other.poses[name]) for name, pose in one.poses.items())
    return poses and one.lens == other.lens


def short(settings: Settings) -> Settings:
    """Settings of a fit that takes a second or two: a coarse lattice and small images, nothing matched, nothing looked for."""
    return replace(
        settings,
        capture=CaptureSettings(image_size=LONG_SIDE, holdout=0),
        field=replace(settings.field, resolution=RESOLUTION, background="auto"),
        fit=replace(settings.fit, budget=BUDGET, depth_from="sensor", moving="off", patience=False, passes=None),
    )


class _Bounded(Progress):
    """Silent progress that ends what takes far too long."""

    def __init__(self, whole: Progress) -> None:
        self.whole, self.end = whole, time.monotonic() + LONGEST

    @property
    def over(self) -> bool:
        return time.monotonic() > self.end

    def stopping(self) -> bool:
        return self.over or self.whole.stopping()
