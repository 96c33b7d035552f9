"""Protocols of published benchmarks: which scenes, which images train and test, what the paper reports."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from fieldfuse.capture.detect import detect_kind
from fieldfuse.capture.listing import natural_key, read_text
from fieldfuse.capture.types import Capture
from fieldfuse.errors import InputError

PAPER = "NeRFusion (CVPR 2022)"
SCENE_MARKS = ("transforms*.json", "poses_bounds.npy", "cameras*.npz", "pose", "sparse", "cameras.txt", "frame-*.pose.txt", "seq-01")
DTU_TRAIN = (25, 21, 33, 22, 14, 15, 26, 30, 31, 35, 34, 43, 46, 29, 16, 36)
DTU_TEST = (32, 24, 23, 44)
SCANNET_LISTS = ("train.txt", "test.txt")
SCANNET_SCENES = (
    "scene0000_01",
    "scene0079_00",
    "scene0158_00",
    "scene0316_00",
    "scene0521_00",
    "scene0553_00",
    "scene0616_00",
    "scene0653_00",
)


@dataclass(frozen=True)
class Variant:
    """One way to use a scene.

    Attributes:
        pick: the frames that take part, with their `split` set ("train" or "test").
        fitted: fitted to the training views; False: the field that the networks give directly.
        reported: measure → what the paper says, the mean over all of the suite's scenes; empty when it says nothing.
    """

    key: str
    title: str
    pick: Callable[[Capture], Capture]
    fitted: bool = True
    reported: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Suite:
    """A benchmark.

    Attributes:
        scenes: their names; empty: any.
        long_side: of the images in pixels; None: as the run's settings say.
        protocol: one sentence; `differs` says what is not as in the paper.
    """

    name: str
    title: str
    scenes: tuple[str, ...]
    variants: tuple[Variant, ...]
    protocol: str
    differs: str = ""
    long_side: int | None = None

    def find(self, root: Path, wanted: Sequence[str] | None = None) -> list[tuple[str, Path]]:
        """Name and folder of the scenes below `root` (or of `root` itself, when it is one), in the suite's order.

        Args:
            wanted: names; None: all that are there.

        Raises:
            InputError: nothing is there, or not what is `wanted`.
        """
        if not root.is_dir():
            raise InputError(f"{root} is not a folder; give the one that holds the scenes of {self.title}")
        below = sorted((path for path in root.iterdir() if path.is_dir()), key=lambda path: natural_key(path.name))
        # Folders of any name, with colour, depth and poses, may as well belong to several scenes.
        if is_scene(root) and not (detect_kind(root) == "rgbd" and any(map(is_scene, below))):
            found = {root.name: root}
        else:
            found = {path.name: path for path in below if is_scene(path)}
            if self.scenes:
                found = {name: found[name] for name in self.scenes if name in found}
        if wanted is not None:
            missing = [name for name in wanted if name not in found]
            if missing:
                raise InputError(f"{root} holds no scene {missing[0]!r}; there are {', '.join(found) or 'none'}")
            found = {name: found[name] for name in wanted}
        if not found:
            names = f" ({', '.join(self.scenes)})" if self.scenes else ""
            raise InputError(f"{root} holds no scene of {self.title}{names}; give the folder that has one subfolder a scene")
        return list(found.items())

    def variant(self, key: str) -> Variant:
        """A variant by its key.

        Raises:
            InputError: there is none.
        """
        for one in self.variants:
            if one.key == key:
                return one
        raise InputError(f"{self.name} has no variant {key!r}; known are {', '.join(one.key for one in self.variants)}")


def is_scene(path: Path) -> bool:
    """A folder that a posed capture's reader would take, or that has a file of one: a broken scene becomes a row, too."""
    return any(next(path.glob(mark), None) is not None for mark in SCENE_MARKS) or detect_kind(path) not in (None, "photos")


def split(capture: Capture, train: Sequence[int], test: Sequence[int]) -> Capture:
    """The capture's frames `train` and `test` (indices in its own order), marked so; all others are left out.

    Raises:
        InputError: a frame that does not exist, or one that is both.
    """
    count = len(capture.frames)
    outside = [index for index in (*train, *test) if not 0 <= index < count]
    if outside or set(train) & set(test):
        raise InputError(f"{capture.root} has {count} images, and the protocol needs number {max([*train, *test])}; check that it is whole")
    marks = {**dict.fromkeys(train, "train"), **dict.fromkeys(test, "test")}
    frames = tuple(replace(capture.frames[index], split=marks[index]) for index in sorted(marks))
    return replace(capture, frames=frames)


def every(step: int, first: int = 0) -> Callable[[Capture], Capture]:
    """Every `step`-th image by name is a test view, from the image `first` on."""

    def pick(capture: Capture) -> Capture:
        order = sorted(range(len(capture.frames)), key=lambda index: natural_key(capture.frames[index].name))
        test = order[first::step]
        return split(capture, [index for index in order if index not in set(test)], test)

    return pick


def own_split(capture: Capture) -> Capture:
    """Train and test as the capture's own files have them.

    Raises:
        InputError: they have no split.
    """
    if not any(frame.split == "test" for frame in capture.frames):
        raise InputError(f"{capture.root} brings no test split; it needs transforms_train.json and transforms_test.json")
    return capture


def dtu_views(train: Sequence[int]) -> Callable[[Capture], Capture]:
    """These of the 49 views train, the four test views test; images are in the order of their numbers."""
    return lambda capture: split(capture, train, DTU_TEST)


def scannet_split(capture: Capture) -> Capture:
    """The split of the room's own `train.txt` and `test.txt`, else every eighth image by name.

    They are published with an image's name a line. Images that neither names are excluded.

    Raises:
        InputError: a list names an image that is not there or has no pose, or one image is on both lists.
    """
    lists = [capture.root / name for name in SCANNET_LISTS]
    if not all(path.is_file() for path in lists):
        return every(8)(capture)
    # Images inside a .sens file have no file names, and are called as they would be exported.
    names = [frame.image.stem if frame.video_index is None else frame.name for frame in capture.frames]
    numbers = {name: index for index, name in enumerate(names)}
    return split(capture, *(_listed(path, numbers) for path in lists))


def _listed(path: Path, numbers: dict[str, int]) -> list[int]:
    """The numbers of the images that a list names; suffixes do not count, since smaller copies of the images are PNG."""
    names = [line.strip() for line in read_text(path).splitlines() if line.strip()]
    lost = [name for name in names if Path(name).stem not in numbers]
    if lost or not names:
        what = f"names {lost[0]}, which is not among the images with a pose" if lost else "names no image"
        raise InputError(f"{path} {what}; put it right, or take both lists away to hold out every eighth image")
    return [numbers[Path(name).stem] for name in names]


def own_or_eighth(capture: Capture) -> Capture:
    """The capture's own split when it has one, else every eighth image by name."""
    return capture if any(frame.split == "test" for frame in capture.frames) else every(8)(capture)


SUITES: dict[str, Suite] = {
    one.name: one
    for one in (
        Suite(
            name="nerf-synthetic",
            title="NeRF-synthetic",
            scenes=("chair", "drums", "ficus", "hotdog", "lego", "materials", "mic", "ship"),
            variants=(
                Variant("direct", "direct inference", own_split, fitted=False, reported={"psnr": 25.47}),
                Variant("fitted", "fitted", own_split),
            ),
            protocol="training images and test images as the files say, composited on white, at 800×800",
            long_side=800,
        ),
        Suite(
            name="dtu",
            title="DTU",
            scenes=(),
            variants=(
                Variant("3-direct", "3 views, direct inference", dtu_views(DTU_TRAIN[:3]), fitted=False, reported={"psnr": 26.19}),
                Variant("3-fitted", "3 views, fitted", dtu_views(DTU_TRAIN[:3])),
                Variant("16-fitted", "16 views, fitted", dtu_views(DTU_TRAIN), reported={"psnr": 31.79}),
            ),
            protocol=f"training views {', '.join(map(str, DTU_TRAIN))}, the first three alone for direct inference;"
            f" test views {', '.join(map(str, DTU_TEST))}",
            differs="whole images are scored (of scans that bring masks, what these leave), the paper's are cut to the object's depth mask;"
            " one field of three views serves all test views,"
            " where the paper takes the three nearest for each",
            long_side=640,
        ),
        Suite(
            name="scannet",
            title="ScanNet, the scenes of NerfingMVS",
            scenes=SCANNET_SCENES,
            variants=(
                Variant("direct", "direct inference", scannet_split, fitted=False, reported={"psnr": 22.99}),
                Variant("fitted", "fitted", scannet_split),
            ),
            protocol="the eight scenes as NerfingMVS cuts them, held out what a scene's test.txt names, else every eighth image,"
            " at 640 pixels",
            differs="a folder with more images than the published part of a scene is used whole; a sensor's depth is used where a scene"
            " brings it (--set fit.depth_from=off --set network.depth_from=off leaves it out), the paper's method sees images alone",
            long_side=640,
        ),
        Suite(
            name="llff",
            title="LLFF",
            scenes=("fern", "flower", "fortress", "horns", "leaves", "orchids", "room", "trex"),
            variants=(Variant("fitted", "fitted", every(8)),),
            protocol="every eighth image by name is held out, the first one included, at 1008 pixels",
            differs="a COLMAP model beside the images goes before poses_bounds.npy, and its lens is taken out of them before scoring",
            long_side=1008,
        ),
        Suite(
            name="posed",
            title="Posed captures",
            scenes=(),
            variants=(Variant("direct", "direct inference", own_or_eighth, fitted=False), Variant("fitted", "fitted", own_or_eighth)),
            protocol="the capture's own split, else every eighth image by name is held out",
        ),
    )
}


def suite_of(name: str) -> Suite:
    """A suite by name.

    Raises:
        InputError: there is none.
    """
    if name not in SUITES:
        raise InputError(f"there is no benchmark {name!r}; known are {', '.join(SUITES)}")
    return SUITES[name]
