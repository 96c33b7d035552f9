"""From a job and its features to the pairs that are matched. Runs in the child process only."""

from __future__ import annotations

import pycolmap

from fieldfuse.poses.database import Report, sketches
from fieldfuse.poses.job import MAX_EXHAUSTIVE, Job
from fieldfuse.poses.pairs import (
    exhaustive_pairs,
    loop_pairs,
    sequential_pairs,
    similar_pairs,
)

LOOP_ANCHORS = 60  # frames of a video that are compared with each other to find loops


def choose_pairs(job: Job, database: pycolmap.Database, report: Report) -> list[tuple[int, int]]:
    """Ordered captures: neighbours, doubling gaps, and a few loops. Photos: all pairs while these are few, else pairs that look alike."""
    count = len(job.pictures)
    if job.sequential:
        report(0, count, "looking for loops")
        loops = loop_pairs(sketches(job, database), stride=max(1, -(-count // LOOP_ANCHORS)))
        return sorted(set(sequential_pairs(count)) | set(loops))
    if count <= MAX_EXHAUSTIVE:
        return exhaustive_pairs(count)
    report(0, count, "choosing pairs that look alike")
    return similar_pairs(sketches(job, database))
