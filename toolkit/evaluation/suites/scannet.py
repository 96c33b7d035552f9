"""ScanNet as in NerfingMVS: eight rooms by name, a local region of about 40 pictures of each.

What is published of a room has a `train.txt` and a `test.txt` beside `images/`, a picture's name a line; they are the protocol's split.
Rooms without them (ScanNet's own `.sens`, or cut from its export) have every eighth picture held out.
"""

from __future__ import annotations

from pathlib import Path

from fieldfuse.capture.listing import read_text
from fieldfuse.capture.types import Capture
from fieldfuse.errors import InputError
from fieldfuse.evaluation.suites.base import Suite, Variant, every, split

LISTS = ("train.txt", "test.txt")
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


def pick(capture: Capture) -> Capture:
    """The split of the room's own lists, else every eighth picture by name. Pictures that no list names are left out.

    Raises:
        InputError: a list names a picture that is not there or has no pose, or one picture is on both lists.
    """
    lists = [capture.root / name for name in LISTS]
    if not all(path.is_file() for path in lists):
        return every(8)(capture)
    # Pictures inside a .sens file have no file names, and are called as they would be exported.
    names = [frame.image.stem if frame.video_index is None else frame.name for frame in capture.frames]
    numbers = {name: index for index, name in enumerate(names)}
    return split(capture, *(_listed(path, numbers) for path in lists))


def _listed(path: Path, numbers: dict[str, int]) -> list[int]:
    """The numbers of the pictures that a list names; suffixes do not count, since smaller copies of the pictures are PNG."""
    names = [line.strip() for line in read_text(path).splitlines() if line.strip()]
    lost = [name for name in names if Path(name).stem not in numbers]
    if lost or not names:
        what = f"names {lost[0]}, which is not among the pictures with a pose" if lost else "names no picture"
        raise InputError(f"{path} {what}; put it right, or take both lists away to hold out every eighth picture")
    return [numbers[Path(name).stem] for name in names]


SUITE = Suite(
    name="scannet",
    title="ScanNet, the scenes of NerfingMVS",
    scenes=SCENES,
    variants=(
        Variant("direct", "direct inference", pick, fitted=False, reported={"psnr": 22.99}),
        Variant("fitted", "fitted", pick),
    ),
    protocol="the eight scenes as NerfingMVS cuts them, held out what a scene's test.txt names, else every eighth picture, at 640 pixels",
    differs="a folder with more pictures than the published part of a scene is used whole; a sensor's depth is used where a scene brings it"
    " (--set fit.depth_from=off --set network.depth_from=off leaves it out), the paper's method sees pictures alone",
    long_side=640,
)
