"""What the parent tells the pose-finding child, and where both keep files. No pycolmap here."""

from __future__ import annotations

from dataclasses import asdict, dataclass
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
REPEATABLE = 300  # pictures up to which poses repeat: one thread maps (docs/measured/performance.md)


@dataclass(frozen=True)
class Picture:
    """One picture that the child reads."""

    name: str
    image: str
    mask: str | None = None
    video_index: int | None = None
    focal_prior: float | None = None
    as_stored: bool = False
    mask_excludes: bool = False

    def frame(self) -> Frame:
        """As the capture's readers want it."""
        return Frame(
            name=self.name,
            image=Path(self.image),
            mask=None if self.mask is None else Path(self.mask),
            video_index=self.video_index,
            focal_prior=self.focal_prior,
            as_stored=self.as_stored,
            mask_excludes=self.mask_excludes,
        )

    def key(self) -> dict[str, Any]:
        """Of what is seen in it."""
        # Named only where it is so: what was found for other pictures before there was such a thing stays good.
        return {name: value for name, value in asdict(self).items() if name not in ("as_stored", "mask_excludes") or value}


@dataclass(frozen=True)
class Job:
    """Everything that decides the child's result."""

    folder: str  # out/sparse
    pictures: tuple[Picture, ...]
    sequential: bool
    one_camera: bool  # all pictures come from one camera at one zoom when their sizes agree
    exif: bool  # pictures are turned upright by their EXIF orientation
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
        """Facts of each picture, gathered while its features are extracted."""
        return Path(self.folder) / "pictures.json"

    @property
    def key_file(self) -> Path:
        return Path(self.folder) / "inputs.json"

    @property
    def result(self) -> Path:
        return Path(self.folder) / "result.json"

    @property
    def repeating(self) -> int:
        """Threads for what would not repeat with several: COLMAP's mapping. Only many pictures take all the same."""
        return 1 if len(self.pictures) <= REPEATABLE else self.threads

    def key(self) -> str:
        """Of what features and matches depend on: not on threads, not on what the mapper is told."""
        pictures = [[picture.key(), Path(picture.image)] for picture in self.pictures]
        flat = [part for pair in pictures for part in pair] + [Path(picture.mask) for picture in self.pictures if picture.mask]
        how = [self.sequential, self.one_camera, self.exif, self.image_size, self.max_features, self.seed, self.features]
        return fingerprint(VERSION, *how, *flat)

    def save(self, path: Path) -> None:
        write_json(path, asdict(self))

    @classmethod
    def load(cls, path: Path) -> Job:
        data: dict[str, Any] = read_json(path)
        return cls(**{**data, "pictures": tuple(Picture(**picture) for picture in data["pictures"])})


def plan(
    capture: Capture, folder: Path, settings: PosesSettings, seed: int, threads: int, features: str = SIFT, second: str | None = None
) -> Job:
    """The job for `capture`. Intrinsics and poses that the capture brings are not used; focal lengths from EXIF are."""
    pictures = tuple(
        Picture(
            name=frame.name,
            image=str(frame.image),
            mask=None if frame.mask is None else str(frame.mask),
            video_index=frame.video_index,
            focal_prior=frame.focal_prior,
            as_stored=frame.as_stored,
            mask_excludes=frame.mask_excludes,
        )
        for frame in capture.frames
    )
    priors = {None if picture.focal_prior is None else round(picture.focal_prior, 1) for picture in pictures}
    sequential = capture.ordered if settings.matching == "auto" else settings.matching == "sequential"
    return Job(
        folder=str(folder),
        pictures=pictures,
        sequential=sequential,
        one_camera=capture.kind == "video" or SELECTED in capture.extra or len(priors) == 1,
        exif=turns_by_exif(capture),
        image_size=settings.image_size,
        max_features=settings.max_features,
        seed=seed,
        threads=threads,
        features=features,
        second=second,
    )
