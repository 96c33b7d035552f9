"""The image encoder: one map of 64 channels at a quarter of the image's size, a feature pyramid fused top down, and what of it voxels
look up at half the size; and the code of a viewing direction.

Every stride-2 convolution has an even kernel, so cell j of a map of stride s is centred at s · (j + ½) pixels exactly; unprojection
relies on it. Normalisation by groups keeps the layers alive from the first step on (plain deep stacks die without notice), and the last
one, of each channel over the image, keeps what comes out different from place to place: with groups there, training let it sink to a
deviation of 0.15 and learned more slowly.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from fieldfuse.errors import InputError
from fieldfuse.nerfusion import lite

STRIDE = 2  # pixels a cell of what voxels look up
DEEPEST = 16  # pixels a cell of the deepest level; images are padded to multiples of it
GROUP = 8  # channels normalised together
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet's images, RGB
WIDTHS = (16, 32, 48, 96)  # channels at 1/2, 1/4, 1/8 and 1/16
SMALL, LITE0 = "small", "lite0"
TRUNKS = (SMALL, LITE0)
LAYERS = 5  # of the direction code


class _Conv(nn.Sequential):
    """Convolution, group norm, ReLU; Kaiming initialisation."""

    def __init__(self, inside: int, outside: int, kernel: int, stride: int = 1) -> None:
        conv = nn.Conv2d(inside, outside, kernel, stride, (kernel - 1) // 2, bias=False)
        nn.init.kaiming_normal_(conv.weight, nonlinearity="relu")
        super().__init__(conv, nn.GroupNorm(outside // GROUP, outside), nn.ReLU())


class _Residual(nn.Module):
    """x + two convolutions."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first, self.second = _Conv(channels, channels, 3), _Conv(channels, channels, 3)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.second(self.first(x))


class ImageEncoder(nn.Module):
    """(V, 3, H, W) RGB in [0, 1] → (V, channels, ⌈H/16⌉·4, ⌈W/16⌉·4), of about unit deviation.

    Args:
        channels: of the result.
        trunk: "small", plain convolutions, made for the CPU; or "lite0", which can start from ImageNet weights.

    Attributes:
        widths: channels of the levels at 1/2, 1/4, 1/8 and 1/16.
    """

    mean: Tensor  # of ImageNet's images, (3, 1, 1)
    deviation: Tensor

    def __init__(self, channels: int = 64, trunk: str = SMALL) -> None:
        super().__init__()
        self.trunk = trunk
        self.stem: nn.Sequential
        if trunk == LITE0:
            self.widths, (self.stem, self.stages) = lite.WIDTHS, lite.lite_trunk()
        else:
            self.widths, self.stem = WIDTHS, _Conv(3, WIDTHS[0], 4, 2)
            steps = pairwise(WIDTHS)
            self.stages = nn.ModuleList(nn.Sequential(_Conv(inside, outside, 4, 2), _Residual(outside)) for inside, outside in steps)
        self.laterals = nn.ModuleList(_linear(width, channels, 1) for width in self.widths[1:])
        self.smooth = _linear(channels, channels, 3)
        self.norm = nn.GroupNorm(channels, channels)
        for name, values in (("mean", MEAN), ("deviation", DEVIATION)):
            self.register_buffer(name, torch.tensor(values).view(3, 1, 1), persistent=False)

    def load_imagenet(self, path: Path | str | None = None) -> None:
        """Fill the trunk with ImageNet weights; see `lite.load_imagenet`.

        Raises:
            InputError: the trunk is not "lite0", or there are no such weights.
        """
        if self.trunk != LITE0:
            raise InputError(f"only the encoder {LITE0!r} can start from ImageNet, this one is {self.trunk!r}; set model.encoder={LITE0}")
        assert isinstance(self.stem, nn.Sequential)
        lite.load_imagenet(self.stem, self.stages, path)

    def forward(self, images: Tensor) -> Tensor:
        return self.maps(images)[1]

    def maps(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """The stem's map at half the size, (V, widths[0], ⌈H/16⌉·8, ⌈W/16⌉·8), and the fused one."""
        x = (padded(images) - self.mean) / self.deviation
        half = x = self.stem(x)
        levels = []
        for stage in self.stages:
            x = stage(x)
            levels.append(x)
        fused = self.laterals[2](levels[2])
        for level in (1, 0):
            fused = self.laterals[level](levels[level]) + F.interpolate(fused, scale_factor=2, mode="bilinear", align_corners=False)
        features: Tensor = self.norm(self.smooth(fused))
        return half, features


class Sampled(nn.Module):
    """What voxels look up: few channels of the fused map, enlarged, plus detail from the stem, at half the image's size.

    A voxel's step in depth moves its pixel by about one pixel only, so a map of a quarter of the size cannot tell neighbouring voxels
    apart.
    """

    def __init__(self, fused: int, half: int, channels: int) -> None:
        super().__init__()
        self.coarse, self.fine = _linear(fused, channels, 1), _linear(half, channels, 3)
        self.norm = nn.GroupNorm(channels, channels)

    def forward(self, half: Tensor, fused: Tensor) -> Tensor:
        enlarged = F.interpolate(self.coarse(fused), scale_factor=2, mode="bilinear", align_corners=False)
        features: Tensor = self.norm(enlarged + self.fine(half))
        return features


def _linear(inside: int, outside: int, kernel: int) -> nn.Conv2d:
    conv = nn.Conv2d(inside, outside, kernel, padding=kernel // 2)
    nn.init.kaiming_normal_(conv.weight, nonlinearity="linear")
    return conv


def padded(images: Tensor) -> Tensor:
    """(V, 3, H, W) → the same with the last rows and columns repeated up to multiples of the deepest stride."""
    height, width = images.shape[-2:]
    right, below = -width % DEEPEST, -height % DEEPEST
    return F.pad(images, (0, right, 0, below), mode="replicate") if right or below else images


class DirectionCode(nn.Sequential):
    """G, the direction code of NeRFusion (section 3.1), an MLP of five layers: (N, 3) unit directions, working frame → (N, channels)."""

    def __init__(self, channels: int = 16) -> None:
        layers: list[nn.Module] = []
        for number in range(LAYERS):
            linear = nn.Linear(3 if number == 0 else channels, channels)
            nn.init.kaiming_normal_(linear.weight, nonlinearity="relu" if number < LAYERS - 1 else "linear")
            nn.init.zeros_(linear.bias)
            layers += [linear, nn.ReLU()]
        super().__init__(*layers[:-1])

    def forward(self, directions: Tensor) -> Tensor:
        codes: Tensor = super().forward(directions)
        return codes
