"""Which scene serves which step: sources mixed by weight, every choice drawn from (seed, process, step) so that nothing needs keeping."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TypeVar

import numpy as np
import torch

from fieldfuse.errors import InputError
from fieldfuse.nerfusion.training.datasets.dtu import dtu_scene, dtu_scenes
from fieldfuse.nerfusion.training.datasets.scanned_objects import scanned_object_folders, scanned_object_scene
from fieldfuse.nerfusion.training.datasets.scannet import scannet_folders, scannet_scene
from fieldfuse.nerfusion.training.datasets.synthetic import synthetic_folders, synthetic_scene
from fieldfuse.nerfusion.training.drawing import draw_sample
from fieldfuse.nerfusion.training.procedural import BANKS, ProceduralScene
from fieldfuse.nerfusion.training.samples import Sample, TrainingScene
from fieldfuse.nerfusion.training.settings import SourceSettings, TrainSettings
from fieldfuse.nerfusion.training.shards import ShardScene, shard_files

SCENE, SAMPLE = 1, 2  # streams of random numbers
TRIES = 8  # scenes in a row that may turn out unusable before that is an error

T = TypeVar("T")
Maker = Callable[[np.random.Generator, int], TrainingScene]


class Mixture:
    """Samples without end.

    `window` scenes take turns and each serves `reuse` steps before the next window begins: drawing a scene costs more than using it.

    Args:
        rank: number of this process; each process sees other samples.
        device: where procedural scenes are drawn.

    Raises:
        InputError: a data set is not where the settings say.
    """

    def __init__(self, settings: TrainSettings, rank: int = 0, device: torch.device | str = "cpu") -> None:
        self.settings, self.rank = settings, rank
        used = [source for source in settings.sources if source.weight > 0]
        self._makers = [_maker(source, settings, torch.device(device)) for source in used]
        weights = np.array([source.weight for source in used])
        self._share = weights / weights.sum()
        self._scenes: dict[int, TrainingScene] = {}

    def scene_number(self, step: int) -> int:
        """The scene that serves a step."""
        window, reuse = self.settings.window, self.settings.reuse
        return step // (window * reuse) * window + step % window

    def sample(self, step: int, key_frames: int) -> Sample:
        """The sample of a step.

        Raises:
            InputError: several scenes in a row could not be used; the message is the last one's.
        """
        rng = np.random.default_rng([self.settings.seed, SAMPLE, self.rank, step])
        number = self.scene_number(step)
        for attempt in range(TRIES):
            try:
                return draw_sample(self._scene(number, attempt), rng, self.settings.pictures, self.settings.volume, key_frames)
            except InputError:
                if attempt == TRIES - 1:
                    raise
        raise AssertionError

    def _scene(self, number: int, attempt: int) -> TrainingScene:
        key = number * TRIES + attempt
        if key not in self._scenes:
            rng = np.random.default_rng([self.settings.seed, SCENE, self.rank, number, attempt])
            maker = self._makers[int(rng.choice(len(self._makers), p=self._share))]
            low, high = self.settings.pictures.long_side
            scene = maker(rng, 8 * round(rng.uniform(low, high) / 8))
            while len(self._scenes) >= self.settings.window:
                self._scenes.pop(next(iter(self._scenes)))
            self._scenes[key] = scene
        return self._scenes[key]


def _maker(source: SourceSettings, settings: TrainSettings, device: torch.device) -> Maker:
    if source.kind == "procedural":
        return partial(_procedural, source.scene, settings.pictures.frames, device)
    assert source.path is not None
    if source.kind == "shards":
        return partial(_among, shard_files(source.path), ShardScene)
    if source.kind == "scannet":
        return partial(_among, scannet_folders(source.path), scannet_scene)
    if source.kind == "dtu":
        return partial(_among, dtu_scenes(source.path), dtu_scene)
    if source.kind == "scanned_objects":
        return partial(_among, scanned_object_folders(source.path), scanned_object_scene)
    return partial(_among, synthetic_folders(source.path), synthetic_scene)


def _procedural(kind: str, frames: int, device: torch.device, rng: np.random.Generator, long_side: int) -> TrainingScene:
    chosen = kind if kind != "any" else ("object", "room")[int(rng.integers(2))]
    return ProceduralScene(chosen, rng, long_side, frames, int(rng.integers(BANKS)), device)


def _among(places: list[T], make: Callable[[T, int], TrainingScene], rng: np.random.Generator, long_side: int) -> TrainingScene:
    return make(places[int(rng.integers(len(places)))], long_side)
