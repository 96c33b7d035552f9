"""LLFF's forward-facing scenes: every eighth picture is held out."""

from __future__ import annotations

from fieldfuse.evaluation.suites.base import Suite, Variant, every

SUITE = Suite(
    name="llff",
    title="LLFF",
    scenes=("fern", "flower", "fortress", "horns", "leaves", "orchids", "room", "trex"),
    variants=(Variant("fitted", "fitted", every(8)),),
    protocol="every eighth picture by name is held out, the first one included, at 1008 pixels",
    differs="a COLMAP model beside the pictures goes before poses_bounds.npy, and its lens is taken out of them before they are scored",
    long_side=1008,
)
