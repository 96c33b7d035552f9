"""SIFT features of one picture, as COLMAP's database takes them. OpenCV finds them in a third of COLMAP's own time.

Where photos stand far apart, what is seen from the front in one is seen obliquely in the other, and looks different to SIFT. `tilted` looks
at pictures as if they were seen obliquely (ASIFT; Morel and Yu, "A New Framework for Fully Affine Invariant Image Comparison", 2009).
"""

from __future__ import annotations

import cv2
import numpy as np

from toolkit.camera import Array

CONTRAST = 0.014  # finds as many as COLMAP's own detector does with its threshold
TILTS = 3  # steps of the square root of two by which a picture is made narrower, in several directions each
TILTED_SIZE = 1000  # pixels of the long side: some forty pictures are looked at instead of one


def sift(grey: Array, most: int) -> tuple[Array, Array]:
    """The `most` largest features of (H, W) uint8, always the same ones: these are found again from other places.

    Returns:
        (N, 4) float32 keypoints: x and y in pixels, pixel centres at +0.5, scale in pixels, angle in radians; (N, 128) uint8 descriptors,
        512 times the root of their shares (root-SIFT; Arandjelović and Zisserman, CVPR 2012).
    """
    return _largest(_finder(), grey, most)


def tilted(grey: Array, most: int) -> tuple[Array, Array]:
    """As `sift`, of the picture and of oblique views of it: ten times as many features, of which many describe the same place."""
    return _largest(cv2.AffineFeature.create(_finder(), TILTS), grey, most)


def _finder() -> cv2.SIFT:
    # Without `enable_precise_upscale` all keypoints lie a quarter of a pixel off, right and below.
    return cv2.SIFT.create(contrastThreshold=CONTRAST, enable_precise_upscale=True)


def _largest(finder: cv2.Feature2D, grey: Array, most: int) -> tuple[Array, Array]:
    found, described = finder.detectAndCompute(np.ascontiguousarray(grey), None)
    if described is None or len(found) == 0:
        return np.zeros((0, 4), np.float32), np.zeros((0, 128), np.uint8)
    largest = np.argsort([-point.size for point in found], kind="stable")[:most]
    found, described = [found[i] for i in largest], described[largest]
    keypoints = np.array([(*point.pt, point.size / 2, np.deg2rad(point.angle)) for point in found], dtype=np.float32)
    keypoints[:, :2] += 0.5
    shares = described / np.maximum(described.sum(axis=1, keepdims=True), 1e-9)
    return keypoints, np.minimum(np.round(512 * np.sqrt(shares)), 255).astype(np.uint8)
