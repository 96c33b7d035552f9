"""What a fit leaves beside its field: remarks, what matching found, pixels that it did without."""

from __future__ import annotations

from typing import Any

from fieldfuse.pipelines.job import Job
from fieldfuse.pipelines.kept import MATCHED, NOTES, read_kept
from fieldfuse.stereo.transients import LeftOut

FIT_NOTES = "fit_notes.json"  # what a reader of the numbers has to know of the fit; there only when there is something
LEFT_OUT = "left_out.safetensors"  # pixels that the fit did without, since they show what moves; there only when they were looked for
FIT_MATCHED = "fit_matched.json"  # what the fit's quick matching found; there only when it was made


def fit_notes(job: Job) -> list[str]:
    """What the fit of this run's field had to say."""
    record = job.stages.records.get("field")
    return list(read_kept(job.folder / FIT_NOTES, NOTES)) if record is not None and FIT_NOTES in record.outputs else []


def fit_matched(job: Job) -> dict[str, Any] | None:
    """What this run's fit found by matching pictures before it began: pictures, long side, share of pixels with depth, seconds."""
    record = job.stages.records.get("field")
    return read_kept(job.folder / FIT_MATCHED, MATCHED) if record is not None and FIT_MATCHED in record.outputs else None


def fit_left_out(job: Job) -> LeftOut | None:
    """The pixels that this run's fit did without, since they show what moves; None: they were not looked for."""
    from fieldfuse.stereo.transients import load_left_out

    record = job.stages.records.get("field")
    return load_left_out(job.folder / LEFT_OUT) if record is not None and LEFT_OUT in record.outputs else None
