"""What is taken out of a capture before anything is fitted to it, as plain data: colours, the lens, errors of poses, weights.

Gains have geometric mean 1 over the training pictures, the vignetting is 1 in the middle, refined poses are held to the given ones
(`refine.believed`): every freedom that pictures cannot tell is fixed. What would then be too bright for a picture is made room for
(`dimmed`). Where nothing is to be corrected, the very same objects come back.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from fieldfuse.camera import OPENCV, PINHOLE, Array, Intrinsics, distort
from fieldfuse.capture.types import Capture, Views
from fieldfuse.errors import InputError, first_line
from fieldfuse.tone import Gain, Tone, positive


@dataclass(frozen=True)
class Corrections:
    """By the frames' names, where each frame has its own."""

    gain: dict[str, Gain] = field(default_factory=dict)
    corner: float | None = None  # light left at half a diagonal
    dimmed: float = 1.0  # canonical light is divided by this besides, so that little of it is clipped
    lens: tuple[float, float] | None = None  # k1, k2 beyond the given lens
    poses: dict[str, Array] = field(default_factory=dict)  # (4, 4) world_from_camera
    weight: dict[str, float] = field(default_factory=dict)  # of frames that count for less in the fit: share of their pixels, 0 to 1
    depth: Array | None = None  # (4, 4) the picture's camera from the depth camera, where depth was not brought to the pictures
    by_depth: bool = False  # whether a sensor's depth took part in the poses

    @property
    def geometric(self) -> bool:
        return self.lens is not None or bool(self.poses)

    @property
    def coloured(self) -> bool:
        """Whether colours are corrected."""
        return self.corner is not None or bool(self.gain)

    def tone(self, name: str) -> Tone | None:
        """What is taken out of the colours of a frame; None: nothing."""
        if self.corner is None and name not in self.gain and self.dimmed == 1:
            return None
        red, green, blue = (value * self.dimmed for value in self.gain.get(name, (1.0, 1.0, 1.0)))
        return Tone((red, green, blue), self.corner)

    @property
    def photometric(self) -> bool:
        return self.coloured or bool(self.weight)

    def on_capture(self, capture: Capture) -> Capture:
        """The capture with the refined lens and poses, and with the depth camera where it stands."""
        if not self.geometric and self.depth is None:
            return capture
        frames = []
        for frame in capture.frames:
            camera = frame.intrinsics if self.lens is None or frame.intrinsics is None else bent(frame.intrinsics, self.lens)
            depth = frame.depth_pose
            if self.depth is not None and frame.depth is not None:
                depth = self.depth if depth is None else self.depth @ depth
            pose = self.poses.get(frame.name, frame.world_from_camera)
            frames.append(replace(frame, intrinsics=camera, world_from_camera=pose, depth_pose=depth))
        return capture.with_frames(frames)

    def on_views(self, views: Views) -> Views:
        """The views in canonical colour, training views with their weights, held-out ones with their photos.

        Not valid any more are clipped pixels of training views that become darker: their colour is not known.
        """
        if not self.photometric:
            return views
        tones = [self.tone(name) for name in views.names]
        images = list(views.images)
        valid: list[Array | None] = list(views.valid) if views.valid else [None] * len(views)
        photos: list[Array | None] = [None] * len(views)
        for index, tone in enumerate(tones):
            if tone is None:
                continue
            images[index], lost = tone.undone(views.images[index], views.intrinsics[index])
            if views.test[index]:  # scored against the photo, which is known everywhere
                photos[index] = views.images[index]
            elif lost is not None and lost.any():
                before = valid[index]
                valid[index] = ~lost if before is None else before & ~lost
        weight = [1.0 if test else self.weight.get(name, 1.0) for name, test in zip(views.names, views.test, strict=True)]
        changed = replace(views, images=images, valid=valid, weight=weight if self.weight else [])
        return replace(changed, photos=photos, tones=tones) if self.coloured else changed

    def to_dict(self) -> dict[str, Any]:
        return {
            "gain": {name: [round(value, 6) for value in gain] for name, gain in self.gain.items()},
            "corner": self.corner,
            "dimmed": self.dimmed,
            "lens": None if self.lens is None else list(self.lens),
            "poses": {name: pose.tolist() for name, pose in self.poses.items()},
            "by_depth": self.by_depth,
            "depth": None if self.depth is None else self.depth.tolist(),
            "weight": dict(self.weight),
        }

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Corrections:
        """The reverse of `to_dict`.

        Raises:
            InputError: the data does not hold what `to_dict` writes.
        """
        try:
            gain = {str(name): tuple(positive(value) for value in values) for name, values in data["gain"].items()}
            poses = {str(name): np.array(pose, dtype=np.float64).reshape(4, 4) for name, pose in data["poses"].items()}
            depth = None if data.get("depth") is None else np.array(data["depth"], dtype=np.float64).reshape(4, 4)
            corner = None if data["corner"] is None else positive(data["corner"])
            dimmed = positive(data.get("dimmed", 1.0))
            lens = None if data["lens"] is None else (float(data["lens"][0]), float(data["lens"][1]))
            # Before there were weights, the most blurred frames were left out.
            weights = data["weight"] if "weight" in data else dict.fromkeys(data["left_out"], 0)
            weight = {str(name): float(value) for name, value in weights.items()}
            if any(not 0 <= value <= 1 for value in weight.values()):
                raise ValueError("a weight is not a share")
            if any(len(values) != 3 for values in gain.values()):
                raise ValueError("a gain is not a number for each channel")
            told = [*poses.values(), *(one for one in (depth, lens) if one is not None)]
            if any(not np.isfinite(numbers).all() for numbers in told):
                raise ValueError("a pose or the lens is not finite")
            exact = {name: (values[0], values[1], values[2]) for name, values in gain.items()}
            by_depth = data.get("by_depth") is True
            return cls(exact, corner=corner, dimmed=dimmed, lens=lens, poses=poses, by_depth=by_depth, depth=depth, weight=weight)
        except (KeyError, TypeError, ValueError, AttributeError, IndexError, OverflowError) as error:
            raise InputError(f"effects.json is not what the effects stage writes ({first_line(error)}); remove it and run again") from error


def correctable(camera: Intrinsics) -> bool:
    """Whether more of a lens can be told to this camera: a pinhole, or the polynomial without its rational part."""
    return camera.lens == PINHOLE or (camera.lens == OPENCV and not any(camera.distortion[5:]))


def bent(camera: Intrinsics, lens: tuple[float, float]) -> Intrinsics:
    """The camera with k1, k2 applied to ideal points before its own lens; what is both is fitted over the picture by least squares."""
    k1, k2 = lens
    if not camera.distorted:
        return replace(camera, lens=OPENCV, distortion=(k1, k2, 0.0, 0.0))
    given = (*camera.distortion, 0.0, 0.0, 0.0, 0.0, 0.0)[:5]
    radial = replace(camera, distortion=(given[0], given[1], 0.0, 0.0, given[4]))
    reach = float(np.hypot(max(camera.cx, camera.width - camera.cx) / camera.fx, max(camera.cy, camera.height - camera.cy) / camera.fy))
    r = np.linspace(0, reach, 200)[1:]
    inner = r * (1 + r**2 * (k1 + r**2 * k2))
    outer = distort(radial, np.stack([inner, np.zeros_like(inner)], axis=1))[:, 0]
    terms = np.stack([r**3, r**5, r**7], axis=1)
    a, b, c = np.linalg.lstsq(terms, outer - r, rcond=None)[0]
    return replace(camera, distortion=(float(a), float(b), given[2], given[3], float(c)))
