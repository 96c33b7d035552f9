"""What every stage of a run is given, and the surroundings that are set once: threads, device, settings."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from fieldfuse.config import Settings, load_settings
from fieldfuse.errors import InputError
from fieldfuse.pipelines.console import ConsoleProgress
from fieldfuse.pipelines.folder import RunFolder, is_run_folder
from fieldfuse.pipelines.options import THREAD_VARIABLES, Place
from fieldfuse.pipelines.stages import Stage, Stages
from fieldfuse.steps import choose_device

T = TypeVar("T")
CAMERAS = "transforms.json"
MOST_A_CORE, LEAST_MOST_THREADS = 4, 64  # more threads than these only wait for each other


@dataclass
class Job:
    """One command at work on one folder.

    Attributes:
        again: it works on what an earlier command left in the folder, and not on a source.
        changed: results ("field", "network") whose settings are not those of the earlier command.
    """

    folder: RunFolder
    source: Path
    settings: Settings
    progress: ConsoleProgress
    stages: Stages
    again: bool = False
    changed: frozenset[str] = frozenset()

    def run(self, stage: Stage[T]) -> T:
        """The result of a stage; see `Stages.run`."""
        return self.stages.run(stage)


@contextmanager
def open_job(place: Place, options: dict[str, Any], progress: ConsoleProgress, trusted: Iterable[str] = ()) -> Iterator[Job]:
    """The job for a source (with `place.out`), or in the folder of an earlier run whose settings are taken over.

    Args:
        options: `preset`, `config`, `pairs` and `flags` as the command line gives them.
        trusted: stages that are used as they are in a run's folder.

    Raises:
        InputError: neither a source with `out` nor a run's folder; settings that do not fit.
        OutputError: the folder cannot be used.
    """
    target, out = place.target, place.out
    if out is None:
        if not is_run_folder(target):
            raise InputError(
                f"{target} is not the folder of an earlier run; to work on it as a source add --out DIR"
                if target.exists()
                else f"{target} does not exist; give a video, a folder of pictures, or the folder of an earlier run"
            )
        with RunFolder(target) as folder, progress.listening():
            about = folder.about()
            settings = _prepared(read_settings(options, about["settings"]))
            source, before = Path(about["source"]), read_settings({}, about["settings"])
            folder.start(source, settings)
            yield Job(folder, source, settings, progress, Stages(folder, progress, trusted), True, changed_results(settings, before))
        return
    check_places(target, out)
    settings, source = _prepared(read_settings(options)), target.absolute()
    with RunFolder(out) as folder, progress.listening():
        _check_same_source(folder, source)
        folder.start(source, settings)
        yield Job(folder, source, settings, progress, Stages(folder, progress))


def changed_results(new: Settings, old: Settings) -> frozenset[str]:
    """Of "field" (the fitted one) and "network" those that the new settings would make otherwise."""
    same = {
        "field": new.field == old.field and new.fit.finetune == old.fit.finetune,
        "network": new.network == old.network and new.field.background == old.field.background,
    }
    return frozenset(name for name in same if not same[name])


def _prepared(settings: Settings) -> Settings:
    set_threads(settings.threads)
    settings.device = choose_device(settings.device, settings.engine)
    _require_cells(settings)
    return settings


def _require_cells(settings: Settings) -> None:
    """Refuse what cells cannot do, if there are to be any.

    Raises:
        InputError: another device, engine or decoder than that of a fit on the CPU; a cluster, and no cells.
    """
    if settings.fit.cells == "off":
        if settings.address is not None:
            raise InputError("--address is for a fit in cells; add --cells, or leave --address out")
        return
    if settings.device != "cpu" or settings.engine not in ("auto", "numba"):
        raise InputError("cells are fitted by the compiled engine of the CPU; add --device cpu, or leave --cells and --engine out")
    if settings.field.decoder != "deferred":
        raise InputError("cells are fitted with the deferred decoder; leave --decoder at deferred, or --cells out")
    if not settings.fit.finetune:
        raise InputError("cells are for a fit, and there is none with --no-finetune; leave one of the two out")


def check_places(source: Path, out: Path) -> None:
    """A run must not write among its own input, and a run's folder is no capture, but where cameras were put there for its frames
    (docs/conventions.md).

    Raises:
        InputError: the source does not exist, is the out folder, or the folder of a run.
    """
    if is_run_folder(source) and not (source / CAMERAS).is_file():
        try:
            of = RunFolder(source).about()["source"]
        except InputError:
            of = "a capture that it no longer names"
        raise InputError(f"{source} is the folder of a run (of {of}); leave --out away to work on it, or give its capture")
    if not source.exists():
        raise InputError(f"{source} does not exist; give a video, a folder of pictures, or a capture folder")
    if source.resolve() == out.resolve():
        raise InputError(f"--out {out} is the source itself; choose another folder, so that nothing of the capture is changed")


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
    if before.exists():
        raise InputError(f"{folder.path} holds the run of {before}; choose another --out folder for {source}, or remove that one first")
    from fieldfuse.pipelines.source import relocate, same_capture

    if not same_capture(folder, source):
        raise InputError(
            f"{folder.path} holds the run of {before}, which is not there any more, and the files of {source} are not the same (by names, "
            "sizes and times: move it, or copy it with its times); choose another --out folder, or remove that one first"
        )
    relocate(folder, before, source)


def read_settings(options: dict[str, Any], stored: dict[str, Any] | None = None) -> Settings:
    """Settings of the command line over those of an earlier run (`stored`) or over a preset's.

    Raises:
        InputError: they do not fit, or there are more threads than make sense here.
    """
    pairs = options.get("pairs") or []
    if options.get("preset") is not None or any(pair.startswith("preset=") for pair in pairs):
        stored = None  # a preset is a new start: the stored settings would hide what it sets
    preset = options.get("preset") or (stored or {}).get("preset") or "balanced"
    settings = load_settings(preset, options.get("config"), pairs, options.get("flags"), stored)
    most = max(LEAST_MOST_THREADS, MOST_A_CORE * (os.cpu_count() or 1))
    if settings.threads is not None and settings.threads > most:
        raise InputError(f"threads is {settings.threads}, and this machine has {os.cpu_count()} cores; give at most {most}")
    return settings


def set_threads(threads: int | None) -> None:
    """Bound the threads of every library, also of those that are loaded already."""
    if threads is None:
        return
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, str(threads)))
    import cv2
    import torch

    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)
