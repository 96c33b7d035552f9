"""What frames are chosen from: a video, a `.sens` file, or a recording of images (`Capture.film`), which may be one zip file."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from fieldfuse.camera import Array
from fieldfuse.capture.archive import archive_of, read_bytes
from fieldfuse.capture.headers import read_header
from fieldfuse.capture.images import load_depth, load_image
from fieldfuse.capture.sens import JPEG, is_sens, scan, sens_bytes, sens_depth
from fieldfuse.capture.types import Capture, Frame
from fieldfuse.capture.video import iterate_video
from fieldfuse.errors import InputError, OutputError
from fieldfuse.files import atomic_path, fingerprint

QUALITY = 97  # of the JPEG files that a video's frames become
DEPTH = "depth"  # folder beside the images that are written


@dataclass(frozen=True)
class Film:
    """Frames in time order, by their number: in the video or `.sens` file, of a recording by their place."""

    path: Path  # the video, or the recording's file or folder
    capture: Capture

    @classmethod
    def of(cls, capture: Capture) -> Film:
        first = capture.frames[0].image
        return cls((archive_of(first) or capture.root) if capture.film else first, capture)

    @property
    def as_stored(self) -> bool:
        return self.capture.frames[0].as_stored

    @property
    def packed(self) -> bool:
        """Whether it is a `.sens` file, whose depth is in it, too."""
        return not self.capture.film and is_sens(self.path)

    @cached_property
    def numbers(self) -> list[int]:
        """Of the capture's frames, ascending. A `.sens` file's have gaps where a frame has no pose or no image."""
        return [order if frame.video_index is None else frame.video_index for order, frame in enumerate(self.capture.frames)]

    @cached_property
    def known(self) -> dict[int, Frame]:
        return dict(zip(self.numbers, self.capture.frames, strict=True))

    def state(self) -> list[Any]:
        """What distinguishes these frames from others; it changes with the files."""
        if not self.capture.film:
            return [self.path, *(["as stored"] if self.as_stored else [])]
        if self.path.is_file():
            return [self.path]
        return [fingerprint(*(path for frame in self.capture.frames for path in (frame.image, frame.depth) if path is not None))]

    def images(self, numbers: Collection[int] | None = None) -> Iterator[tuple[int, Array | None]]:
        """The frames (all, or `numbers`) as (H, W, 3) uint8 RGB, one at a time; None for a recording's image that is damaged."""
        if not self.capture.film:
            yield from iterate_video(self.path, numbers, as_stored=self.as_stored)
            return
        for number in self.numbers if numbers is None else sorted(numbers):
            try:
                image = load_image(self.known[number])[:, :, :3]
            except InputError:  # one among thousands; where all are, that is reported when they are measured
                image = None
            yield number, image

    def jpegs(self, numbers: Collection[int]) -> Iterator[tuple[int, bytes]]:
        """Frames `numbers` as JPEG files: what is JPEG already stays so, and a video's are made."""
        if self.capture.film:
            for number in sorted(numbers):
                image = self.known[number].image
                data = read_bytes(image)
                if read_header(data, image).format not in ("JPEG", "MPO"):
                    rgb = load_image(self.known[number])[:, :, :3]
                    data = _encoded(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), str(image), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
                yield number, data
        elif self.packed and scan(self.path).codings[0] == JPEG:
            for number in sorted(numbers):
                yield number, sens_bytes(scan(self.path), number)
        else:
            for number, rgb in iterate_video(self.path, numbers, as_stored=self.as_stored):
                bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
                yield number, _encoded(".jpg", bgr, f"frame {number} of {self.path}", [cv2.IMWRITE_JPEG_QUALITY, QUALITY])

    def depth_at(self, number: int, image: Path) -> Path | None:
        """Where the depth of frame `number` is written when its image is at `image`; None: it has none, or that is a file already.

        A `.sens` file's stays as it is stored; of a recording it is float32, 0 = missing, without what the sensor did not trust.
        """
        if number not in self.known or self.known[number].depth is None or not (self.packed or self.capture.film):
            return None
        return image.parent / DEPTH / f"{image.stem}.{'png' if self.packed else 'npy'}"

    def write_depth(self, number: int, target: Path) -> None:
        """Frame `number`'s depth at `target`; nothing where a recording's is damaged."""
        if self.packed:
            data = _encoded(".png", sens_depth(self.path, number), f"the depth of frame {number} of {self.path}", [])
            with atomic_path(target) as temporary:
                temporary.write_bytes(data)
            return
        try:
            depth = load_depth(self.known[number], self.capture)
        except InputError:
            return
        with atomic_path(target) as temporary:
            np.save(temporary, depth * np.float32(self.capture.depth_scale))  # in the capture's own unit, as it is read

    def written(self, number: int, image: Path) -> Frame:
        """Frame `number` as it is now that its image is at `image`, and its depth where `depth_at` says."""
        known = self.known.get(number, Frame("", self.path))
        frame = replace(known, name=image.stem, image=image.resolve(), video_index=None, as_stored=False)
        depth = self.depth_at(number, image)
        if depth is None:
            return frame
        there = depth.is_file()
        return replace(
            frame, depth=depth.resolve() if there else None, depth_intrinsics=frame.depth_intrinsics if there else None, confidence=None
        )


def _encoded(suffix: str, image: Array, what: str, settings: list[int]) -> bytes:
    coded, data = cv2.imencode(suffix, image, settings)
    if not coded:
        raise OutputError(f"{what} cannot be encoded as {'JPEG' if suffix == '.jpg' else 'PNG'}")
    return data.tobytes()
