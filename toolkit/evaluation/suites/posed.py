"""Any posed captures: the split that they bring, else every eighth picture."""

from __future__ import annotations

from fieldfuse.capture.types import Capture
from fieldfuse.evaluation.suites.base import Suite, Variant, every


def pick(capture: Capture) -> Capture:
    """The capture's own split when it has one, else every eighth picture by name."""
    return capture if any(frame.split == "test" for frame in capture.frames) else every(8)(capture)


SUITE = Suite(
    name="posed",
    title="Posed captures",
    scenes=(),
    variants=(Variant("direct", "direct inference", pick, fitted=False), Variant("fitted", "fitted", pick)),
    protocol="the capture's own split, else every eighth picture by name is held out",
)
