"""What the parent gives the pose-finding child, and where both keep files. No pycolmap here."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fieldfuse.capture.images import turns_by_exif
from fieldfuse.capture.select import SELECTED
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.config import PosesSettings
from fieldfuse.files import fingerprint, read_json, write_json

MAX_EXHAUSTIVE = 40  # photos; beyond it pairs are chosen
SIFT, XFEAT = "sift", "xfeat"  # features that images are matched by
TOLERANCE = 4.0  # pixels, COLMAP's own
MAX_ASKED_AGAIN = 120  # photos; up to it those that find no place so are matched with all others
GONE_ON = "incremental, gone on with small angles"  # the attempt that adds to the strict one's model what that had no place for
GONE_FAR = "incremental, gone on with tiny angles"  # the same from there, where cameras turn before a wall and hardly move
LOOSE = "incremental, small angles"  # from scratch, by looser rules
GLOBAL = "global"  # the last attempt, which takes what no other can begin with
VERSION = 5  # of what is found and how; a change discards what earlier versions left in out/sparse
REPEATABLE = 300  # images up to which poses repeat: one thread maps (docs/measured/performance.md)


# Of a frame what the child needs, and what is named only where it is so: what was found before there was such a thing stays good.
NEEDED, SELDOM = ("name", "image", "mask", "video_index", "focal_prior", "as_stored", "mask_excludes"), ("as_stored", "mask_excludes")


def _plain(frame: Frame) -> dict[str, Any]:
    values = {name: getattr(frame, name) for name in NEEDED if name not in SELDOM or getattr(frame, name)}
    return {name: str(value) if isinstance(value, Path) else value for name, value in values.items()}


@dataclass(frozen=True)
class Job:
    """Everything that decides the child's result."""

    folder: str  # out/sparse
    images: tuple[Frame, ...]
    sequential: bool
    one_camera: bool  # all images come from one camera at one zoom when their sizes agree
    exif: bool  # images are turned upright by their EXIF orientation
    image_size: int
    max_features: int
    seed: int
    threads: int
    features: str = SIFT
    tolerance: float = TOLERANCE  # pixels that a match may be off its epipolar line, and a point off where it is seen
    second: str | None = None  # features that are tried where the first place too few

    @property
    def database(self) -> Path:
        return Path(self.folder) / "database.db"

    @property
    def log(self) -> Path:
        return Path(self.folder) / "log.txt"

    @property
    def records(self) -> Path:
        """Facts of each image, gathered while its features are extracted."""
        return Path(self.folder) / "pictures.json"

    @property
    def key_file(self) -> Path:
        return Path(self.folder) / "inputs.json"

    @property
    def result(self) -> Path:
        return Path(self.folder) / "result.json"

    @property
    def repeating(self) -> int:
        """Threads for what would not repeat with several: COLMAP's mapping. Only many images take all the same."""
        return 1 if len(self.images) <= REPEATABLE else self.threads

    def key(self) -> str:
        """Of what features and matches depend on: not on threads, nor on how it is mapped."""
        flat = [part for image in self.images for part in (_plain(image), image.image)]
        masks = [image.mask for image in self.images if image.mask]
        how = [self.sequential, self.one_camera, self.exif, self.image_size, self.max_features, self.seed, self.features]
        return fingerprint(VERSION, *how, *flat, *masks)

    def save(self, path: Path) -> None:
        write_json(path, {**vars(self), "images": [_plain(image) for image in self.images]})

    @classmethod
    def load(cls, path: Path) -> Job:
        data: dict[str, Any] = read_json(path)
        paths = [{name: Path(image[name]) for name in ("image", "mask") if image[name]} for image in data["images"]]
        return cls(**{**data, "images": tuple(Frame(**{**image, **own}) for image, own in zip(data["images"], paths, strict=True))})


def plan(
    capture: Capture, folder: Path, settings: PosesSettings, seed: int, threads: int, features: str = SIFT, second: str | None = None
) -> Job:
    """The job for `capture`. Intrinsics and poses that the capture brings are not used; focal lengths from EXIF are."""
    priors = {None if frame.focal_prior is None else round(frame.focal_prior, 1) for frame in capture.frames}
    return Job(
        folder=str(folder),
        images=capture.frames,
        sequential=capture.ordered if settings.matching == "auto" else settings.matching == "sequential",
        one_camera=capture.kind == "video" or SELECTED in capture.extra or len(priors) == 1,
        exif=turns_by_exif(capture),
        image_size=settings.image_size,
        max_features=settings.max_features,
        seed=seed,
        threads=threads,
        features=features,
        second=second,
    )
