"""Whether it costs nothing to ask how many there are. A device of its own works behind the processor, which has to wait for the answer."""

from __future__ import annotations

import torch


def asks_freely(device: torch.device) -> bool:
    """True on the CPU. Elsewhere what is not chosen is computed along, where that is cheaper than to choose and to wait."""
    return device.type == "cpu"
