"""What a camera and its sensors do to light and depth: forward models, each with its equation. `scenery` has what stands before the camera.

Light takes this way: lens and rows → open shutter → vignetting → exposure → sensor noise → clipping, sRGB and 8 bits → compression.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass, replace
from typing import Annotated

import cv2
import numpy as np
import torch
from pydantic import Field
from scipy.spatial.transform import Rotation

from fieldfuse.camera import OPENCV, Array, Intrinsics, lens_limit
from fieldfuse.errors import InputError

Tensor = torch.Tensor
Finite = Annotated[float, Field(allow_inf_nan=False)]
Probability = Annotated[float, Field(ge=0, le=1)]
TOE = 0.0031308  # linear value where the straight part of sRGB near black ends
JUMP = 0.05  # relative difference of depth that makes an edge


@dataclass(frozen=True)
class Distortion:
    """Lens distortion: OpenCV's radial and tangential polynomial (Brown 1966). (x, y) is the ideal point (x/z, y/z), r² = x² + y²:

        x' = x·(1 + k1·r² + k2·r⁴ + k3·r⁶) + 2·p1·x·y + p2·(r² + 2·x²)
        y' = y·(1 + k1·r² + k2·r⁴ + k3·r⁶) + p1·(r² + 2·y²) + 2·p2·x·y

    The simulator sends each pixel's own ray through `invert`, so its images are never resampled.
    """

    k1: Finite = -0.12
    k2: Finite = 0.03
    p1: Finite = 0.0
    p2: Finite = 0.0
    k3: Finite = 0.0

    @classmethod
    def of(cls, camera: Intrinsics) -> Distortion:
        """The lens of a camera with OpenCV's polynomial."""
        return cls(*(*camera.distortion, 0.0, 0.0, 0.0, 0.0, 0.0)[:5])

    def forward(self, points: Tensor) -> Tensor:
        """Ideal image-plane points (..., 2) → where the lens puts them (..., 2)."""
        x, y = points[..., 0], points[..., 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        bent_x = x * radial + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x)
        bent_y = y * radial + self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y
        return torch.stack([bent_x, bent_y], dim=-1)

    def invert(self, points: Tensor) -> Tensor:
        """Distorted image-plane points (..., 2) → ideal ones, by Newton's method in float64 (exact to rounding where one-to-one)."""
        target = points.double()
        ideal = target.clone()
        for _ in range(20):
            x, y = ideal[..., 0], ideal[..., 1]
            r2 = x * x + y * y
            radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
            slope = 2 * (self.k1 + r2 * (2 * self.k2 + 3 * r2 * self.k3))  # of `radial` by r², times 2
            xx = radial + slope * x * x + 2 * self.p1 * y + 6 * self.p2 * x
            yy = radial + slope * y * y + 6 * self.p1 * y + 2 * self.p2 * x
            xy = slope * x * y + 2 * self.p1 * x + 2 * self.p2 * y  # symmetric
            off = self.forward(ideal) - target
            scale = xx * yy - xy * xy
            step = torch.stack([yy * off[..., 0] - xy * off[..., 1], xx * off[..., 1] - xy * off[..., 0]], dim=-1) / scale[..., None]
            ideal = ideal - step
            if float(step.abs().max() if step.numel() else 0.0) < 1e-14:
                break
        return ideal.to(points.dtype)

    def before(self, camera: Intrinsics) -> Intrinsics:
        """The pinhole camera with this lens.

        Raises:
            InputError: the polynomial turns back inside the image, so that one pixel would see two directions.
        """
        values = astuple(self)
        out = replace(camera, lens=OPENCV, distortion=values if self.k3 else values[:4])
        corners = torch.tensor([[0.0, 0.0], [0, camera.height], [camera.width, 0], [camera.width, camera.height]])
        place = (corners.double() - torch.tensor([camera.cx, camera.cy])) / torch.tensor([camera.fx, camera.fy])
        ideal = self.invert(place)
        radius = float(ideal.norm(dim=1).max())
        if not (self.forward(ideal) - place).abs().max() < 1e-9 or not lens_limit(out, radius) >= radius:
            raise InputError(
                f"the lens distortion k1={self.k1:g}, k2={self.k2:g} turns back inside the picture; "
                "use smaller values or a narrower field of view"
            )
        return out


@dataclass(frozen=True)
class RollingShutter:
    """The rows of an image are exposed one after the other. Row v (pixel centres at v + 0.5) of a frame at time t is exposed at

        t_v = t + readout · ((v + 0.5) / H − 0.5)

    so the middle of the image belongs to the frame's own time and pose.
    """

    readout: Annotated[float, Field(ge=-1, le=1)] = 0.018  # seconds from the first row to the last

    def rows(self, seconds: float, height: int) -> Array:
        """(H,) float64 time of each row of a frame at `seconds`."""
        return np.asarray(seconds + self.readout * ((np.arange(height) + 0.5) / height - 0.5))


@dataclass(frozen=True)
class MotionBlur:
    """What the sensor gathers while the shutter is open for E seconds and the camera moves, in linear light:

        L' = (1 / E) ∫ L(t + τ) dτ,  τ from −E/2 to E/2  ≈  (1 / n) Σ_k L(t + E·((k + 0.5) / n − 0.5))

    The midpoint rule with n samples is exact up to steps of (motion in pixels) / n.
    """

    exposure: Annotated[float, Field(ge=0, le=2)] = 0.03  # seconds that the shutter is open
    samples: Annotated[int, Field(ge=1, le=256)] = 9

    def instants(self) -> Array:
        """(samples,) float64 seconds relative to the middle of the exposure."""
        return np.asarray(self.exposure * ((np.arange(self.samples) + 0.5) / self.samples - 0.5))


@dataclass(frozen=True)
class Vignetting:
    """Light falls off towards the corners as under the cos⁴ law of a simple lens (`tone.share`):

        L' = L · V(r),    V(r) = (1 + a·r²)⁻²,    a = corner^(−1/2) − 1

    r is the distance from the optical axis in half diagonals, so V(0) = 1 and V(1) = `corner`. With tan θ = √a · r this is cos⁴ θ.
    """

    corner: Annotated[float, Field(ge=0.01, le=1)] = 0.6  # share of the light that is left at half a diagonal from the axis


@dataclass(frozen=True)
class Exposure:
    """Exposure and white-balance drift: every frame's linear light is multiplied by gains of its own, before clipping.

        L'_f = g_f · L,    log2 g_f = e_f + (r_f, 0, b_f)

    e_f in stops (automatic exposure), r_f and b_f the drift of red and blue against green (automatic white balance). Over a capture each
    of the three is a smooth random curve of mean 0 and of the deviation that the parameters name: a common factor is no drift.
    """

    stops: Annotated[float, Field(ge=0, le=4)] = 0.3  # deviation of the exposure over the capture, in factors of two
    tint: Annotated[float, Field(ge=0, le=2)] = 0.06  # the same of red and of blue against green
    waves: Annotated[int, Field(ge=1, le=64)] = 4  # fastest wave over the capture

    def gains(self, frames: int, rng: np.random.Generator) -> Array:
        """(frames, 3) float64 gains of red, green and blue."""
        s = (np.arange(frames) + 0.5) / frames
        wave = np.arange(1, self.waves + 1)
        phase, weight = rng.uniform(0, 2 * np.pi, (3, self.waves)), rng.normal(0, 1, (3, self.waves))
        curves = (weight[..., None] * np.sin(np.pi * wave[:, None] * s + phase[..., None])).sum(1)  # (3, frames)
        curves -= curves.mean(1, keepdims=True)
        curves /= np.maximum(curves.std(1, keepdims=True), 1e-9)
        if frames < 3:  # too short to drift
            curves[:] = 0
        level, red, blue = curves * np.array([[self.stops], [self.tint], [self.tint]])
        return np.asarray(np.exp2(np.stack([level + red, level, level + blue], axis=1)))


@dataclass(frozen=True)
class SensorNoise:
    """Shot noise of the light and read noise of the electronics. With W the electrons of a white pixel and σ_r the read noise,

        L' = (Poisson(W · L) + Normal(0, σ_r²)) / W,    variance L / W + (σ_r / W)²

    independently for every pixel and channel of linear light; light above 1 fills the well and is clipped first.
    """

    well: Annotated[float, Field(ge=1, le=1e7)] = 1500.0  # electrons of a white pixel: the fewer, the noisier
    read: Annotated[float, Field(ge=0, le=1e5)] = 6.0  # electrons

    def forward(self, linear: Array, rng: np.random.Generator) -> Array:
        """Linear light (H, W, 3) → float32 of the same shape with noise; it can be a little below 0."""
        electrons = rng.poisson(np.clip(linear, 0, 1).astype(np.float64) * self.well)
        return np.asarray((electrons + rng.normal(0, self.read, linear.shape)) / self.well, dtype=np.float32)


@dataclass(frozen=True)
class Compression:
    """JPEG (ITU-T T.81) at a quality, colour at half resolution, as cameras and messengers write it.

    Blocks of 8 × 8 pixels lose their fine cosines: each coefficient is rounded to a whole multiple of its entry in the quantisation table,
    which is coarser the lower the quality.
    """

    quality: Annotated[int, Field(ge=1, le=100)] = 60

    def encode(self, image: Array) -> bytes:
        """(H, W, 3) uint8 sRGB → the bytes of a JPEG file."""
        flags = [cv2.IMWRITE_JPEG_QUALITY, int(self.quality), cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420]
        return bytes(cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), flags)[1].tobytes())

    @staticmethod
    def decode(data: bytes) -> Array:
        """The bytes of a JPEG file → (H, W, 3) uint8 sRGB."""
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert image is not None  # what `encode` wrote can be read
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))


@dataclass(frozen=True)
class DepthOffset:
    """A depth camera that does not stand where the images' camera does, in a capture that takes both for one.

        X_d = R X + t,    R = R_x(down) · R_y(right) · R_z(roll)

    X is a point in the axes of the images' camera, X_d in the depth camera's. Two cameras in one housing stand some centimetres apart and
    are not quite parallel; a capture whose depth was not brought to its images has this between them.
    """

    x: Finite = 0.025  # metres
    y: Finite = 0.002
    z: Finite = -0.004
    down: Finite = 0.3  # degrees about the axes of the images' camera
    right: Finite = -0.6
    roll: Finite = 0.4

    def forward(self) -> Array:
        """(4, 4) the depth camera from the images'."""
        out = np.eye(4)
        out[:3, :3] = Rotation.from_euler("XYZ", [self.down, self.right, self.roll], degrees=True).as_matrix()
        out[:3, 3] = self.x, self.y, self.z
        return out


@dataclass(frozen=True)
class DepthNoise:
    """Noise of a depth camera, lengths in metres: errors that grow with z², steps of disparity, holes.

        z' = z + Normal(0, (sigma · z²)²)                     triangulation (Khoshelham and Elberink 2012, equation 10)
        1/z'' = step · round(1 / (z' · step))                 disparity comes in whole steps, so depth in steps of about step · z²
        0 where there is no measurement:
            outside [nearest, farthest]
            next to a jump: the `edge` pixels on both sides of neighbours that differ by more than 5%, with probability `edge_loss`
            on dark surfaces:   probability dark_loss · clamp(1 − albedo / dark, 0, 1)
            on glossy surfaces: probability gloss_loss · gloss

    Losses come in patches of `patch` × `patch` pixels, as they do in real sensors.
    """

    sigma: Annotated[float, Field(ge=0, le=1)] = 0.0015  # 1 / metre: the deviation is sigma · z²
    step: Annotated[float, Field(ge=0, le=1)] = 0.002  # 1 / metre: one step of disparity as a difference of 1/z; 0: none
    edge: Annotated[int, Field(ge=0, le=50)] = 1  # pixels
    edge_loss: Probability = 0.6
    dark: Annotated[float, Field(ge=1e-6, le=1)] = 0.06  # linear albedo below which light is lost
    dark_loss: Probability = 0.9
    gloss_loss: Probability = 0.8
    nearest: Annotated[float, Field(ge=0, le=1e3)] = 0.2
    farthest: Annotated[float, Field(ge=0, le=1e4)] = 10.0
    patch: Annotated[int, Field(ge=1, le=100)] = 3

    def forward(self, depth: Array, albedo: Array, gloss: Array, rng: np.random.Generator) -> Array:
        """(H, W) float32 metres that the sensor measures, 0 = nothing.

        Args:
            depth: (H, W) true metres along z, 0 = nothing there. albedo: (H, W) linear, mean of the channels. gloss: (H, W) in [0, 1].
        """
        z = depth.astype(np.float64)
        noisy = self.quantise(z + rng.normal(0, 1, z.shape) * self.sigma * z**2)
        rows, columns = (-(-size // self.patch) for size in z.shape)
        dice = np.kron(rng.uniform(0, 1, (rows, columns)), np.ones((self.patch, self.patch)))[: z.shape[0], : z.shape[1]]
        gone = (dice < self.loss(z, albedo, gloss)) | (z <= 0) | (noisy < self.nearest) | (noisy > self.farthest)
        return np.where(gone, 0, noisy).astype(np.float32)

    def quantise(self, depth: Array) -> Array:
        """(…) metres rounded to whole steps of inverse depth; what rounds to infinity becomes 0."""
        if self.step <= 0:
            return depth
        steps = np.round(1 / (np.maximum(depth, 1e-6) * self.step))
        return np.asarray(np.where((steps > 0) & (depth > 0), 1 / np.maximum(steps * self.step, 1e-12), 0))

    def loss(self, depth: Array, albedo: Array, gloss: Array) -> Array:
        """(H, W) float64 probability that a pixel has no measurement, for its surroundings, darkness or gloss."""
        near = np.zeros(depth.shape, dtype=np.uint8)
        for axis in (0, 1):
            before, after = (slice(None),) * axis + (slice(None, -1),), (slice(None),) * axis + (slice(1, None),)
            jump = np.abs(depth[after] - depth[before]) > JUMP * np.minimum(depth[after], depth[before])
            near[before] |= jump
            near[after] |= jump
        if self.edge > 1:
            near = np.asarray(cv2.dilate(near, np.ones((2 * self.edge - 1,) * 2, np.uint8)))
        at_edge = self.edge_loss * (near > 0) * (self.edge > 0)
        dark = self.dark_loss * np.clip(1 - albedo / self.dark, 0, 1)
        shiny = self.gloss_loss * np.clip(gloss, 0, 1)
        return np.asarray(1 - (1 - at_edge) * (1 - dark) * (1 - shiny), dtype=np.float64)


def encode_srgb(linear: Tensor) -> Tensor:
    """Linear light → sRGB (IEC 61966-2-1), clipped to [0, 1]: 12.92·L for L ≤ 0.0031308, else 1.055·L^(1/2.4) − 0.055."""
    linear = linear.clamp(0, 1)
    return torch.where(linear <= TOE, 12.92 * linear, 1.055 * linear.clamp(min=TOE) ** (1 / 2.4) - 0.055)


def decode_srgb(stored: Tensor) -> Tensor:
    """sRGB in [0, 1] → linear light: S / 12.92 for S ≤ 0.04045, else ((S + 0.055) / 1.055)^2.4."""
    stored = stored.clamp(0, 1)
    return torch.where(stored <= 12.92 * TOE, stored / 12.92, ((stored + 0.055) / 1.055) ** 2.4)


def to_bytes(stored: Tensor) -> Tensor:
    """[0, 1] → uint8, rounded to the nearest step."""
    return (stored.clamp(0, 1) * 255).round().to(torch.uint8)
