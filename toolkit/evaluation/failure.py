"""Says when a run failed: what its scores show, the likeliest cause by what the run found out, and the command to try next.

Scores are held against the nearest training image's, not against fixed decibels: 20 dB are good for one capture and bad for another.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

GAIN = 1.0  # dB above the nearest image that any field has that shows the scene; good ones have five or more after seconds
COPY = 40.0  # dB between two images above which they differ by noise and compression alone; hand-held neighbours reach 30
OVERFIT = 6.0  # dB: the error at held-out views is twice that at training views
COLOURS = 3.0  # dB that an affine correction of colours gains where colours are what is wrong
MEMORISED = 2.5  # times the gain over the nearest image: so much more was learned of single images than of the scene
GOOD = 26.0  # dB at which an image looks right: more of the training images' grain than that is no failure
NEAR = 30.0  # dB of the nearest image above which the camera hardly moved between them
HARM = 0.5  # dB by which neighbouring images are more alike before their colours are corrected than after, where the correction is wrong
DEPTH = 0.1  # median share by which a fit's depth is off the depth that it was fitted to: sensors err by 0.01 to 0.03
DARK = 6.0  # dB below the median view at which a view is named
UNSEEN = 0.25  # share of a view that fewer than two training cameras see, above which its score means little
FEW = 12  # training images below which docs/few_views.md applies
PLACED = 0.7  # share of frames with a pose below which something of the scene is missing
MATCHED = 0.1  # share of pixels whose depth is found by matching: right poses give a third and more, wrong ones a few per cent
MOVING = 0.05  # share of training pixels that were masked out since they show what moves
RISING = 0.5  # dB that the last quarter of a fit still gains
NAMED = 3  # views that a sentence names
CORRECTED = ("exposure", "vignetting", "distortion", "rolling_shutter", "motion_blur", "poses", "depth_offset")


def failures(report: dict[str, Any]) -> list[str]:
    """Sentences for the report's warnings, the gravest first; none for a run that went well.

    Args:
        report: as `fieldfuse.evaluation.report.report_data` answers; parts that are not known may be missing or None.
    """
    field = (report.get("evaluation") or {}).get("field") or {}
    nearest = (report.get("evaluation") or {}).get("nearest_image") or {}
    if field.get("psnr") is None or nearest.get("psnr") is None:
        return []
    copies = _copies(nearest)
    return [*copies, *([] if copies else _poor(report, field, nearest)), *_depth(report, field), *_unseen(field)]


def _copies(nearest: dict[str, Any]) -> list[str]:
    """Held-out images of which the training images have a copy: their scores, and every mean, are worth nothing."""
    views = nearest.get("per_view") or []
    same = [view for view in views if view["psnr"] is not None and view["psnr"] >= COPY]
    if not same:
        return []
    pairs = _named([f"{view['name']} and {view['nearest']}" for view in same])
    return [
        f"{len(same)} of {len(views)} held-out images equal a training image ({pairs}), so scores are too good; likely photos are there "
        "twice, or the camera stood still: remove the copies and run again"
    ]


def _poor(report: dict[str, Any], field: dict[str, Any], nearest: dict[str, Any]) -> list[str]:
    """A field that is no better than an image that was there before, or that shows its training images and nothing else."""
    held, floor, training = field["psnr"], nearest["psnr"], field.get("training_psnr")
    gain, gap = held - floor, 0.0 if training is None else training - held
    learned = held < GOOD and gap >= max(OVERFIT, MEMORISED * gain)
    if gain >= GAIN and not learned:
        return []
    shown = f"{held:.1f} dB at held-out views, {floor:.1f} by the nearest training image"
    shown += "" if training is None else f", {training:.1f} at training views"
    causes = list(dict.fromkeys(_causes(report, field, nearest, learned)))
    return [f"this field {'failed' if gain < GAIN else 'is poor'} ({shown}); likely {'; or '.join(causes[:2])}"]


def _depth(report: dict[str, Any], field: dict[str, Any]) -> list[str]:
    """Depth that came with the capture and that no field can have together with its images."""
    off = (field.get("depth") or {}).get("median_rel")
    used = ((report.get("settings") or {}).get("fit") or {}).get("depth_from") != "off" and (report.get("capture") or {}).get("depth")
    if off is None or off < DEPTH or not used:
        return []
    return [
        f"the field is {100 * off:.0f}% off the capture's depth in the median, though it was fitted to it; likely its unit is another one, "
        "or it is not registered with the images: check the depth scale, or run again with --set fit.depth_from=off"
    ]


def _causes(report: dict[str, Any], field: dict[str, Any], nearest: dict[str, Any], learned: bool) -> Iterator[str]:
    """Causes with what to do, the likeliest first; never none."""
    views, poses, about = report.get("views") or {}, report.get("poses") or {}, report.get("field") or {}
    train = (views.get("total") or 0) - (views.get("test") or 0)
    matched, left_out = (about.get("matched") or {}).get("share"), (about.get("left_out") or {}).get("share")
    effects = [entry["effect"] for entry in (report.get("effects") or {}).get("effects", []) if entry.get("on")]
    corrected = [name for name in CORRECTED if name in effects]
    held = field["psnr"]
    given, registered, total = poses.get("source") == "given", poses.get("registered") or 0, poses.get("total") or 0
    apart = matched is not None and matched < MATCHED
    if train < FEW and not (given and apart):
        yield f"there are too few training images ({train}): film more from places in between, or see docs/few_views.md"
    if nearest["psnr"] >= NEAR:
        yield "the camera hardly moved, so that held-out images are nearly training images: film while moving sideways"
    wrong_colours = (nearest.get("psnr_uncorrected") or 0) - nearest["psnr"] >= HARM
    if wrong_colours:
        yield "the correction of exposure does harm: run again with --set effects=off"
    elif "exposure" not in effects and (field.get("psnr_corrected") or 0) - held >= COLOURS:
        yield "exposure or white balance differs between images: lock both when filming"
    if given and (learned or apart):
        yield "the poses that came with the capture do not fit its images: run again with --poses sfm"
    if total and registered < PLACED * total:
        yield f"only {registered} of {total} frames have a pose: film with more overlap and more slowly"
    if corrected and not wrong_colours:
        yield f"a correction does harm ({', '.join(corrected).replace('_', ' ')}): run again with --set effects=off"
    if left_out is not None and left_out >= MOVING:
        yield f"things move ({100 * left_out:.0f}% of the training pixels): film while nothing does, or add masks"
    if _rising(report.get("timeline") or []):
        yield "the fit was too short: run again with a larger --budget"
    if apart and not given:
        yield "the images have little in common: film with more overlap, from places that are farther apart"
    if given and not learned:
        yield "the poses that came with the capture do not fit its images: run again with --poses sfm"
    yield "something moves, shines or is blurred: compare the images in report.html, and film again"


def _rising(timeline: list[dict[str, Any]]) -> bool:
    """Whether the last quarter of the fit's seconds still gained at held-out views."""
    points = [(point["seconds"], point["psnr"]) for point in timeline if point.get("psnr") is not None]
    if len(points) < 2:
        return False
    before = [psnr for seconds, psnr in points if seconds <= 0.75 * points[-1][0]]
    return bool(before) and points[-1][1] - before[-1] >= RISING


def _unseen(field: dict[str, Any]) -> list[str]:
    """Held-out views that look where nobody filmed, when they are worse than the others."""
    views = [view for view in field.get("per_view") or [] if view.get("seen") is not None and view.get("psnr") is not None]
    if not views:
        return []
    low = float(np.median([view["psnr"] for view in views])) - DARK
    blind = [view for view in views if view["seen"] <= 1 - UNSEEN and (view["psnr"] <= low or len(views) == 1)]
    mean = float(np.mean([view["seen"] for view in views]))
    if mean <= 1 - UNSEEN:
        return [
            f"{100 * (1 - mean):.0f}% of what held-out views show is seen by fewer than two training images, so it cannot be right there: "
            "film the same places from more sides"
        ]
    if not blind:
        return []
    names = _named([f"{view['name']}: {view['psnr']:.1f} dB, {100 * (1 - view['seen']):.0f}% seen by fewer than two" for view in blind])
    return [f"{len(blind)} of {len(views)} held-out views look where hardly any training image does ({names}); film there too"]


def _named(texts: list[str]) -> str:
    return "; ".join(texts[:NAMED]) + ("; …" if len(texts) > NAMED else "")
