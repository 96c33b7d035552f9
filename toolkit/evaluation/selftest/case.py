"""What a case of the self-test is, and how cases are found and run."""

from __future__ import annotations

import importlib
import math
import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

MODULES = (
    "compositing",
    "compositing_more",
    "rays",
    "rays_background",
    "lookup",
    "volume",
    "edit",
    "colours",
    "network",
    "network_views",
    "network_fusion",
    "network_sweep",
    "engines",
    "engines_gradients",
    "place",
    "place_files",
    "cameras",
    "cameras_degenerate",
    "data",
    "data_more",
    "metrics",
    "fits",
)
SMALLEST = float(torch.finfo(torch.float32).tiny)  # that float32 holds in full
Run = Callable[[Path], "list[Measure]"]


@dataclass(frozen=True)
class Measure:
    """One number of a case: how far something is from its reference, and how far it may be. NaN is never within a bound."""

    quantity: str
    error: float
    bound: float

    @property
    def good(self) -> bool:
        return self.error <= self.bound


@dataclass(frozen=True)
class Case:
    """A hard case. `run` gets an empty folder for files and answers its measures."""

    group: str
    name: str
    run: Run
    slow: bool = False  # more than about two seconds or half a gigabyte: left out of quick runs

    @property
    def title(self) -> str:
        return f"{self.group}: {self.name}"


@dataclass(frozen=True)
class Outcome:
    """What came of a case: its measures, or how it failed."""

    case: Case
    measures: list[Measure] = field(default_factory=list)
    seconds: float = 0.0
    failure: str = ""

    @property
    def good(self) -> bool:
        return not self.failure and bool(self.measures) and all(measure.good for measure in self.measures)


_CASES: dict[tuple[str, str], Case] = {}


def case(group: str, name: str, slow: bool = False) -> Callable[[Run], Run]:
    """Register the decorated function as a case."""

    def register(run: Run) -> Run:
        if (group, name) in _CASES:
            raise ValueError(f"the case {group}: {name} is there already")
        _CASES[group, name] = Case(group, name, run, slow)
        return run

    return register


def all_cases() -> list[Case]:
    """Every case, in the order of `MODULES`."""
    for name in MODULES:
        importlib.import_module(f"fieldfuse.evaluation.selftest.{name}")
    return list(_CASES.values())


def run_case(chosen: Case) -> Outcome:
    """Run one case in a folder of its own; whatever it raises is its failure."""
    start = time.monotonic()
    try:
        with tempfile.TemporaryDirectory(prefix="fieldfuse-selftest-") as folder:
            torch.manual_seed(0)
            measures = chosen.run(Path(folder))
    except Exception as error:  # a case that breaks is a result, the others still run
        return Outcome(chosen, [], time.monotonic() - start, f"{type(error).__name__}: {' '.join(str(error).split())}")
    return Outcome(chosen, measures, time.monotonic() - start)


def run_cases(cases: Iterable[Case], finished: Callable[[Outcome], None] | None = None) -> list[Outcome]:
    """Run cases one after the other, telling `finished` of each."""
    outcomes = []
    for chosen in cases:
        outcomes.append(run_case(chosen))
        if finished is not None:
            finished(outcomes[-1])
    return outcomes


# ------------------------------------------------------------------------------------------------ errors


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
