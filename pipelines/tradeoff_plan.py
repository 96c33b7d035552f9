"""Which settings `fieldfuse tradeoff` measures: one step at a time around the default along each axis, and the ladder of fitting times."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from fieldfuse.errors import InputError

TIMES = (3.0, 10.0, 30.0, 60.0, 120.0, 300.0, 900.0)
BASE_TIME = 30.0  # the largest of the times up to this is the default that single steps start from
SURFACE_VOXELS = (4.0, 2.0, 1.0, 0.5)  # of the automatic voxel size, for surfaces …
FIELD_VOXELS = (2.0, 1.4, 0.7)  # … and for fields, beside the automatic one
KEY_FRAMES = (0.1, 0.25, 0.5)  # of the key frames that the networks fuse, beside all of them
DIRECT_VOXELS = (2.0, 1.4)  # of the networks' automatic voxel size, beside that: it is as fine as pays
SHARES = (0.25, 0.5)  # of the training views, beside all of them
SAMPLES = (2, 8)  # in a brick of four voxels along a ray, beside 4
PRECISIONS = ("uint8", "float32")  # of the stored field, beside float16
DECODER_TIMES = (10.0, 60.0)  # both decoders are measured at the times between these
DEFAULT = {"voxel_size": 1.0, "views": 1.0, "samples": 4, "precision": "float16"}


@dataclass(frozen=True)
class Wanted:
    """One thing to make and measure.

    Attributes:
        wanted: axis → what is asked for: seconds, shares of the automatic voxel size and of the training views, names.
        axes: those along which it is a step.
        variants: other ways to store or show the same result, each with its axis.
    """

    method: str
    wanted: dict[str, Any]
    axes: tuple[str, ...]
    seed: int = 0
    variants: tuple[dict[str, Any], ...] = field(default=())

    @property
    def id(self) -> str:
        return point_id(self.method, self.wanted)

    @property
    def name(self) -> str:
        """Of its file."""
        return f"{self.id}-seed{self.seed}"

    @property
    def is_surface(self) -> bool:
        return self.method.startswith("tsdf")


def point_id(method: str, wanted: dict[str, Any]) -> str:
    """A name of what differs from the default: `field-30s-views0.5`."""
    parts = [method]
    if "iterations" in wanted:
        parts.append(f"{wanted['iterations']:g}s")
    parts += [
        f"{key.split('_')[0]}{wanted[key]}" for key in (*DEFAULT, "keyframes") if key in wanted and wanted[key] != DEFAULT.get(key, 1.0)
    ]
    return "-".join(parts)


def chosen_axes(text: str | None, can_vary: Sequence[str], why_not: dict[str, str]) -> list[str]:
    """The axes that `--axes` names, all that there are without it.

    Raises:
        InputError: one that does not exist, or that cannot be varied here.
    """
    if text is None:
        return list(can_vary)
    names = [name.strip().replace("-", "_") for name in text.split(",") if name.strip()]
    there = f"here {', '.join(can_vary)} can be varied"
    for name in names:
        if name not in can_vary:
            reason = f"the axis {name} cannot be varied, because {why_not[name]}" if name in why_not else f"there is no axis {name!r}"
            raise InputError(f"{reason}; {there}")
    if not names:
        raise InputError(f"--axes names no axis; {there}")
    return list(dict.fromkeys(names))


def chosen_times(text: str | None) -> list[float]:
    """The seconds that `--times` names, ascending.

    Raises:
        InputError: not a list of positive numbers.
    """
    if text is None:
        return list(TIMES)
    try:
        times = sorted({float(part) for part in text.split(",") if part.strip()})
    except ValueError:
        times = []
    if not times or not all(0.2 <= time <= 86400 for time in times):
        raise InputError(f"--times is {text!r}; it must be seconds of fitting from 0.2 on, separated by commas, such as 3,10,30")
    return times


def base_time(times: Sequence[float]) -> float:
    """The fitting time that single steps along other axes use."""
    return max([time for time in times if time <= BASE_TIME] or [min(times)])


def plan(axes: Iterable[str], times: Sequence[float], seeds: int, surface: str | None) -> list[Wanted]:
    """Everything to be measured, the most telling first; repetitions with other seeds last. Surfaces draw no random numbers.

    Args:
        surface: `tsdf` or `tsdf_stereo`; None: there is no depth.
    """
    axes = list(axes)
    base = base_time(times)
    ladder = list(times) if "iterations" in axes else [base]
    both = [time for time in ladder if DECODER_TIMES[0] <= time <= DECODER_TIMES[1]] or [base]
    out = _fields(axes, ladder, base, both, 0)
    if surface is not None:
        first, *others = _surfaces(axes, surface)
        out[1:1] = [first]
        out[len(ladder) + 1 : len(ladder) + 1] = others
    out += _direct(axes)
    for seed in range(1, seeds):
        out += _fields(axes, ladder, base, both, seed)
    return out


def _fields(axes: list[str], ladder: list[float], base: float, both: list[float], seed: int) -> list[Wanted]:
    def one(time: float, decoder: str, along: Iterable[str], variants: tuple[dict[str, Any], ...] = (), **other: Any) -> Wanted:
        method = "field" if decoder == "deferred" else "field_per_sample"
        kept = tuple(axis for axis in along if axis in axes)
        return Wanted(method, {"iterations": time, **DEFAULT, "decoder": decoder, **other}, kept, seed, variants)

    shown: list[dict[str, Any]] = [{"axis": "samples", "samples": count} for count in SAMPLES if "samples" in axes]
    shown += [{"axis": "precision", "precision": kind} for kind in PRECISIONS if "precision" in axes]
    at_base = ["iterations", "voxel_size", "views", "samples", "precision", *(["decoder"] if base in both else [])]
    out = [one(base, "deferred", at_base, tuple(shown))]
    out += [one(time, "deferred", ["iterations", *(["decoder"] if time in both else [])]) for time in ladder if time != base]
    if "voxel_size" in axes:
        out += [one(base, "deferred", ["voxel_size"], voxel_size=factor) for factor in FIELD_VOXELS]
    if "views" in axes:
        out += [one(base, "deferred", ["views"], views=share) for share in SHARES]
    if "decoder" in axes:
        out += [one(time, "per_sample", ["decoder", "iterations"]) for time in both]
    return out


def _direct(axes: list[str]) -> list[Wanted]:
    """The networks alone: a curve over key frames, and one over voxel sizes with all of them."""
    if "keyframes" not in axes:
        return []
    both = tuple(axis for axis in ("voxel_size", "keyframes") if axis in axes)
    out = [Wanted("direct", {"keyframes": 1.0, "views": 1.0, "voxel_size": 1.0}, both)]
    out += [Wanted("direct", {"keyframes": share, "views": 1.0, "voxel_size": 1.0}, ("keyframes",)) for share in KEY_FRAMES]
    if "voxel_size" in axes:
        out += [Wanted("direct", {"keyframes": 1.0, "views": 1.0, "voxel_size": factor}, ("voxel_size",)) for factor in DIRECT_VOXELS]
    return out


def _surfaces(axes: list[str], method: str) -> list[Wanted]:
    """The automatic voxel size first: the others are shares of it."""
    views = method == "tsdf"  # matching uses all views: with fewer of them depth would be another, too
    out = [Wanted(method, {"voxel_size": 1.0, "views": 1.0}, tuple(axis for axis in ("voxel_size", "views") if axis in axes))]
    if "voxel_size" in axes:
        out += [Wanted(method, {"voxel_size": factor, "views": 1.0}, ("voxel_size",)) for factor in SURFACE_VOXELS if factor != 1]
    if "views" in axes and views:
        out += [Wanted(method, {"voxel_size": 1.0, "views": share}, ("views",)) for share in SHARES]
    return out
