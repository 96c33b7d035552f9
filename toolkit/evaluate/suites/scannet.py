"""ScanNet as in NerfingMVS: eight rooms by name, a local region of about 40 pictures of each, every eighth held out."""

from __future__ import annotations

from toolkit.evaluate.suites.base import Suite, Variant, every

SCENES = (
    "scene0000_01",
    "scene0079_00",
    "scene0158_00",
    "scene0316_00",
    "scene0521_00",
    "scene0553_00",
    "scene0616_00",
    "scene0653_00",
)

SUITE = Suite(
    name="scannet",
    title="ScanNet, the scenes of NerfingMVS",
    scenes=SCENES,
    variants=(
        Variant("direct", "direct inference", every(8), fitted=False, reported={"psnr": 22.99}),
        Variant("fitted", "fitted", every(8)),
    ),
    protocol="the eight scenes as NerfingMVS cuts them, every eighth picture held out, at 640 pixels",
    differs="a folder with more pictures than the published part of a scene is used whole",
    long_side=640,
)
