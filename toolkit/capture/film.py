"""What frames are chosen from: a video, or a recording that holds each frame as a picture (`Capture.film`), maybe inside a zip file."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from toolkit.camera import Array
from toolkit.capture.archive import archive_of
from toolkit.capture.headers import read_bytes, read_header
from toolkit.capture.images import load_depth, load_image
from toolkit.capture.types import Capture, Frame
from toolkit.capture.video import iterate_video
from toolkit.errors import InputError, OutputError
from toolkit.files import atomic_path, fingerprint

QUALITY = 97  # of the JPEG files that a video's frames become


@dataclass(frozen=True)
class Film:
    """Frames in time order, told by their place."""

    path: Path  # the video, or the recording's file or folder
    capture: Capture

    @classmethod
    def of(cls, capture: Capture) -> Film:
        first = capture.frames[0].image
        return cls((archive_of(first) or capture.root) if capture.film else first, capture)

    @property
    def as_stored(self) -> bool:
        return self.capture.frames[0].as_stored

    def state(self) -> list[Any]:
        """What tells these frames from others; it changes with the files."""
        if not self.capture.film:
            return [self.path, *(["as stored"] if self.as_stored else [])]
        if self.path.is_file():
            return [self.path]
        return [fingerprint(*(path for frame in self.capture.frames for path in (frame.image, frame.depth) if path is not None))]

    def pictures(self, indices: Collection[int] | None = None) -> Iterator[tuple[int, Array | None]]:
        """The frames (all, or those of `indices`) as (H, W, 3) uint8 RGB, one at a time; None for a picture that is damaged.

        Raises:
            InputError: the video cannot be opened.
        """
        if not self.capture.film:
            yield from iterate_video(self.path, indices, as_stored=self.as_stored)
            return
        for index in range(len(self.capture.frames)) if indices is None else sorted(indices):
            yield index, self._picture(index)

    def _picture(self, index: int) -> Array | None:
        try:
            return load_image(self.capture.frames[index])[:, :, :3]
        except InputError:  # one among thousands; where all are, whoever measures them says so
            return None

    def write(self, index: int, picture: Array | None, target: Path) -> None:
        """Frame `index`, which is `picture`, as the JPEG file `target`: what is JPEG already stays so. Beside it what there is of depth.

        Raises:
            InputError: it is damaged.
            OutputError: it cannot be written.
        """
        if self.capture.film:
            frame = self.capture.frames[index]
            data = read_bytes(frame.image)
            read_header(data, frame.image)
            if frame.depth is not None and (depth := self._depth(frame)) is not None:
                with atomic_path(beside(target)) as temporary:
                    np.save(temporary, depth)
        else:
            assert picture is not None
            coded, made = cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
            if not coded:
                raise OutputError(f"frame {index} of {self.path} cannot be encoded as JPEG")
            data = made.tobytes()
        with atomic_path(target) as temporary:
            temporary.write_bytes(data)

    def _depth(self, frame: Frame) -> Array | None:
        try:
            return load_depth(frame, self.capture)
        except InputError:
            return None

    def written(self, index: int, name: str, target: Path) -> Frame:
        """Frame `index` as `write` has left it."""
        known = self.capture.frames[index] if index < len(self.capture.frames) else Frame("", self.path)
        frame = replace(known, name=name, image=target.resolve(), video_index=None, as_stored=False)
        if not self.capture.film or frame.depth is None:
            return frame
        depth = beside(target)
        here = depth.resolve() if depth.is_file() else None
        return replace(frame, depth=here, depth_intrinsics=frame.depth_intrinsics if here else None, confidence=None)


def beside(picture: Path) -> Path:
    """Where the depth of a picture that was written lies: float32, 0 = missing, what the sensor did not believe left out."""
    return picture.with_suffix(".npy")
