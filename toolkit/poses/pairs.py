"""Which pairs of images are worth matching. Pure NumPy: no vocabulary, no downloaded weights.

Images that overlap share their coarsest features, so a few hundred of them an image show overlap at a thousandth of the
cost of matching all (preemptive matching, Wu 2013, "Towards linear-time incremental structure from motion").
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from itertools import combinations

import numpy as np

from fieldfuse.camera import Array
from fieldfuse.poses.job import MAX_EXHAUSTIVE, Job

Pairs = list[tuple[int, int]]  # (i, j), i < j, ascending
COARSE = 256  # features of the largest scale looked at for each image
RATIO = 0.85  # of the angle to the best and to the second best match
MIN_COMMON = 4  # coarse matches that hint at overlap
# Frames of a video from one to the other of a pair. Tracks go on from pair to pair: with all of 1 to 10, poses are as good, and matching
# takes half as long again (docs/measured/performance.md).
FAR_STEPS = (20, 40, 80, 160)
STEPS = (1, 2, 3, 5, 7, 10, *FAR_STEPS)
EVERY_STEP = (*range(1, 11), *FAR_STEPS)
FEW_FRAMES = 60  # up to which every step of the next ten is taken: frames lie far apart there, and each match counts
BESIDE = 2  # instants from one to the other of which views that look the same way are matched whatever they share
MIN_COMMON_VIEWS = 3  # coarse matches between two views, of instants that go together
FEW_INSTANTS, EACH_INSTANT = 12, 8  # instants of which all are matched with each other, and those that one is matched with of more
EACH_VIEW = 2  # views of another instant that one is matched with at most
LOOPS = 3  # such pairs of a frame at most
LOOP_GAP = 20  # frames apart before a pair counts as a loop
LOOP_ANCHORS = 60  # frames of a video that are compared with each other to find loops
EACH = 20  # photos that one is matched with at most, by what they share


def choose_pairs(job: Job, sketches: Callable[[], list[Array]], report: Callable[[float, float, str], None]) -> Pairs:
    """Ordered captures: neighbours, doubling gaps, and a few loops. Photos: all pairs while these are few, else pairs that look alike.

    Args:
        sketches: gives the coarsest descriptors of every image.
    """
    count = len(job.images)
    if job.rigged:
        report(0, count, "choosing pairs of views")
        return view_pairs(job, sketches())
    if job.sequential:
        report(0, count, "looking for loops")
        return sorted({*sequential_pairs(count), *loop_pairs(sketches(), stride=max(1, -(-count // LOOP_ANCHORS)))})
    if count <= MAX_EXHAUSTIVE:
        return list(combinations(range(count), 2))
    report(0, count, "choosing pairs that look alike")
    return similar_pairs(sketches())


def view_pairs(job: Job, sketches: list[Array]) -> Pairs:
    """Pairs of views of different instants: of instants that go together (by order, by what they share, or all while these are few) those
    views that share coarse features, and of neighbours also those that look the same way."""
    groups, count = job.instants, len(job.instants)
    whole = [np.concatenate([sketches[index] for index in views]) for views in groups]
    owner = [np.concatenate([np.full(len(sketches[index]), index) for index in views]) for views in groups]
    if job.sequential:
        loops = loop_pairs(whole, stride=max(1, -(-count // LOOP_ANCHORS)))
        together = sorted({*sequential_pairs(count, STEPS), *loops})
    elif count <= FEW_INSTANTS:
        together = list(combinations(range(count), 2))
    else:
        together = similar_pairs(whole, EACH_INSTANT)
    pairs = set[tuple[int, int]]()
    for one, other in together:
        matched = matches_of(whole[one], whole[other])
        shared = Counter(zip(owner[one][matched[:, 0]].tolist(), owner[other][matched[:, 1]].tolist(), strict=True))
        best = Counter[int]()
        for pair, number in shared.most_common():
            if number >= MIN_COMMON_VIEWS and best[pair[0]] < EACH_VIEW:
                pairs.add(pair)
                best[pair[0]] += 1
        if other - one <= BESIDE and len(groups[one]) == len(groups[other]):
            pairs |= set(zip(groups[one], groups[other], strict=True))
    return sorted((min(pair), max(pair)) for pair in pairs)


def pairs_with(some: list[int], count: int) -> Pairs:
    """All pairs of which one is in `some`."""
    return sorted({(min(i, j), max(i, j)) for i in some for j in range(count) if i != j})


def sequential_pairs(count: int, steps: tuple[int, ...] | None = None) -> Pairs:
    """Each frame with those `steps` later; None: `EVERY_STEP` of few frames, `STEPS` of many."""
    steps = steps or (EVERY_STEP if count <= FEW_FRAMES else STEPS)
    return [(i, i + step) for i in range(count) for step in steps if i + step < count]


def coarse(descriptors: Array, scales: Array, most: int = COARSE) -> Array:
    """(N, 128) descriptors and (N,) scales → the `most` of the largest scale, unit length, float32."""
    order = np.argsort(-np.asarray(scales), kind="stable")[:most]
    chosen = np.asarray(descriptors)[order].astype(np.float32)
    norms = np.linalg.norm(chosen, axis=1, keepdims=True)
    return np.ascontiguousarray(chosen / np.maximum(norms, 1e-6))


def common(first: Array, second: Array) -> int:
    """Number of mutual best matches between two sets of unit descriptors that also pass the ratio test."""
    return len(matches_of(first, second))


def matches_of(first: Array, second: Array) -> Array:
    """(K, 2) indices of these matches."""
    if len(first) < 2 or len(second) < 2:
        return np.zeros((0, 2), np.int64)
    similarity = first @ second.T
    forward = similarity.argmax(axis=1)
    mutual = similarity.argmax(axis=0)[forward] == np.arange(len(first))
    rows = similarity[mutual]
    if len(rows) == 0:
        return np.zeros((0, 2), np.int64)
    top = np.partition(rows, -2, axis=1)[:, -2:]
    angle = np.arccos(np.clip(top, -1.0, 1.0))
    sure = np.flatnonzero(mutual)[angle[:, 1] < RATIO * angle[:, 0]]
    return np.stack([sure, forward[sure]], axis=1)


def loop_pairs(sketches: list[Array], stride: int) -> Pairs:
    """Pairs of far-apart frames of an ordered capture that look alike: every `stride`-th frame against every other such frame."""
    anchors = list(range(0, len(sketches), max(1, stride)))
    pairs = set()
    for a, i in enumerate(anchors):
        scored = [(common(sketches[i], sketches[j]), -j) for j in anchors[a + 1 :] if j - i > LOOP_GAP]
        pairs |= {(i, -j) for score, j in sorted(scored, reverse=True)[:LOOPS] if score >= MIN_COMMON}
    return sorted(pairs)


def similar_pairs(sketches: list[Array], each: int = EACH) -> Pairs:
    """Each image with the `each` that share most coarse features with it, and with its two neighbours in the list."""
    count = len(sketches)
    scores = np.zeros((count, count), dtype=np.int32)
    for i in range(count):
        for j in range(i + 1, count):
            scores[i, j] = scores[j, i] = common(sketches[i], sketches[j])
    pairs = set(sequential_pairs(count, (1, 2)))
    for i in range(count):
        best = np.argsort(-scores[i], kind="stable")[:each]
        pairs |= {(min(i, int(j)), max(i, int(j))) for j in best if scores[i, j] >= MIN_COMMON}
    return sorted(pairs)
