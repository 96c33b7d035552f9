"""Radiance decoders: from voxel features (and a viewing direction) to colour.

`Deferred` decodes once a ray: features are composited along it first. `PerSample` is the paper's R: it decodes density and colour at
every sample (NeRFusion eq. 5, section 3.3). The field's first three features are a colour of their own, so both start well.

Weights that were stored when a direction had the harmonics of degree 2 and less are read as if those of degree 3 had zeros.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import nn

from fieldfuse.backends.constants import FREQUENCIES as FREQUENCIES
from fieldfuse.nerfusion.encoding import BEHIND, DIRECTION, positional, spherical_harmonics

Tensor = torch.Tensor


class Deferred(nn.Module):
    """(rays, C) composited features, (rays, 1) opacity and (rays, 3) directions → (rays, 3) colour in [0, 1]."""

    def __init__(self, channels: int, hidden: int) -> None:
        super().__init__()
        self.channels, self.hidden = channels, hidden
        last = nn.Linear(hidden, 3)
        nn.init.zeros_(last.weight)  # the start is the features' own colour
        nn.init.zeros_(last.bias)
        self.net = nn.Sequential(nn.Linear(channels + DIRECTION, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), last)

    @property
    def layers(self) -> tuple[nn.Linear, nn.Linear, nn.Linear]:
        """The three linear layers, first to last."""
        first, second, last = self.net[0], self.net[2], self.net[4]
        assert isinstance(first, nn.Linear) and isinstance(second, nn.Linear) and isinstance(last, nn.Linear)
        return first, second, last

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *rest: Any) -> None:
        _complete(state_dict, f"{prefix}net.0.weight", self.channels)
        super()._load_from_state_dict(state_dict, prefix, *rest)

    def forward(self, features: Tensor, directions: Tensor) -> Tensor:
        """Colour of an opaque ray with these mean features."""
        view = spherical_harmonics(directions)
        return torch.sigmoid(features[:, :3] + self.net(torch.cat([features, view], 1)))


class PerSample(nn.Module):
    """(samples, C) features and (samples, 3) directions → (samples,) raw density and (samples, 3) colour in [0, 1]."""

    def __init__(self, channels: int, hidden: int) -> None:
        super().__init__()
        self.channels, self.hidden = channels, hidden
        width = channels * (1 + 2 * FREQUENCIES)
        self.body = nn.Sequential(nn.Linear(width, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU())
        self.density = nn.Linear(hidden, 1)
        self.colour = nn.Sequential(nn.Linear(hidden + DIRECTION, hidden), nn.ReLU(), nn.Linear(hidden, 3))
        nn.init.zeros_(self.density.weight)
        nn.init.zeros_(self.density.bias)

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *rest: Any) -> None:
        _complete(state_dict, f"{prefix}colour.0.weight", self.hidden)
        super()._load_from_state_dict(state_dict, prefix, *rest)

    def forward(self, features: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        hidden = self.body(positional(features, FREQUENCIES))
        raw = self.density(hidden).squeeze(1)
        colour = torch.sigmoid(features[:, :3] + self.colour(torch.cat([hidden, spherical_harmonics(directions)], 1)))
        return raw, colour


def _complete(state: dict[str, Any], name: str, before: int) -> None:
    """Zeros for the harmonics that the weight `name` was stored without; they come after `before` other inputs and are the last."""
    weight = state.get(name)
    if isinstance(weight, Tensor) and weight.ndim == 2 and weight.shape[1] == before + BEHIND:
        state[name] = torch.nn.functional.pad(weight, (0, DIRECTION - BEHIND))


def make_decoder(kind: str, channels: int, hidden: int) -> Deferred | PerSample:
    """`kind` is "deferred" or "per_sample"."""
    return Deferred(channels, hidden) if kind == "deferred" else PerSample(channels, hidden)
