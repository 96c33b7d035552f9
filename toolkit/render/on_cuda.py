"""Whether this machine can run kernels written in Triton, which comes with torch for CUDA and nowhere else."""

from __future__ import annotations

from importlib.util import find_spec

import torch

OLDEST = 7  # compute capability; Triton's own least


def runs_triton(device: torch.device) -> bool:
    """Whether kernels in Triton run on `device`."""
    return device.type == "cuda" and find_spec("triton") is not None and torch.cuda.get_device_capability(device)[0] >= OLDEST
