"""What every stage of a run is given, and the surroundings that are set once: threads, device, seeds."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fieldfuse.config import Settings, load_settings
from fieldfuse.errors import InputError
from fieldfuse.pipelines.console import ConsoleProgress
from fieldfuse.pipelines.folder import RunFolder, is_run_folder
from fieldfuse.pipelines.stages import Stages
from fieldfuse.pipelines.thread_limits import THREAD_VARIABLES
from fieldfuse.steps import choose_device

if TYPE_CHECKING:
    from fieldfuse.effects.correct import Corrections
    from fieldfuse.nerfusion.keyframes import KeyFrames
    from fieldfuse.pipelines.steps_network import NetworkField
    from fieldfuse.pipelines.total_budget import TotalBudget
    from fieldfuse.poses.points import Features

CAMERAS = "transforms.json"
MOST_A_CORE, LEAST_MOST_THREADS = 4, 64  # threads that may be asked for: more of them only wait for each other


@dataclass
class Job:
    """One command at work on one folder."""

    folder: RunFolder
    source: Path
    settings: Settings
    progress: ConsoleProgress
    stages: Stages
    again: bool = False  # it works on what an earlier command left there, and not on a source
    other_field: bool = False  # the settings of the field differ from those that the folder was made with
    other_network: bool = False  # the same of the networks' field
    keys: KeyFrames | None = None  # the key frames, once chosen
    corrections: Corrections | None = None  # of effects, once found
    network: NetworkField | None = None  # the networks' field, once this command has made or loaded it
    features: dict[str, Features] = field(default_factory=dict)  # of images by name, once this command has looked for them
    formats: list[str] | None = None  # to be exported this time, whatever the settings say
    alone: bool = False  # exports are all that was asked for
    plan: TotalBudget | None = None  # chooses settings as the run goes on, so that it takes as long as was asked for


@contextmanager
def open_job(
    target: Path,
    out: Path | None,
    options: dict[str, Any],
    progress: ConsoleProgress,
    trusted: Iterable[str] = (),
) -> Iterator[Job]:
    """The job for `target`: a source (with `out`), or the folder of an earlier run whose settings are taken over.

    Args:
        options: `preset`, `config`, `pairs` and `flags` as the command line gives them.
        trusted: stages that are used as they are when `target` is a run's folder.

    Raises:
        InputError: neither a source with `out` nor a run's folder; settings that do not fit.
        OutputError: the folder cannot be used.
    """
    _check_no_run(target, out)
    again = out is None and is_run_folder(target)
    if out is None and not again:
        raise InputError(_no_out(target))
    path = target if out is None else out
    if not again:
        check_places(target, path)
        settings = read_settings(options)
        set_threads(settings.threads)
        settings.device = choose_device(settings.device, settings.engine)
    with RunFolder(path) as folder, progress.listening():
        source = target.absolute()
        other = other_network = False
        if again:
            about = folder.about()
            source = Path(about["source"])
            settings = read_settings(options, about["settings"])
            set_threads(settings.threads)
            settings.device = choose_device(settings.device, settings.engine)
            before = read_settings({}, about["settings"])
            other = settings.field != before.field or settings.fit.finetune != before.fit.finetune
            other_network = settings.network != before.network or settings.field.background != before.field.background
        else:
            _check_same_source(folder, source)
        folder.start(source, settings)
        yield Job(folder, source, settings, progress, Stages(folder, progress, trusted if again else ()), again, other, other_network)


def _check_no_run(target: Path, out: Path | None) -> None:
    """A run's folder is no capture, but where it has cameras that were put there for its frames (docs/conventions.md).

    Raises:
        InputError: a run's folder where a source is wanted.
    """
    if out is None or not is_run_folder(target) or (target / CAMERAS).is_file():
        return
    try:
        source = RunFolder(target).about()["source"]
    except InputError:
        source = "a capture that it no longer names"
    raise InputError(f"{target} is the folder of a run (of {source}); leave --out away to work on it, or give its capture")


def _check_same_source(folder: RunFolder, source: Path) -> None:
    """What another capture's run took long to make is not replaced because of a folder's name. A capture that was moved is the same one.

    Raises:
        InputError: the folder holds a run of another source.
    """
    if not is_run_folder(folder.path):
        return
    try:
        before = Path(folder.about()["source"])
    except InputError:
        return  # damaged, and now written again
    if before.resolve() == source.resolve():
        return
    if not before.exists():
        from fieldfuse.pipelines.moved import follow, same_capture

        if same_capture(folder, source):
            follow(folder, before, source)
            return
        raise InputError(
            f"{folder.path} holds the run of {before}, which is not there any more, and the files of {source} are not the same (by names, "
            "sizes and times: move it, or copy it with its times); choose another --out folder, or remove that one first"
        )
    raise InputError(f"{folder.path} holds the run of {before}; choose another --out folder for {source}, or remove that one first")


def _no_out(target: Path) -> str:
    if not target.exists():
        return f"{target} does not exist; give a video, a folder of pictures, or the folder of an earlier run"
    return f"{target} is not the folder of an earlier run; to work on it as a source add --out DIR"


def check_places(source: Path, out: Path) -> None:
    """A run must not write among its own input.

    Raises:
        InputError: the source does not exist, or it is the out folder.
    """
    if not source.exists():
        raise InputError(f"{source} does not exist; give a video, a folder of pictures, or a capture folder")
    if source.resolve() == out.resolve():
        raise InputError(f"--out {out} is the source itself; choose another folder, so that nothing of the capture is changed")


def read_settings(options: dict[str, Any], stored: dict[str, Any] | None = None) -> Settings:
    """Settings of the command line over those of an earlier run (`stored`) or over a preset's.

    Raises:
        InputError: they do not fit, or more threads are asked for than make sense here.
    """
    pairs = options.get("pairs") or []
    settings = _read_settings(options, stored, pairs)
    most = max(LEAST_MOST_THREADS, MOST_A_CORE * (os.cpu_count() or 1))
    if settings.threads is not None and settings.threads > most:
        raise InputError(f"threads is {settings.threads}, and this machine has {os.cpu_count()} cores; give at most {most}")
    return settings


def _read_settings(options: dict[str, Any], stored: dict[str, Any] | None, pairs: list[str]) -> Settings:
    if options.get("preset") is not None or any(pair.startswith("preset=") for pair in pairs):
        stored = None  # a preset is a new start: the stored settings would hide what it sets
    preset = options.get("preset") or (stored or {}).get("preset") or "balanced"
    return load_settings(preset, options.get("config"), pairs, options.get("flags"), stored)


def set_threads(threads: int | None) -> None:
    """Bound the threads of every library, also of those that are loaded already."""
    if threads is not None:
        os.environ.update(dict.fromkeys(THREAD_VARIABLES, str(threads)))
    import cv2
    import torch

    if threads is not None:
        torch.set_num_threads(threads)
        cv2.setNumThreads(threads)
