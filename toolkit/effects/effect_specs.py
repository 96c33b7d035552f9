"""Which effects a capture has: a list by name and strength, or with parameters; what is not listed is None and is never called."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from fieldfuse.config import checked, nearest
from fieldfuse.effects import models, scenery
from fieldfuse.errors import InputError, brief

STRENGTHS = ("weak", "medium", "strong")
PRESETS: dict[str, tuple[Any, Any, Any]] = {  # of each effect by name, weak to strong
    "distortion": (
        models.Distortion(-0.04, 0.01),
        models.Distortion(-0.12, 0.03, 0.0008, -0.0006),
        models.Distortion(-0.28, 0.09, 0.002, -0.0015),
    ),
    "exposure": (models.Exposure(0.12, 0.03), models.Exposure(0.35, 0.08), models.Exposure(0.8, 0.2)),
    "vignetting": (models.Vignetting(0.85), models.Vignetting(0.62), models.Vignetting(0.35)),
    "passers": (scenery.Pedestrians(0.2), scenery.Pedestrians(0.4), scenery.Pedestrians(0.8)),
    "highlights": (scenery.Highlights(0.4, 0.05), scenery.Highlights(1.0, 0.12), scenery.Highlights(2.0, 0.3)),
    "background": (scenery.Background(0.2), scenery.Background(0.6), scenery.Background(1.0)),
    "rolling_shutter": (models.RollingShutter(0.008), models.RollingShutter(0.018), models.RollingShutter(0.033)),
    "motion_blur": (models.MotionBlur(0.012, 5), models.MotionBlur(0.03, 9), models.MotionBlur(0.07, 15)),
    "sensor_noise": (models.SensorNoise(6000.0, 3.0), models.SensorNoise(1500.0, 6.0), models.SensorNoise(350.0, 8.0)),
    "depth_offset": (
        models.DepthOffset(0.01, 0.0, 0.002, 0.1, 0.2, -0.1),
        models.DepthOffset(),
        models.DepthOffset(-0.06, 0.01, 0.01, -0.8, 1.2, 1.0),
    ),
    "depth_noise": (
        models.DepthNoise(0.0006, 0.0007, 1, 0.3, 0.03, 0.5, 0.4),
        models.DepthNoise(),
        models.DepthNoise(0.005, 0.006, 3, 0.9, 0.1, 1.0, 1.0, 0.3, 6.0, 5),
    ),
    "compression": (models.Compression(85), models.Compression(55), models.Compression(22)),
}


@dataclass(frozen=True)
class Effects:
    """The effects of a capture, in the order in which light meets them; None: not there."""

    passers: scenery.Pedestrians | None = None
    background: scenery.Background | None = None
    highlights: scenery.Highlights | None = None
    distortion: models.Distortion | None = None
    rolling_shutter: models.RollingShutter | None = None
    motion_blur: models.MotionBlur | None = None
    vignetting: models.Vignetting | None = None
    exposure: models.Exposure | None = None
    sensor_noise: models.SensorNoise | None = None
    compression: models.Compression | None = None
    depth_offset: models.DepthOffset | None = None
    depth_noise: models.DepthNoise | None = None

    def names(self) -> tuple[str, ...]:
        """The effects that are there."""
        return tuple(entry.name for entry in fields(self) if getattr(self, entry.name) is not None)

    def describe(self) -> dict[str, dict[str, Any]]:
        """Parameters of the effects that are there, as plain data."""
        return {name: asdict(getattr(self, name)) for name in self.names()}


def preset(effect: str, strength: str) -> Any:
    """The parameters of an effect at one of the `STRENGTHS`."""
    return PRESETS[effect][STRENGTHS.index(strength)]


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
        if name not in PRESETS:
            raise InputError(f"{where}: there is no effect {name!r}{nearest(name, PRESETS)}; known are {', '.join(PRESETS)}")
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
        raise InputError(f"{where}: effects must be a list of names, not {brief(repr(listing))}")
    out: list[tuple[str, Any]] = []
    for entry in listing:
        if isinstance(entry, Mapping):
            out += _pairs(entry, where)
        else:
            name, _, strength = str(entry).partition(":")
            out.append((name.strip(), strength.strip() or None))
    return out


def _parameters(name: str, wanted: Any, where: str) -> Any:
    if wanted is None or wanted is True:
        return preset(name, "medium")
    if isinstance(wanted, str):
        if wanted not in STRENGTHS:
            raise InputError(f"{where}: {wanted!r} is no strength of {name}{nearest(wanted, STRENGTHS)}; use {', '.join(STRENGTHS)}")
        return preset(name, wanted)
    if not isinstance(wanted, Mapping):
        raise InputError(f"{where}: {name} takes a strength or parameters, not {brief(repr(wanted))}")
    values = dict(wanted)
    # For highlights `strength` is a parameter too; a word is one of the three strengths, a number that parameter.
    word = values.pop("strength", None) if not isinstance(values.get("strength"), int | float) else None
    base = _parameters(name, word, where)
    return checked(type(base), {**asdict(base), **values}, f"{where}: {name}")
