"""Which scene serves which step: sources mixed by weight, every choice drawn from (seed, process, step), so that nothing needs storing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch

from fieldfuse.errors import InputError
from fieldfuse.nerfusion.training import scenes
from fieldfuse.nerfusion.training.procedural import BANKS, ProceduralScene
from fieldfuse.nerfusion.training.samples import Sample, TrainingScene, draw_sample
from fieldfuse.nerfusion.training.settings import SourceSettings, TrainSettings

SCENE, SAMPLE = 1, 2  # streams of random numbers
TRIES = 8  # scenes in a row that may turn out unusable before that is an error

# By kind of source: what finds its scenes in a folder, and what opens one of them for a long side.
FOLDERS: dict[str, tuple[Callable[[str], Sequence[Any]], Callable[[Any, int], TrainingScene]]] = {
    "shards": (scenes.shard_files, scenes.ShardScene),
    "scannet": (scenes.scannet_folders, scenes.scannet_scene),
    "dtu": (scenes.dtu_scenes, scenes.dtu_scene),
    "scanned_objects": (scenes.scanned_object_folders, scenes.scanned_object_scene),
    "synthetic": (scenes.synthetic_folders, scenes.synthetic_scene),
}


class Mixture:
    """Samples without end. `window` scenes take turns and each serves `reuse` steps before the next window begins: drawing a scene costs
    more than using it.

    Args:
        rank: number of this process; each process draws other samples.
        device: where procedural scenes are drawn.

    Raises:
        InputError: a data set is not where the settings say.
    """

    def __init__(self, settings: TrainSettings, rank: int = 0, device: torch.device | str = "cpu") -> None:
        self.settings, self.rank, self.device = settings, rank, torch.device(device)
        self._sources = [source for source in settings.sources if source.weight > 0]
        self._places = [FOLDERS[one.kind][0](one.path) if one.kind != "procedural" and one.path else () for one in self._sources]
        weights = np.array([source.weight for source in self._sources])
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
            chosen = int(rng.choice(len(self._sources), p=self._share))
            low, high = self.settings.pictures.long_side
            scene = self._open(self._sources[chosen], self._places[chosen], rng, 8 * round(rng.uniform(low, high) / 8))
            while len(self._scenes) >= self.settings.window:
                self._scenes.pop(next(iter(self._scenes)))
            self._scenes[key] = scene
        return self._scenes[key]

    def _open(self, source: SourceSettings, places: Sequence[Any], rng: np.random.Generator, long_side: int) -> TrainingScene:
        if source.kind != "procedural":
            return FOLDERS[source.kind][1](places[int(rng.integers(len(places)))], long_side)
        kind = source.scene if source.scene != "any" else ("object", "room")[int(rng.integers(2))]
        return ProceduralScene(kind, rng, long_side, self.settings.pictures.frames, int(rng.integers(BANKS)), self.device)
