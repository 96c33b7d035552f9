"""What is taken out of a capture before anything is fitted to it, as plain data: colours, the lens, errors of poses, weights.

Gains have geometric mean 1 over the training images, the vignetting is 1 in the middle, refined poses are held to the given ones
(`refine.believed`): every freedom that images do not decide is fixed. What would then be too bright for an image is made room for
(`dimmed`). Where nothing is to be corrected, the very same objects come back. What no camera explains is not corrected (`beyond`,
`beyond_depth`, `bounded_gains`), whatever evidence speaks for it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from fieldfuse.camera import OPENCV, PINHOLE, Array, Intrinsics, distort
from fieldfuse.capture.types import Capture, Views
from fieldfuse.errors import InputError, first_line
from fieldfuse.tone import Gain, Tone, positive

STOPS, TINT = 2.0, 1.0  # of a frame's exposure from the usual one, and of its red and blue from green
STRAY = 0.1  # share of the frames that may lie beyond: their gains are bounded; with more of them none is believed
CORNER = 0.4  # of cos⁴, the natural fall of light to the corner: what a lens and its barrel may leave
BENT = 0.25  # of the half diagonal, by which a lens may move the corners beyond the lens that is given
TURN, MOVE = 10.0, 0.25  # degrees and shares of the scene's median depth by which the usual pose may be corrected
DEPTH_CAMERA, DEPTH_TURN = 0.10, 5.0  # metres and degrees between the cameras of one phone or sensor
DEPTH_SHARE = 0.1  # of the median depth, where a unit of length is not known


@dataclass(frozen=True)
class Corrections:
    """By the frames' names, where each frame has its own."""

    gain: dict[str, Gain] = field(default_factory=dict)
    corner: float | None = None  # light left at half a diagonal
    dimmed: float = 1.0  # canonical light is divided by this besides, so that little of it is clipped
    lens: tuple[float, float] | None = None  # k1, k2 beyond the given lens
    poses: dict[str, Array] = field(default_factory=dict)  # (4, 4) world_from_camera
    weight: dict[str, float] = field(default_factory=dict)  # of frames that count for less in the fit: share of their pixels, 0 to 1
    depth: Array | None = None  # (4, 4) the image's camera from the depth camera, where depth was not brought to the images
    by_depth: bool = False  # whether a sensor's depth took part in the poses

    @property
    def geometric(self) -> bool:
        return self.lens is not None or bool(self.poses)

    @property
    def coloured(self) -> bool:
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
            gain = {str(name): _three(values) for name, values in data["gain"].items()}
            poses = {str(name): _pose(pose) for name, pose in data["poses"].items()}
            lens = None if data["lens"] is None else (float(data["lens"][0]), float(data["lens"][1]))
            # Before there were weights, the most blurred frames were left out.
            weights = data["weight"] if "weight" in data else dict.fromkeys(data["left_out"], 0)
            weight = {str(name): float(value) for name, value in weights.items()}
            if any(not 0 <= value <= 1 for value in weight.values()) or not np.isfinite(lens or 0).all():
                raise ValueError("a weight is not a share, or the lens is not finite")
            return cls(
                gain,
                corner=None if data["corner"] is None else positive(data["corner"]),
                dimmed=positive(data.get("dimmed", 1.0)),
                lens=lens,
                poses=poses,
                by_depth=data.get("by_depth") is True,
                depth=None if data.get("depth") is None else _pose(data["depth"]),
                weight=weight,
            )
        except (KeyError, TypeError, ValueError, AttributeError, IndexError, OverflowError) as error:
            raise InputError(f"effects.json is not what the effects stage writes ({first_line(error)}); remove it and run again") from error


def _three(values: Any) -> Gain:
    red, green, blue = (positive(value) for value in values)
    return red, green, blue


def _pose(values: Any) -> Array:
    pose = np.array(values, dtype=np.float64).reshape(4, 4)
    if not np.isfinite(pose).all():
        raise ValueError("a pose is not finite")
    return pose


def correctable(camera: Intrinsics) -> bool:
    """Whether more of a lens can be added to this camera: a pinhole, or the polynomial without its rational part."""
    return camera.lens == PINHOLE or (camera.lens == OPENCV and not any(camera.distortion[5:]))


def bent(camera: Intrinsics, lens: tuple[float, float]) -> Intrinsics:
    """The camera with k1, k2 applied to ideal points before its own lens; what is both is fitted over the image by least squares."""
    k1, k2 = lens
    if not camera.distorted:
        return replace(camera, lens=OPENCV, distortion=(k1, k2, 0.0, 0.0))
    given = (*camera.distortion, 0.0, 0.0, 0.0, 0.0, 0.0)[:5]
    radial = replace(camera, distortion=(given[0], given[1], 0.0, 0.0, given[4]))
    r = np.linspace(0, float(np.hypot(*_corner(camera))), 200)[1:]
    inner = r * (1 + r**2 * (k1 + r**2 * k2))
    outer = distort(radial, np.stack([inner, np.zeros_like(inner)], axis=1))[:, 0]
    terms = np.stack([r**3, r**5, r**7], axis=1)
    a, b, c = np.linalg.lstsq(terms, outer - r, rcond=None)[0]
    return replace(camera, distortion=(float(a), float(b), given[2], given[3], float(c)))


def _corner(camera: Intrinsics) -> tuple[float, float]:
    """The farthest corner on the ideal image plane."""
    return max(camera.cx, camera.width - camera.cx) / camera.fx, max(camera.cy, camera.height - camera.cy) / camera.fy


def bounded_gains(gain: dict[str, tuple[float, float, float]]) -> dict[str, tuple[float, float, float]] | None:
    """Gains within `STOPS` and `TINT` of the usual; None: too many frames lie beyond."""
    if not gain:
        return gain
    stops = np.log2(np.array(list(gain.values())))
    usual = np.median(stops, axis=0)
    level = np.clip(stops[:, 1] - usual[1], -STOPS, STOPS)
    tint = np.clip((stops - stops[:, 1:2]) - (usual - usual[1]), -TINT, TINT)
    kept = usual + level[:, None] + tint
    if np.mean(np.abs(kept - stops).max(axis=1) > 1e-9) > STRAY:
        return None
    return {name: (float(r), float(g), float(b)) for name, (r, g, b) in zip(gain, np.exp2(kept), strict=True)}


def beyond(corrections: Corrections, cameras: list[Intrinsics], given: dict[str, Array], depth: float) -> dict[str, str]:
    """Which effects' corrections no camera explains, and why.

    Args:
        cameras: of the frames, as the capture gives them.
        given: (4, 4) poses by frame name, before they were refined.
        depth: the scene's usual depth, units of the poses.
    """
    out = {}
    if corrections.gain and bounded_gains(corrections.gain) is None:
        out["exposure"] = f"more than {100 * STRAY:.0f}% of the frames would be more than {STOPS:g} stops off the usual exposure or tint"
    if corrections.corner is not None and cameras:
        # cos⁴ of the angle at half a diagonal
        least = CORNER * min((1 + 0.25 * np.hypot(one.width / one.fx, one.height / one.fy) ** 2) ** -2 for one in cameras)
        if not least <= corrections.corner <= 1.0:
            out["vignetting"] = f"the corners would keep {100 * corrections.corner:.0f}% of their light, which no lens of this angle does"
    if corrections.lens is not None and cameras:
        corner = np.array([_corner(cameras[0])])
        moved = float(np.linalg.norm(distort(bent(cameras[0].pinhole(), corrections.lens), corner) - corner) / np.linalg.norm(corner))
        if not moved <= BENT:
            out["distortion"] = f"the corners would move by {100 * moved:.0f}% of the half diagonal, more than {100 * BENT:.0f}%"
    moved_poses = [(given[name], pose) for name, pose in corrections.poses.items() if name in given]
    if moved_poses:
        way, turn = apart(np.array([one for one, _ in moved_poses]), np.array([other for _, other in moved_poses]))
        way, turn = np.median(way), np.median(turn)
        if not (way <= MOVE * depth and turn <= TURN):
            out["poses"] = (
                f"cameras would move by {100 * way / max(depth, 1e-12):.0f}% of the usual depth and turn by {turn:.1f}° in the median, "
                f"more than {100 * MOVE:.0f}% and {TURN:g}° are not refined but found anew: use --poses sfm"
            )
    return out


def beyond_depth(depth_pose: Array, metric: bool, depth: float) -> str | None:
    """Why no device has a depth camera that stands at (4, 4) `depth_pose`; None: one may."""
    way = float(np.linalg.norm(depth_pose[:3, 3]))
    turn = float(apart(np.eye(4)[None], depth_pose[None])[1][0])
    if metric and way > DEPTH_CAMERA:
        return (
            f"the depth camera would stand {100 * way:.1f} cm beside the images', "
            f"and none of a phone or a sensor stands farther than {100 * DEPTH_CAMERA:.0f} cm"
        )
    if not metric and way > DEPTH_SHARE * depth:
        return f"the depth camera would stand {100 * way / max(depth, 1e-12):.0f}% of the usual depth beside the images'"
    if turn > DEPTH_TURN:
        return f"the depth camera would be turned by {turn:.1f}°, more than {DEPTH_TURN:g}°"
    return None


def apart(one: Array, other: Array) -> tuple[Array, Array]:
    """(N,) distances and (N,) degrees between poses (N, 4, 4)."""
    way = np.linalg.norm(one[:, :3, 3] - other[:, :3, 3], axis=1)
    cosine = (np.einsum("nij,nij->n", one[:, :3, :3], other[:, :3, :3]) - 1) / 2
    return way, np.degrees(np.arccos(np.clip(cosine, -1, 1)))
