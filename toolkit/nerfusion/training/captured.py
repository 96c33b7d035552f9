"""Training scenes from posed captures on disk: frames are decoded when a sample asks for them, a few are kept."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch

from fieldfuse.camera import Intrinsics, Similarity
from fieldfuse.capture.prepare import WHITE, prepare_views
from fieldfuse.capture.types import Capture
from fieldfuse.config import CaptureSettings
from fieldfuse.errors import InputError
from fieldfuse.nerfusion.training.samples import Pictures
from fieldfuse.poses.overlap import guessed_depth

KEPT = 48  # decoded frames a scene


class CapturedScene:
    """A posed capture as a training scene.

    Args:
        capture: every frame with pose and intrinsics.
        kind: "object" or "room".
        long_side: pictures are brought to it, never enlarged.
        scale: one unit of the capture in the unit that samples shall have.
        depth_hint: typical depth in the sample's unit; None: from the depth pictures, or where the optical axes meet.
        background: colour where rays meet nothing, of pictures that show it without alpha; None: white where the capture has alpha, else
            every ray meets something.

    Raises:
        InputError: a frame without pose or intrinsics.
    """

    def __init__(
        self,
        capture: Capture,
        kind: str,
        long_side: int,
        scale: float = 1.0,
        depth_hint: float | None = None,
        background: tuple[float, float, float] | None = None,
    ) -> None:
        if not capture.posed:
            raise InputError(f"{capture.root}: not every frame has a pose and intrinsics; training needs both")
        self.capture, self.kind, self.ordered, self.name = capture, kind, capture.ordered, capture.root.name
        self._background = WHITE if background is None and capture.alpha else background
        self._scale = Similarity(scale, np.eye(3), np.zeros(3))
        self._settings = CaptureSettings(image_size=long_side, holdout=0)
        poses = np.array([frame.world_from_camera for frame in capture.frames], dtype=np.float64)
        self.world_from_camera = self._scale.poses(poses)
        self.depth_hint: float | None = depth_hint if depth_hint is not None else guessed_depth(self.world_from_camera)
        self._read = lru_cache(maxsize=KEPT)(self._read_one)

    def _read_one(self, index: int) -> tuple[torch.Tensor, Intrinsics, torch.Tensor | None]:
        views = prepare_views(self.capture.with_frames((self.capture.frames[index],)), self._scale, self._settings)
        image = torch.from_numpy(views.images[0]).permute(2, 0, 1).float() / 255
        depth = views.depths[0] if views.depths else None
        return (
            image.contiguous(),
            views.intrinsics[0],
            None if depth is None else torch.from_numpy(np.nan_to_num(depth, posinf=0, neginf=0)),
        )

    def pictures(self, indices: Sequence[int]) -> Pictures:
        """The frames at `indices`.

        Raises:
            InputError: a file cannot be read, or the pictures differ in size.
        """
        read = [self._read(int(index)) for index in indices]
        if len({image.shape for image, _, _ in read}) != 1:
            raise InputError(f"the pictures of {self.capture.root} differ in size; training needs one size a scene")
        blank = torch.zeros(read[0][0].shape[1:])
        return Pictures(
            images=torch.stack([image for image, _, _ in read]),
            intrinsics=torch.tensor([[c.fx, c.fy, c.cx, c.cy] for _, c, _ in read], dtype=torch.float32),
            world_from_camera=torch.from_numpy(self.world_from_camera[list(indices)].astype(np.float32)),
            depths=torch.stack([blank if depth is None else depth.float() for _, _, depth in read]),
            background=self._background,
        )
