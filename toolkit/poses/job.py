"""What the parent gives the pose-finding child, and where both keep files. No pycolmap here."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from fieldfuse.camera import Intrinsics
from fieldfuse.capture.images import turns_by_exif
from fieldfuse.capture.select import SELECTED
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.config import PosesSettings
from fieldfuse.files import fingerprint, read_json, write_json

MAX_EXHAUSTIVE = 40  # photos; beyond it pairs are chosen
SIFT, XFEAT = "sift", "xfeat"  # features that images are matched by
TOLERANCE = 4.0  # pixels, COLMAP's own
MAX_ASKED_AGAIN = 120  # photos; up to it those that find no place so are matched with all others
STRICT = "incremental"  # the attempt by COLMAP's own rules
IN_PARTS = "in parts"  # the same for parts of very many images, which are then put together
PART = 500  # images of such a part
GONE_ON = "incremental, gone on with small angles"  # the attempt that adds to the strict one's model what that had no place for
GONE_FAR = "incremental, gone on with tiny angles"  # the same from there, where cameras turn before a wall and hardly move
LOOSE = "incremental, small angles"  # from scratch, by looser rules
GLOBAL = "global"  # the last attempt, which takes what no other can begin with
WHOLE, FEWEST_FEATURES = 3, 1024  # times the features of an image that all views of an instant have together, and of one at least
VERSION = 5  # of what is found and how; a change discards what earlier versions left in out/sparse
REPEATABLE = 300  # images up to which poses repeat: one thread maps (docs/measured/performance.md)


# Of a frame what the child needs, and what is named only where it is so: what was found before there was such a thing stays good.
NEEDED, SELDOM = ("name", "image", "mask", "video_index", "focal_prior", "as_stored", "mask_excludes"), ("as_stored", "mask_excludes")


def _plain(frame: Frame) -> dict[str, Any]:
    values = {name: getattr(frame, name) for name in NEEDED if name not in SELDOM or getattr(frame, name)}
    plain = {name: str(value) if isinstance(value, Path) else value for name, value in values.items()}
    if frame.instant is None or frame.intrinsics is None or frame.source_from_view is None:
        return plain
    rig = {"instant": frame.instant, "intrinsics": frame.intrinsics.to_dict(), "source_from_view": frame.source_from_view.tolist()}
    return {**plain, **rig}


def _frame(data: dict[str, Any]) -> Frame:
    made: dict[str, Any] = {**data, **{name: Path(data[name]) for name in ("image", "mask") if data[name]}}
    if "instant" in data:
        made |= {"intrinsics": Intrinsics.from_dict(data["intrinsics"]), "source_from_view": np.array(data["source_from_view"])}
    return Frame(**made)


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
    address: str | None = None  # of a Ray cluster whose nodes find features and match, too
    feature_bytes: int = 0  # memory that finding the features of one image takes

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

    @cached_property
    def rigged(self) -> bool:
        """Whether some images are views of one instant (`Frame.instant`): these get one place, and their intrinsics are exact."""
        return any(image.instant is not None for image in self.images)

    @cached_property
    def instants(self) -> list[list[int]]:
        """Indices of the images, those of one instant together, in order."""
        groups: dict[str, list[int]] = {}
        for index, image in enumerate(self.images):
            groups.setdefault(f"image {index}" if image.instant is None else f"instant {image.instant}", []).append(index)
        return list(groups.values())

    @cached_property
    def view_cameras(self) -> dict[int, int]:
        """The ids in the database of the cameras of all images that are views of an instant, by their index: one for each view of a rig,
        whose sensors they are. Instants that were cut in the same way have the same ones."""
        first: dict[tuple[Any, ...], int] = {}
        out = dict[int, int]()
        for views in self.instants:
            frames = [self.images[index] for index in views]
            if frames[0].instant is not None:
                shape = tuple((frame.intrinsics, np.asarray(frame.source_from_view).tobytes()) for frame in frames)
                number = first.setdefault(shape, 1 + sum(len(other) for other in first))
                out |= {index: number + place for place, index in enumerate(views)}
        return out

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
        values = {entry.name: getattr(self, entry.name) for entry in fields(self)}
        write_json(path, {**values, "images": [_plain(image) for image in self.images]})

    @classmethod
    def load(cls, path: Path) -> Job:
        data: dict[str, Any] = read_json(path)
        return cls(**{**data, "images": tuple(map(_frame, data["images"]))})


def plan(
    capture: Capture, folder: Path, settings: PosesSettings, seed: int, threads: int, features: str = SIFT, second: str | None = None
) -> Job:
    """The job for `capture`. Intrinsics and poses that the capture brings are not used, but for those of views (`Frame.instant`); focal
    lengths from EXIF are."""
    priors = {None if frame.focal_prior is None else round(frame.focal_prior, 1) for frame in capture.frames}
    cut = max(Counter(frame.instant for frame in capture.frames if frame.instant is not None).values(), default=0)
    return Job(
        folder=str(folder),
        images=capture.frames,
        sequential=capture.ordered if settings.matching == "auto" else settings.matching == "sequential",
        one_camera=capture.kind == "video" or SELECTED in capture.extra or len(priors) == 1,
        exif=turns_by_exif(capture),
        image_size=settings.image_size,
        max_features=settings.max_features if not cut else max(FEWEST_FEATURES, settings.max_features * WHOLE // cut),
        seed=seed,
        threads=threads,
        features=features,
        second=second,
    )
