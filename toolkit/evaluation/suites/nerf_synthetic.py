"""NeRF-synthetic: eight made-up objects with the splits of their Blender files, on white."""

from __future__ import annotations

from fieldfuse.evaluation.suites.base import Suite, Variant, own_split

SUITE = Suite(
    name="nerf-synthetic",
    title="NeRF-synthetic",
    scenes=("chair", "drums", "ficus", "hotdog", "lego", "materials", "mic", "ship"),
    variants=(
        Variant("direct", "direct inference", own_split, fitted=False, reported={"psnr": 25.47}),
        Variant("fitted", "fitted", own_split),
    ),
    protocol="training pictures and test pictures as the files say, composited on white, at 800×800",
    long_side=800,
)
