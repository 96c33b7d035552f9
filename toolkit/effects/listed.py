"""Which effects a capture has: a list by name and strength, or with parameters; what is not listed is None and is never called."""

from __future__ import annotations

import difflib
import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from types import ModuleType
from typing import Any

import numpy as np

from fieldfuse.effects import (
    background,
    compression,
    depth_noise,
    depth_offset,
    distortion,
    exposure,
    highlights,
    motion_blur,
    passers,
    rolling_shutter,
    sensor_noise,
    vignetting,
)
from fieldfuse.errors import InputError

MODULES: dict[str, ModuleType] = {
    "distortion": distortion,
    "exposure": exposure,
    "vignetting": vignetting,
    "passers": passers,
    "highlights": highlights,
    "background": background,
    "rolling_shutter": rolling_shutter,
    "motion_blur": motion_blur,
    "sensor_noise": sensor_noise,
    "depth_offset": depth_offset,
    "depth_noise": depth_noise,
    "compression": compression,
}
STRENGTHS = ("weak", "medium", "strong")


@dataclass(frozen=True)
class Effects:
    """The effects of a capture, in the order in which light meets them; None: not there."""

    passers: passers.Passers | None = None
    background: background.Background | None = None
    highlights: highlights.Highlights | None = None
    distortion: distortion.Distortion | None = None
    rolling_shutter: rolling_shutter.RollingShutter | None = None
    motion_blur: motion_blur.MotionBlur | None = None
    vignetting: vignetting.Vignetting | None = None
    exposure: exposure.Exposure | None = None
    sensor_noise: sensor_noise.SensorNoise | None = None
    compression: compression.Compression | None = None
    depth_offset: depth_offset.DepthOffset | None = None
    depth_noise: depth_noise.DepthNoise | None = None

    def names(self) -> tuple[str, ...]:
        """The effects that are there."""
        return tuple(entry.name for entry in fields(self) if getattr(self, entry.name) is not None)

    def describe(self) -> dict[str, dict[str, Any]]:
        """Parameters of the effects that are there, as plain data."""
        return {name: asdict(getattr(self, name)) for name in self.names()}


def generator(seed: int, effect: str, frame: int | None = None) -> np.random.Generator:
    """Random numbers of one effect in one frame (None: in the whole capture); no effect's numbers depend on which others there are."""
    return np.random.default_rng([seed, zlib.crc32(effect.encode()), 0 if frame is None else frame + 1])


def parse(listing: Any, where: str) -> Effects:
    """The effects that a scene file or a command lists.

    Args:
        listing: None; a list of `name`, `name:strength` or `{name: strength or parameters}`; or one mapping of the latter.
        where: what to name in errors.

    Raises:
        InputError: an effect, strength or parameter that does not exist (with the nearest one that does), or a value out of range.
    """
    chosen: dict[str, Any] = {}
    for name, wanted in _pairs(listing, where):
        if name not in MODULES:
            raise InputError(f"{where}: there is no effect {name!r}{_near(name, list(MODULES))}; known are {', '.join(MODULES)}")
        if name in chosen:
            raise InputError(f"{where}: the effect {name!r} is listed twice; keep one")
        chosen[name] = _parameters(name, wanted, where)
    return Effects(**chosen)


def _pairs(listing: Any, where: str) -> list[tuple[str, Any]]:
    if listing is None:
        return []
    if isinstance(listing, Mapping):
        return [(str(name), value) for name, value in listing.items() if value is not False]
    if isinstance(listing, str) or not isinstance(listing, Sequence):
        raise InputError(f"{where}: effects must be a list of names, not {str(listing)[:40]!r}")
    out: list[tuple[str, Any]] = []
    for entry in listing:
        if isinstance(entry, Mapping):
            out += _pairs(entry, where)
        else:
            name, _, strength = str(entry).partition(":")
            out.append((name.strip(), strength.strip() or None))
    return out


def _parameters(name: str, wanted: Any, where: str) -> Any:
    presets = MODULES[name].PRESETS
    if wanted is None or wanted is True:
        return presets["medium"]
    if isinstance(wanted, str):
        if wanted not in presets:
            raise InputError(f"{where}: {wanted!r} is no strength of {name}{_near(wanted, list(presets))}; use {', '.join(STRENGTHS)}")
        return presets[wanted]
    if not isinstance(wanted, Mapping):
        raise InputError(f"{where}: {name} takes a strength or parameters, not {str(wanted)[:40]!r}")
    values = dict(wanted)
    # For highlights `strength` is a parameter too; a word is one of the three strengths, a number that parameter.
    word = values.pop("strength", None) if not isinstance(values.get("strength"), int | float) else None
    base = _parameters(name, word, where)
    known = {entry.name: getattr(base, entry.name) for entry in fields(base)}
    for key, value in values.items():
        if key not in known:
            raise InputError(f"{where}: {name} has no parameter {key!r}{_near(str(key), list(known))}; it has {', '.join(known)}")
        known[key] = _like(known[key], value, f"{where}: {name}.{key}")
    made = type(base)(**known)
    _check_range(name, made, where)
    return made


def _like(default: Any, value: Any, where: str) -> Any:
    """`value` as the type of the parameter's default: a number, a whole number, or numbers."""
    if isinstance(default, tuple):
        if not isinstance(value, Sequence) or isinstance(value, str) or len(value) != len(default):
            raise InputError(f"{where} takes {len(default)} numbers, not {str(value)[:40]!r}")
        return tuple(_like(part, given, where) for part, given in zip(default, value, strict=True))
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(f"{where} takes a number, not {str(value)[:40]!r}")
    if isinstance(default, int) and value != int(value):
        raise InputError(f"{where} takes a whole number, not {value:g}")
    return int(value) if isinstance(default, int) else float(value)


RANGES: dict[str, dict[str, tuple[float, float]]] = {  # where a formula needs more than a finite number
    "exposure": {"stops": (0, 4), "tint": (0, 2), "waves": (1, 64)},
    "vignetting": {"corner": (0.01, 1)},
    "passers": {"share": (0, 1), "near": (0.05, 1), "far": (0.05, 1), "speed": (0.05, 20)},
    "highlights": {"strength": (0, 100), "coat": (0, 1)},
    "background": {"detail": (0, 1), "seed": (0, 2**31 - 1), "haze": (0, 10), "zenith": (0, 10), "earth": (0, 10)},
    "rolling_shutter": {"readout": (-1, 1)},
    "motion_blur": {"exposure": (0, 2), "samples": (1, 256)},
    "sensor_noise": {"well": (1, 1e7), "read": (0, 1e5)},
    "depth_noise": {
        **dict.fromkeys(("edge_loss", "dark_loss", "gloss_loss"), (0.0, 1.0)),
        "sigma": (0, 1),
        "step": (0, 1),
        "edge": (0, 50),
        "dark": (1e-6, 1),
        "nearest": (0, 1e3),
        "farthest": (0, 1e4),
        "patch": (1, 100),
    },
    "compression": {"quality": (1, 100)},
}


def _check_range(name: str, made: Any, where: str) -> None:
    for key, (low, high) in RANGES.get(name, {}).items():
        value = getattr(made, key)
        if not all(low <= part <= high for part in (value if isinstance(value, tuple) else (value,))):
            raise InputError(f"{where}: {name}.{key} is {value}; it must lie between {low:g} and {high:g}")


def _near(name: str, known: list[str]) -> str:
    near = difflib.get_close_matches(name, known, n=1)
    return f" (did you mean {near[0]!r}?)" if near else ""
