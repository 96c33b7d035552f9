"""DTU as MVSNeRF and NeRFusion use it: 16 training views of the 49, the first three of them alone for direct inference, 4 test views."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from fieldfuse.capture.types import Capture
from fieldfuse.evaluation.suites.base import Suite, Variant, split

TRAIN = (25, 21, 33, 22, 14, 15, 26, 30, 31, 35, 34, 43, 46, 29, 16, 36)
TEST = (32, 24, 23, 44)


def views(train: Sequence[int]) -> Callable[[Capture], Capture]:
    """These of the 49 views train, the four test views test; pictures are in the order of their numbers."""
    return lambda capture: split(capture, train, TEST)


SUITE = Suite(
    name="dtu",
    title="DTU",
    scenes=(),
    variants=(
        Variant("3-direct", "3 views, direct inference", views(TRAIN[:3]), fitted=False, reported={"psnr": 26.19}),
        Variant("3-fitted", "3 views, fitted", views(TRAIN[:3])),
        Variant("16-fitted", "16 views, fitted", views(TRAIN), reported={"psnr": 31.79}),
    ),
    protocol=f"training views {', '.join(map(str, TRAIN))}, the first three alone for direct inference;"
    f" test views {', '.join(map(str, TEST))}",
    differs="whole pictures are scored (of scans that bring masks, what these leave), the paper's are cut to the object's depth mask;"
    " one field of three views serves all test views,"
    " where the paper takes the three nearest for each",
    long_side=640,
)
