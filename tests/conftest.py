"""Shared helpers of the tests: where the optional real captures are."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import torch

if not torch.cuda.is_available():
    os.environ.setdefault("TRITON_INTERPRET", "1")  # before anything imports it: kernels for CUDA are tried here without a GPU
torch.set_num_threads(1)  # the tensors are small, and two threads that share one core wait for each other


@pytest.fixture(autouse=True)
def _numbers_of_its_own() -> None:
    """Each test draws the same tensors whichever ran before it: one that held for most of them failed once in 27 runs."""
    torch.manual_seed(0)


def shared_data(name: str) -> Path:
    """The folder (or file) of a real capture, or skip the test with the reason.

    Looked for in $FIELDFUSE_DATA, else in `../shared/data` beside the repository.
    """
    root = Path(os.environ.get("FIELDFUSE_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
    path = root / name
    if not path.exists():
        pytest.skip(f"the real capture {name} is not here (set FIELDFUSE_DATA to the folder that holds it)")
    return path
