"""Features of one image, as COLMAP's database takes them: SIFT, which OpenCV finds in a third of COLMAP's own time, or learned ones."""

from __future__ import annotations

import cv2
import numpy as np

from fieldfuse.camera import Array
from fieldfuse.poses.job import SIFT

CONTRAST = 0.014  # finds as many as COLMAP's own detector does with its threshold


def sift(grey: Array, most: int) -> tuple[Array, Array]:
    """The `most` largest features of (H, W) uint8, always the same ones: these are found again from other places.

    Returns:
        (N, 4) float32 keypoints: x and y in pixels, pixel centres at +0.5, scale in pixels, angle in radians; (N, 128) uint8 descriptors,
        512 times the root of their shares (root-SIFT; Arandjelović and Zisserman, CVPR 2012).
    """
    # Without `enable_precise_upscale` all keypoints lie a quarter of a pixel off, right and below.
    finder = cv2.SIFT.create(contrastThreshold=CONTRAST, enable_precise_upscale=True)
    found, described = finder.detectAndCompute(np.ascontiguousarray(grey), None)
    if described is None or len(found) == 0:
        return np.zeros((0, 4), np.float32), np.zeros((0, 128), np.uint8)
    largest = np.argsort([-point.size for point in found], kind="stable")[:most]
    found, described = [found[i] for i in largest], described[largest]
    keypoints = np.array([(*point.pt, point.size / 2, np.deg2rad(point.angle)) for point in found], dtype=np.float32)
    keypoints[:, :2] += 0.5
    shares = described / np.maximum(described.sum(axis=1, keepdims=True), 1e-9)
    return keypoints, np.minimum(np.round(512 * np.sqrt(shares)), 255).astype(np.uint8)


def learned(grey: Array, most: int) -> tuple[Array, Array]:
    """As `sift`, by XFeat: the surest first; (N, 128) uint8 are the bytes of (N, 64) float16."""
    from fieldfuse.poses import xfeat  # torch takes a second and 200 MB, and is not always needed

    network = xfeat.installed()
    assert network is not None  # a job with these features is made only where the weights are
    keypoints, descriptors = xfeat.detect(network, grey, most)
    return keypoints, descriptors.astype(np.float16).view(np.uint8)


def floats(descriptors: Array, features: str) -> Array:
    """(N, 128) uint8 from the database → (N, 128) or (N, 64) float32."""
    rows = np.ascontiguousarray(descriptors, dtype=np.uint8).reshape(-1, 128)
    return (rows if features == SIFT else rows.view(np.float16)).astype(np.float32)
