"""One process that reads damaged files: `python -m tests.stability.fuzz.worker FOLDER SEED FIRST COUNT [TARGET …]`.

It writes what it is about to read into FOLDER/current (so that a crash leaves its input), and what went wrong as JSON lines on stdout.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
import traceback
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import numpy as np
import torch
from PIL import Image

from fieldfuse.errors import FieldfuseError
from tests.stability.fuzz.mutate import damage
from tests.stability.fuzz.targets import TARGETS, Target
from tests.stability.fuzz.watch import Hang, Watch, bound_memory, tree

SENTENCE = 10, 800  # characters


@dataclass
class Counts:
    """Since the last message."""

    inputs: int = 0
    refused: int = 0
    targets: Counter[str] = field(default_factory=Counter)

    def told(self, kind: str) -> Counts:
        say(kind=kind, inputs=self.inputs, refused=self.refused, targets=self.targets)
        return Counts()


def say(**message: object) -> None:
    sys.stdout.write(json.dumps(message) + "\n")
    sys.stdout.flush()


def warm_up(target: Target, root: Path) -> None:
    """Read the sample as it is, so that everything is imported, and one that is damaged, for what only errors import."""
    for number in range(4):
        target.act(root, number)


def one(target: Target, root: Path, number: int, seed: int, watch: Watch, current: Path, counts: Counts) -> dict[str, object] | None:
    """Damage, read, restore. What went wrong, or None."""
    rng = np.random.default_rng([seed, number])
    name = target.files[int(rng.integers(len(target.files)))]
    path = root / name
    whole = path.read_bytes()
    content = damage(whole, name, rng)
    current.write_text(json.dumps({"target": target.name, "file": name, "number": number, "seed": seed}))
    path.write_bytes(content)
    problem: dict[str, object] | None = None
    counts.inputs += 1
    counts.targets[target.name] += 1
    try:
        with watch.watching():
            target.act(root, number)
    except FieldfuseError as error:
        counts.refused += 1
        if "\n" in str(error) or not SENTENCE[0] <= len(str(error)) <= SENTENCE[1]:
            problem = {"kind": "not a sentence", "text": str(error)[:300]}
    except Hang as error:
        problem = {"kind": "hang", "text": str(error), "trace": traceback.format_exc()[-1500:]}
    except BaseException as error:  # everything else is what this looks for
        problem = {"kind": type(error).__name__, "text": str(error)[:300], "trace": traceback.format_exc()[-1500:]}
    finally:
        path.write_bytes(whole)
    if watch.escapes:
        problem = {"kind": "escape", "text": "; ".join(watch.escapes[:3])}
    if problem is not None:
        problem |= {"target": target.name, "file": name, "number": number, "seed": seed}
    return problem


def main() -> int:
    folder, seed, first, count, *names = sys.argv[1:]
    place = Path(folder)
    captures = place / "captures"
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    Image.init()
    chosen = [target for target in TARGETS if not names or target.name in names]
    for target in chosen:
        root = captures / target.name.replace(" ", "_")
        if root.exists():  # of a worker that was ended in the middle of an input
            shutil.rmtree(root)
        target.make(root)
        warm_up(target, root)
    outside = place / "outside"
    outside.mkdir(exist_ok=True)
    (outside / "secret.txt").write_text("nobody reads or changes this")
    share = np.array([target.weight for target in chosen])
    share /= share.sum()
    watch = Watch(captures)
    before = (tree(outside), {target.name: set(tree(captures / target.name.replace(" ", "_"))) for target in chosen})
    bound_memory()
    counts = Counts()
    for number in range(int(first), int(first) + int(count)):
        target = chosen[int(np.random.default_rng([int(seed), number, 1]).choice(len(chosen), p=share))]
        problem = one(target, captures / target.name.replace(" ", "_"), number, int(seed), watch, place / "current", counts)
        if problem is not None:
            say(**problem)
        if counts.inputs == 200:
            counts = counts.told("progress")
    after = (tree(outside), {target.name: set(tree(captures / target.name.replace(" ", "_"))) for target in chosen})
    if before != after:
        say(kind="escape", text="files appeared, vanished or changed where nothing may be written")
    counts.told("done")
    return 0


if __name__ == "__main__":
    sys.exit(main())
