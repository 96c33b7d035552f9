"""Scores after a correction of colour that a picture gets for itself: fitted on its left half, scored on its right.

c' = A c + b, with A (3, 3) and b (3,) by least squares over the left half: exposure and white balance are forgiven, detail is not, and no
pixel that is scored takes part in the fit.
"""

from __future__ import annotations

import numpy as np

from fieldfuse.camera import Array
from fieldfuse.evaluation.images import psnr
from fieldfuse.evaluation.pixels import as_float

FEWEST = 64  # pixels of the left half


def corrected(rendered: Array, truth: Array, valid: Array | None = None) -> Array | None:
    """(H, W, 3) float64 rendering with the left half's affine correction, clipped to [0, 1]; None where that half has too few pixels."""
    source, target = as_float(rendered), as_float(truth)
    use = np.ones(source.shape[:2], dtype=bool) if valid is None else np.asarray(valid).astype(bool).copy()
    use[:, source.shape[1] // 2 :] = False
    if int(use.sum()) < FEWEST:
        return None
    columns = np.concatenate([source[use], np.ones((int(use.sum()), 1))], axis=1)
    matrix, *_ = np.linalg.lstsq(columns, target[use], rcond=None)
    flat = np.concatenate([source.reshape(-1, 3), np.ones((source.shape[0] * source.shape[1], 1))], axis=1)
    return np.asarray(np.clip(flat @ matrix, 0, 1).reshape(source.shape))


def right_half_psnr(rendered: Array, truth: Array, valid: Array | None = None) -> float | None:
    """PSNR of the right half after the left half's correction; None where there is nothing to fit or to score."""
    changed = corrected(rendered, truth, valid)
    if changed is None:
        return None
    use = np.ones(changed.shape[:2], dtype=bool) if valid is None else np.asarray(valid).astype(bool).copy()
    use[:, : changed.shape[1] // 2] = False
    return psnr(changed, truth, use) if use.any() else None
