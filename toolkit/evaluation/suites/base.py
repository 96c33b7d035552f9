"""What a benchmark is: scenes in a folder, variants of a protocol, and numbers that a paper reports for it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from fieldfuse.capture.detect import detect_kind
from fieldfuse.capture.listing import natural_key
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.errors import InputError

PAPER = "NeRFusion (CVPR 2022)"
SCENE_MARKS = ("transforms*.json", "poses_bounds.npy", "cameras*.npz", "pose", "sparse", "cameras.txt", "frame-*.pose.txt", "seq-01")


@dataclass(frozen=True)
class Variant:
    """One way to use a scene.

    Attributes:
        pick: the frames that take part, with their `split` set ("train" or "test").
        fitted: fitted to the training views; False: the field that the networks give directly.
        reported: measure → what the paper says, the mean over all of the suite's scenes; empty when it says nothing.
    """

    key: str
    title: str
    pick: Callable[[Capture], Capture]
    fitted: bool = True
    reported: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Suite:
    """A benchmark.

    Attributes:
        scenes: their names; empty: any.
        long_side: of the pictures in pixels; None: as the run's settings say.
        protocol: one sentence; `differs` says what is not as in the paper.
    """

    name: str
    title: str
    scenes: tuple[str, ...]
    variants: tuple[Variant, ...]
    protocol: str
    differs: str = ""
    long_side: int | None = None

    def find(self, root: Path, wanted: Sequence[str] | None = None) -> list[tuple[str, Path]]:
        """Name and folder of the scenes below `root` (or of `root` itself, when it is one), in the suite's order.

        Args:
            wanted: names; None: all that are there.

        Raises:
            InputError: nothing is there, or not what was asked for.
        """
        if not root.is_dir():
            raise InputError(f"{root} is not a folder; give the one that holds the scenes of {self.title}")
        below = sorted((path for path in root.iterdir() if path.is_dir()), key=lambda path: natural_key(path.name))
        # Folders of any name, with colour, depth and poses, may as well belong to several scenes.
        if is_scene(root) and not (detect_kind(root) == "rgbd" and any(map(is_scene, below))):
            found = {root.name: root}
        else:
            found = {path.name: path for path in below if is_scene(path)}
            if self.scenes:
                found = {name: found[name] for name in self.scenes if name in found}
        if wanted is not None:
            missing = [name for name in wanted if name not in found]
            if missing:
                raise InputError(f"{root} holds no scene {missing[0]!r}; there are {', '.join(found) or 'none'}")
            found = {name: found[name] for name in wanted}
        if not found:
            names = f" ({', '.join(self.scenes)})" if self.scenes else ""
            raise InputError(f"{root} holds no scene of {self.title}{names}; give the folder that has one subfolder a scene")
        return list(found.items())

    def variant(self, key: str) -> Variant:
        """A variant by its key.

        Raises:
            InputError: there is none.
        """
        for one in self.variants:
            if one.key == key:
                return one
        raise InputError(f"{self.name} has no variant {key!r}; known are {', '.join(one.key for one in self.variants)}")


def is_scene(path: Path) -> bool:
    """A folder that a posed capture's reader would take, or that has a file of one: a scene that is broken is told of, not left out."""
    return any(next(path.glob(mark), None) is not None for mark in SCENE_MARKS) or detect_kind(path) not in (None, "photos")


def split(capture: Capture, train: Sequence[int], test: Sequence[int]) -> Capture:
    """The capture's frames `train` and `test` (indices in its own order), marked so; all others are left out.

    Raises:
        InputError: a frame that does not exist, or one that is both.
    """
    count = len(capture.frames)
    outside = [index for index in (*train, *test) if not 0 <= index < count]
    if outside or set(train) & set(test):
        raise InputError(
            f"{capture.root} has {count} pictures, and the protocol needs number {max([*train, *test])}; check that it is whole"
        )
    marks = {**dict.fromkeys(train, "train"), **dict.fromkeys(test, "test")}
    frames = tuple(replace(capture.frames[index], split=marks[index]) for index in sorted(marks))
    return replace(capture, frames=frames)


def every(step: int, first: int = 0) -> Callable[[Capture], Capture]:
    """Every `step`-th picture by name is a test view, from the picture `first` on."""

    def pick(capture: Capture) -> Capture:
        order = sorted(range(len(capture.frames)), key=lambda index: natural_key(capture.frames[index].name))
        test = order[first::step]
        return split(capture, [index for index in order if index not in set(test)], test)

    return pick


def own_split(capture: Capture) -> Capture:
    """Train and test as the capture's own files say.

    Raises:
        InputError: they say nothing.
    """
    if not any(frame.split == "test" for frame in capture.frames):
        raise InputError(f"{capture.root} brings no test split; it needs transforms_train.json and transforms_test.json")
    return capture


def summary(rows: Sequence[dict[str, Any]], measures: Sequence[str]) -> dict[str, float | None]:
    """Mean over scenes of what is known."""
    out: dict[str, float | None] = {}
    for key in measures:
        known = [row[key] for row in rows if row.get(key) is not None]
        out[key] = float(np.mean(known)) if known else None
    return out


__all__ = ["PAPER", "Capture", "Frame", "Suite", "Variant", "every", "is_scene", "own_split", "split", "summary"]
