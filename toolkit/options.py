"""What functions of the API take besides their arguments: settings by name, and who listens to progress."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from fieldfuse import steps
from fieldfuse.config import Settings, load_settings, settings_dict
from fieldfuse.errors import InputError
from fieldfuse.progress import SILENT, Bar, Callback, Progress

Listener = Progress | Callable[[str, float, float, str], "bool | None"] | bool | None
OF_FIT = ("field", "fit", "network", "keyframes", "engine", "device", "threads", "seed")  # settings that a scene does not depend on
OF_SURFACE = ("tsdf", "export")


def chosen_settings(options: Mapping[str, Any]) -> Settings:
    """Those of a preset, changed.

    Raises:
        InputError: there is no such setting, or its value does not fit.
    """
    given = flattened(options)
    preset = given.pop("preset", "balanced")
    return load_settings(preset, flags=given)


def flattened(options: Mapping[str, Any]) -> dict[str, Any]:
    """Keywords, and by their full names those in `settings`."""
    return {**(options.get("settings") or {}), **{name: value for name, value in options.items() if name != "settings"}}


def changed_settings(settings: Settings, options: Mapping[str, Any], allowed: tuple[str, ...]) -> Settings:
    """The settings of a scene with some changed that the scene itself does not depend on.

    Raises:
        InputError: a setting that decides the scene, or one that is not usable.
    """
    before = settings_dict(settings)
    made = load_settings(settings.preset, flags=flattened(options), stored=before)
    after = settings_dict(made)
    fixed = sorted(name for name in after if after[name] != before[name] and name not in allowed)
    if fixed:
        raise InputError(f"the settings {', '.join(fixed)} decide the scene; give them to load()")
    made.device = steps.choose_device(made.device, made.engine)
    return made


def listening(progress: Listener, stage: str) -> Progress:
    if isinstance(progress, Progress):
        return progress
    if progress is None or progress is False:
        return SILENT
    return Bar(stage) if progress is True else Callback(progress, stage)
