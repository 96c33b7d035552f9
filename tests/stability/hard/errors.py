"""How far numbers are from their references, for tests: NaN, shapes and infinities count as errors without end."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import torch
from torch import Tensor

SMALLEST = float(torch.finfo(torch.float32).tiny)  # that float32 holds in full


def absolute(got: Any, wanted: Any) -> float:
    """Largest difference; infinite when something is NaN on one side only, shapes differ, or infinities differ."""
    first, second = _pair(got, wanted)
    if first.shape != second.shape:
        return math.inf
    if first.numel() == 0:
        return 0.0
    difference = torch.where(first == second, torch.zeros_like(first), (first - second).abs())
    return math.inf if bool(difference.isnan().any()) else float(difference.max())


def relative(got: Any, wanted: Any, floor: float = 0.0) -> float:
    """Largest difference by the reference's size, entry by entry; below `floor` the size counts as `floor`."""
    first, second = _pair(got, wanted)
    if first.shape != second.shape:
        return math.inf
    if first.numel() == 0:
        return 0.0
    difference = torch.where(first == second, torch.zeros_like(first), (first - second).abs())
    size = second.abs().clamp_min(floor)
    ratio = torch.where(difference == 0, torch.zeros_like(difference), difference / size)
    return math.inf if bool(ratio.isnan().any()) else float(ratio.max())


def by_size(got: Any, wanted: Any) -> float:
    """Largest difference by the largest entry of the reference: what a sum of many terms can promise. Where that entry is smaller than any
    number that float32 holds in full, the difference itself."""
    _, second = _pair(got, wanted)
    size = float(second.abs().max()) if second.numel() else 1.0
    return absolute(got, wanted) / (size if size >= SMALLEST else 1.0)


def largest(errors: Iterable[dict[str, float]]) -> dict[str, float]:
    """Of several results with the same names the largest of each."""
    out: dict[str, float] = {}
    for each in errors:
        out = {name: max(out.get(name, 0.0), error) for name, error in each.items()}
    return out


def not_finite(*values: Any) -> float:
    """How many entries are NaN or infinite."""
    return float(sum(int((~torch.isfinite(_double(value))).sum()) for value in values))


def refused(action: Callable[[], object], kinds: type[Exception] | tuple[type[Exception], ...], words: str = "") -> float:
    """0 when `action` raises one of `kinds` with one line that holds `words`, else 1."""
    try:
        action()
    except kinds as error:
        text = str(error)
        return float("\n" in text or len(text) < 10 or words.lower() not in text.lower())
    return 1.0


def _pair(got: Any, wanted: Any) -> tuple[Tensor, Tensor]:
    return _double(got), _double(wanted)


def _double(value: Any) -> Tensor:
    if isinstance(value, Tensor | np.ndarray):
        return torch.as_tensor(value).detach().to(torch.float64).cpu()
    return torch.tensor(value, dtype=torch.float64)  # lists of Python numbers would become float32
