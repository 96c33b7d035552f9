"""A small model of time: what each stage of a run takes on this machine, and which settings fit into a given number of seconds.

Seconds of a stage = amount of work (pixels, frames, views) × what a unit takes here (a quick self-test) × a factor learnt from runs.
The fit takes what is left. What was learnt is kept in the user's cache folder under the machine's signature.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from fieldfuse.config import PosesSettings
from fieldfuse.errors import FieldfuseError
from fieldfuse.files import fingerprint, read_json, write_json
from fieldfuse.poses.job import MAX_EXHAUSTIVE

SIZES = (160, 240, 320, 400, 480, 640, 800, 960)  # long sides that images are brought to
RAYS_A_PIXEL = 0.6  # rays that a fit should have for each training pixel: with fewer, smaller images end better in the same time
VOXELS_A_RAY = 2.0  # as the schedule: a finer level is worth its voxels only when so few rays are left for each
SURFACE = 3.0  # occupied voxels of a lattice of n a side, in n²
FIT_SHARE = 0.35  # of the seconds, at least, that the fit should have when images are chosen …
FRAMES_SHARE = 0.25  # … and when a video's frames are: more of them are worth more than larger ones, or than more seconds of fitting
ENOUGH = 30.0  # seconds of fitting that textures and a page need not give way to, whatever share they are
NEARLY = 0.8  # of the seconds that the smallest images would leave, where they do not leave that share
LEAST_FIT = 2.0  # seconds
STEADY = 5.0  # seconds of stages that count as predicted well when the machine's load is judged: first imports are no sign of it
EXPORT_SHARE = 0.25  # of the seconds, at most, that are planned for exports
# Images' worth of features that a mesh takes: whatever it is of; of a megapixel of one view, for its triangles, and of all views, to make
# their depth agree, to polish, fuse and carve; each by the pixels that are rendered, and by those of the depth that is made of them.
MESH_FIXED, MESH_TRIANGLES, MESH_DEPTH = 2.3, (145.0, 48.0), (23.0, 6.0)
# For a texture besides: a coarser mesh, and of each training image what it sees and its texels; for a page: what training rays see.
TEXTURE_FIXED, TEXTURE_PICTURE, PAGE = 18.0, 0.2, 14.0
OBJECT = 0.5  # of that where images have alpha: the object fills a part of them
MESH_SIDE, VIDEO_SIDE = 400, 640  # long sides that are rendered at most
EXPORT_RAY = 1.2  # of the time of a test view's ray: writing video frames comes on top
MESH_SHARE = 0.6  # of the exports' seconds, the rest is the video's
FRAME_COUNTS = (100, 75, 50, 36, 24)  # of a video
MESH_VIEWS, VIDEO_FRAMES = (12, 60), (24, 90)  # fewest and most
SIFT_FRAMES = 100
# Images' worth of features that poses take: an image, a megapixel of one and of each pair that is matched, and for each other
# image that is adjusted with it. Of two videos with 24 to 100 frames (0.3 and 0.9 megapixels) the seconds are right within 60%.
SFM_PICTURE, SFM_FEATURES, SFM_PAIR, SFM_MAPPING = 0.5, 1.6, 0.7, 0.018
HEIF = 4.0  # times as long as choosing a frame of a video takes: decoding an image and writing it as JPEG, two threads
NEIGHBOURS, ALIKE = 5, 12  # pairs for each frame of a video; for each of more photos than are matched with all others
EFFECTS_LOOKED_AT = 40  # training images at most that are looked at for effects; all, when one is corrected image by image …
CORRECTED = 0.4  # … which this share of captures needs
EFFECTS_SHARE = 0.5  # of the seconds, at most, that looking for effects may take
AGREES = 0.15  # relative error of a prediction that is still good
LEARNING = 0.7  # of what a run shows about a factor, the part that is believed
FACTOR_RANGE = (0.05, 20.0)

# Stage → (kind of the self-test's unit, how many of them a unit of this stage's work takes). Measured once; factors learn the rest.
COST = {
    "capture": ("decode", 3.0),
    "frames": ("decode", 2.0),
    "poses": ("features", 1.0),
    "effects": ("features", 0.9),
    "scene": ("features", 0.6),
    "views": ("decode", 11.0),
    "tsdf": ("decode", 80.0),
    "tsdf_texture": ("features", 1.0),
    "beside": ("features", 4.5),  # what a fit takes beside its own seconds: reading, the timeline, writing
    "render": ("ray", 1.2),
    "export": ("ray", 1.5),
    "evaluate": ("score", 1.0),
    "report": ("decode", 75.0),
}
KINDS = ("decode", "features", "ray", "fit", "score")
COUNTED = 4  # raised when a stage's work is counted in another way: what was learnt before is of no use then


@dataclass(frozen=True)
class Work:
    """How much work a capture is.

    Attributes:
        frames, width, height: images that are used, and their size as they lie on disk. total: of a video's frames, else `frames`.
    """

    frames: int
    width: int
    height: int
    test: int
    posed: bool
    depth: bool
    outlined: bool  # depth, alpha or points show where the scene is; nothing has to be triangulated
    video: bool = False
    total: int = 0
    effects: bool = False  # they are looked for
    alpha: bool = False  # images of an object alone
    texture: bool = False  # meshes are to have one
    page: bool = False  # the field is to be walked through in a browser
    converted: int = 0  # images that are HEIF, and are written as JPEG first

    @property
    def megapixels(self) -> float:
        return self.width * self.height / 1e6

    def pixels(self, long_side: int) -> float:
        """Of one image brought to `long_side`."""
        factor = min(1.0, long_side / max(self.width, self.height))
        return self.width * self.height * factor * factor


MOST = 1e9  # of any number that is chosen


@dataclass
class Choice:
    """Settings that fit into the seconds; None: not decided yet."""

    image_size: int
    max_frames: int | None = None  # of a video
    fit_seconds: float | None = None
    resolution: int | None = None
    mesh_views: int | None = None
    mesh_size: int | None = None  # of a mesh's depth; None: as large as it is rendered
    video_frames: int | None = None  # 0: no video
    effects: bool | None = None  # whether they are looked for
    texture: bool | None = None  # whether meshes get one
    page: bool | None = None  # whether the field can be walked through in a browser

    def to_dict(self) -> dict[str, Any]:
        return dict(vars(self))

    @classmethod
    def of(cls, data: dict[str, Any]) -> Choice:
        """What `to_dict` gave when everything was decided.

        Raises:
            TypeError, ValueError: it is something else.
        """
        choice = cls(**data)
        for name, value in vars(choice).items():
            kinds: Any = {"fit_seconds": (int, float), "effects": bool, "texture": bool, "page": bool}.get(name, int)
            if value is None and name in ("max_frames", "mesh_size", "effects", "texture", "page"):
                continue
            if not isinstance(value, kinds) or (kinds is not bool and (isinstance(value, bool) or not 0 <= value < MOST)):
                raise ValueError(f"{name} is {value!r}")
        return choice


@dataclass
class Speed:
    """What a unit of each kind takes on this machine, and the factors that runs taught."""

    units: dict[str, float]  # kind → seconds
    factors: dict[str, float] = field(default_factory=dict)  # stage → factor

    def seconds(self, stage: str, amount: float) -> float:
        kind, share = COST[stage]
        return amount * share * self.units[kind] * self.factors.get(stage, 1.0)

    def learn(self, stage: str, predicted: float, real: float) -> None:
        """Move a stage's factor towards what a run showed."""
        if predicted > 0 and real > 0:
            factor = self.factors.get(stage, 1.0) * (real / predicted) ** LEARNING
            self.factors[stage] = min(max(factor, FACTOR_RANGE[0]), FACTOR_RANGE[1])


def amounts(work: Work, choice: Choice) -> dict[str, float]:
    """Stage → amount of work: megapixels decoded, images looked at for features, rays, megapixels scored."""
    frames = min(work.frames, choice.max_frames or work.frames)
    test = work.test * frames / max(work.frames, 1)
    pixels = work.pixels(choice.image_size)
    methods = 2 if work.depth else 1
    return {
        "capture": (0.0 if work.video else frames * work.megapixels),
        "frames": (work.total if work.video else HEIF * work.converted) * work.megapixels,
        "poses": 0.0 if work.posed else sfm_work(work, frames),
        "effects": effects_work(work, choice, CORRECTED) if work.effects else 0.0,
        "scene": 0.05 * frames * work.megapixels if work.outlined else float(min(frames, SIFT_FRAMES)),
        "views": frames * work.megapixels,
        "tsdf": (frames - test) * work.megapixels if work.depth else 0.0,
        "tsdf_texture": texture_work(frames - test) if work.depth and work.texture else 0.0,
        "render": test * pixels,
        "evaluate": test * pixels / 1e6 * methods,
        "report": 1 + 0.2 * min(test, 12) * methods,
        "export": video_rays(work, choice),
    }


def effects_work(work: Work, choice: Choice | None = None, every: float = 1.0) -> float:
    """Images whose features are found and matched; `every`: how likely all of them are looked at once more, since one is corrected. Half
    where structure from motion leaves points."""
    frames = min(work.frames, (choice.max_frames if choice is not None else None) or work.frames)
    test = work.test * frames / max(work.frames, 1)
    return (min(frames - test, EFFECTS_LOOKED_AT) + every * frames) * (1.0 if work.posed else 0.5)


def sfm_work(work: Work, frames: int) -> float:
    """Images' worth of features that structure from motion takes. It matches neighbours of a video and all pairs of few photos; adjusting
    a model takes the longer the more images it has."""
    pairs = NEIGHBOURS if work.video else frames / 2 if frames <= MAX_EXHAUSTIVE else ALIKE
    each = (SFM_FEATURES + SFM_PAIR * pairs) * work.pixels(PosesSettings.image_size) / 1e6
    return frames * (SFM_PICTURE + each + SFM_MAPPING * frames)


def video_rays(work: Work, choice: Choice) -> float:
    """Rays of the video's frames."""
    return (choice.video_frames or 0) * work.pixels(min(VIDEO_SIDE, choice.image_size))


def texture_work(images: float) -> float:
    """Images' worth of features that a texture of so many training images takes."""
    return TEXTURE_FIXED + TEXTURE_PICTURE * images


def mesh_work(work: Work, choice: Choice) -> tuple[float, float]:
    """Images' worth of features that a mesh takes beside its views, its texture and the page among them, and for each view."""
    rendered = min(MESH_SIDE, choice.image_size)
    sizes = [work.pixels(side) / 1e6 * (OBJECT if work.alpha else 1.0) for side in (rendered, choice.mesh_size or rendered)]
    frames = min(work.frames, choice.max_frames or work.frames)
    extra = (texture_work(frames * (1 - work.test / max(work.frames, 1))) if work.texture else 0.0) + (PAGE if work.page else 0.0)
    triangles, depth = (sum(each * size for each, size in zip(of, sizes, strict=True)) for of in (MESH_TRIANGLES, MESH_DEPTH))
    return MESH_FIXED + triangles + extra * (OBJECT if work.alpha else 1.0), depth


def most_export_seconds(speed: Speed, work: Work, choice: Choice, mesh_views: int, video_frames: int) -> float:
    """What exports take when all of them are made: more than that they cannot use."""
    once, each = mesh_work(work, choice)
    video = video_rays(work, replace(choice, video_frames=video_frames)) * EXPORT_RAY * speed.seconds("render", 1.0)
    return speed.factors.get("export", 1.0) * ((once + mesh_views * each) * speed.units["features"] + video)


def least_export_seconds(speed: Speed, work: Work, choice: Choice) -> float:
    """What exports take at least: a mesh of the fewest views, and no video."""
    return most_export_seconds(speed, work, choice, MESH_VIEWS[0], 0)


def predict(speed: Speed, work: Work, choice: Choice) -> dict[str, float]:
    """Stage → seconds, without the fit."""
    return {stage: speed.seconds(stage, amount) for stage, amount in amounts(work, choice).items() if amount > 0}


def choose(speed: Speed, work: Work, total: float, most_frames: int = 150) -> Choice:
    """Image size and, for a video, how many frames, for a run of `total` seconds.

    The largest images whose fit still gets `FIT_SHARE` of the seconds and enough rays for its training pixels; of a video the most
    frames that leave it `FRAMES_SHARE`. Where other things take so much that no size leaves that share, size has little to do with it:
    then the largest that leaves nearly as much as any. The smallest of everything when there are never rays enough.
    """
    counts: list[int | None] = [None]
    if work.video:
        counts = [most_frames, *(count for count in FRAME_COUNTS if count < most_frames)]
    sizes = [size for size in SIZES if size == SIZES[0] or size <= 1.2 * max(work.width, work.height)]
    for count in counts:
        taken = {size: sum(predict(speed, work, Choice(size, count)).values()) for size in sizes}
        if (total - min(taken.values())) * (1 - EXPORT_SHARE) < FRAMES_SHARE * total and count != counts[-1]:
            continue
        left = {size: total * (1 - EXPORT_SHARE) - taken[size] for size in sizes}
        most = max(left.values())
        least = min(FIT_SHARE * total, NEARLY * most)
        training = (1 - work.test / max(work.frames, 1)) * min(work.frames, count or work.frames)
        rays = {size: RAYS_A_PIXEL * training * work.pixels(size) for size in sizes}
        fitting = [size for size in sizes if left[size] >= least and left[size] / speed.units["fit"] >= rays[size]]
        if fitting:
            return Choice(max(fitting), count)
    return Choice(SIZES[0], counts[-1])


def left_for_fit(speed: Speed, work: Work, seconds: float) -> float:
    """What images as `choose` takes them and the least that is exported leave of `seconds`."""
    choice = choose(speed, work, seconds)
    return seconds - sum(predict(speed, work, choice).values()) - least_export_seconds(speed, work, choice)


def fit_seconds(total: float, spent: float, rest: float) -> float:
    """What is left for the fit when `spent` seconds are gone and `rest` are needed after it."""
    return max(LEAST_FIT, total - spent - rest)


def resolution_for(seconds: float, unit: float, finest: int) -> int:
    """The finest lattice that a fit of so many seconds can fill, at `unit` seconds a ray; at most `finest`."""
    most = (seconds / unit * VOXELS_A_RAY / SURFACE) ** 0.5
    return max(64, min(finest, int(most // 32) * 32))


def exports_for(seconds: float, a_view: float, a_frame: float) -> tuple[int, int]:
    """Views of the mesh and frames of the video that `seconds` allow, at so many seconds a view and a frame; no video when it would be too
    short."""

    def count(share: float, each: float, most: int) -> int:
        return min(most, int(seconds * share / max(each, 1e-9)))

    video = count(1 - MESH_SHARE, a_frame, VIDEO_FRAMES[1])
    if video < VIDEO_FRAMES[0]:
        return max(MESH_VIEWS[0], count(1.0, a_view, MESH_VIEWS[1])), 0
    return max(MESH_VIEWS[0], count(MESH_SHARE, a_view, MESH_VIEWS[1])), video


# ------------------------------------------------------------------------------------------------- what is remembered


def cache_file() -> Path:
    """Where the user's cache folder keeps what was learnt."""
    root = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(root) / "fieldfuse" / "speed.json"


def signature(threads: int, device: str) -> str:
    """What times depend on: processor, cores, threads, libraries, and how work is counted."""
    from fieldfuse.evaluation.machine import machine

    about = machine(threads)
    return fingerprint([about[key] for key in ("machine", "system", "cores", "threads", "python", "versions")], device, COUNTED)


def remembered(name: str) -> Speed | None:
    """What is known of the machine `name`; None when nothing usable is."""
    try:
        entry = read_json(cache_file())[name]
        units = {kind: float(entry["units"][kind]) for kind in KINDS}
        factors = {str(stage): float(value) for stage, value in entry["factors"].items() if stage in COST}
    except (FieldfuseError, KeyError, TypeError, ValueError, AttributeError, OverflowError):
        return None
    good = all(0 < value < 1e4 for value in units.values()) and all(0 < value < 1e3 for value in factors.values())
    return Speed(units, factors) if good else None


def remember(name: str, speed: Speed | None) -> None:
    """Keep what is known of the machine `name`, or forget it (None); a cache that cannot be written is no error."""
    path = cache_file()
    try:
        known = read_json(path)
    except FieldfuseError:
        known = {}
    known = known if isinstance(known, dict) else {}
    known.pop(name, None)
    if speed is not None:
        known[name] = {"units": speed.units, "factors": speed.factors}
    try:
        write_json(path, known)
    except FieldfuseError:
        return
