"""The plan of a batch: which captures, with which options, under which names, and what each will take."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_type_hints

from pydantic import TypeAdapter, ValidationError

from fieldfuse.errors import InputError, brief
from fieldfuse.pipelines.job import read_settings
from fieldfuse.pipelines.options import RUN, Options
from fieldfuse.pipelines.run import check
from fieldfuse.pipelines.source import picture_size

if TYPE_CHECKING:
    from fieldfuse.capture.types import Capture
    from fieldfuse.config import Settings

LIST = ".csv"
MOST_ROWS, LONGEST_NAME = 100_000, 120
RESERVED = {"batch.json", "batch.html", "logs"}
COLUMNS = tuple(name for name in RUN.split() if name not in ("quiet", "json"))
OTHER_NAMES = {"set": "pairs"}  # columns that are not called as the option's parameter
GIB = 2**30
# Measured (docs/cluster.md): libraries and kernels; a pixel of an image at the size of the fit with what is
# made of it, its share of a field that is as fine as the images are worth included; a pixel as it lies on disk, where it is decoded.
BASE, VIEW_BYTES, ORIGINAL_BYTES = 1.0 * GIB, 40, 60
SFM = 0.5 * GIB  # for structure from motion besides
# Rough seconds beside the fit where this machine was not measured yet (`--total-budget` measures it): whatever it is of, and for an image.
START, A_FRAME, A_FRAME_SFM = 15.0, 0.3, 1.5


@dataclass(frozen=True)
class Planned:
    """One run.

    Attributes:
        name: of its folder in --out. where: file and row of a list that it is from, "" without one. seconds: roughly what it takes.
        memory: bytes, roughly.
    """

    name: str
    source: Path
    options: Options
    where: str = ""
    seconds: float = 0.0
    memory: int = 0


def plan(sources: Sequence[Path], options: Options) -> list[Planned]:
    """The runs of the command line: of captures, or of the rows of a list.

    Raises:
        InputError: a list is empty or broken; a name or a source is there twice; options do not fit.
    """
    found: list[Planned] = []
    for source in sources:
        if source.suffix.lower() == LIST:
            found += read_list(source, options)
        else:
            if any(one.source.absolute() == source.absolute() and not one.where for one in found):
                raise InputError(f"{source} is given twice; give it once, or use a list (CSV) with a name for each run")
            found.append(Planned("", source, options))
    if twice := next((one for one in found if one.name and [other.name for other in found].count(one.name) > 1), None):
        raise InputError(f"{twice.where} has the name {twice.name!r}, which another list has, too; give one of them another name")
    for one in found:
        _check(one)
    return _named(found)


def _check(one: Planned) -> None:
    """Refuse options once, not by each run."""
    try:
        check(one.options)
        read_settings(one.options.settings())
    except InputError as error:
        raise InputError(f"{one.where}: {error}" if one.where else str(error)) from error


def _named(found: Sequence[Planned]) -> list[Planned]:
    """Every run with a folder of its own: the capture's name, with a number where another has it."""
    taken = {one.name for one in found if one.name} | RESERVED
    out = []
    for one in found:
        name = one.name
        if not name:
            plain = _plain_name(one.source)
            name = next(name for name in _numbered(plain) if name not in taken)
            taken.add(name)
        out.append(replace(one, name=name))
    return out


def _plain_name(source: Path) -> str:
    path = source.absolute()
    name = path.name if path.is_dir() or not path.suffix else path.stem
    return " ".join(name.split()).lstrip(".")[:LONGEST_NAME] or "capture"


def _numbered(name: str) -> Iterator[str]:
    yield name
    number = 2
    while True:
        yield f"{name}-{number}"
        number += 1


def read_list(path: Path, options: Options) -> list[Planned]:
    """The rows of a CSV file: a column `source`, if wanted `name`, and options of `run` as columns; what a row gives goes before the
    command line. Relative paths are relative to the file.

    Raises:
        InputError: naming the row.
    """
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = [(reader.line_num, row) for reader in [csv.reader(file, strict=True)] for row in reader if any(map(str.strip, row))]
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not UTF-8; save it as CSV in UTF-8") from error
    except csv.Error as error:
        raise InputError(f"{path} is not CSV ({error}); look for a quotation mark that is not closed") from error
    if not rows:
        raise InputError(f"{path} is empty; its first line must name the columns: source, and if wanted name and options of run")
    if len(rows) > MOST_ROWS:
        raise InputError(f"{path} has {len(rows):,} rows, and at most {MOST_ROWS:,} are read; split it")
    columns = [_column(cell, path) for cell in rows[0][1]]
    if "source" not in columns:
        raise InputError(f"{path} has no column source; its first line must name the columns ({brief(', '.join(columns))} are there)")
    if twice := next((name for name in columns if columns.count(name) > 1), None):
        raise InputError(f"{path} has the column {twice} twice; leave one of them out")
    if len(rows) == 1:
        raise InputError(f"{path} has no rows below its first line; add one for each capture")
    names: dict[str, int] = {}
    found = []
    for number, row in rows[1:]:
        where = f"{path}, row {number}"
        if len(row) > len(columns):
            raise InputError(f"{where} has {len(row)} cells and the first line names {len(columns)} columns; quote cells that hold commas")
        one = _row(dict(zip(columns, map(str.strip, row), strict=False)), where, path.parent, options)
        if one.name in names:
            raise InputError(f"{where} has the name {one.name!r} of row {names[one.name]}; give each row another one, or none")
        if one.name:
            names[one.name] = number
        found.append(one)
    return found


def _column(cell: str, path: Path) -> str:
    """The name of a column, as options have it."""
    name = cell.strip().lower().lstrip("-").replace("-", "_")
    name = OTHER_NAMES.get(name, name)
    if name not in ("source", "name", *COLUMNS):
        known = ", ".join(("source", "name", *("set" if one == "pairs" else one for one in COLUMNS)))
        raise InputError(f"{path} has a column {brief(cell.strip())!r}, which is no option of run; known are {known}")
    return name


def _row(cells: dict[str, str], where: str, folder: Path, options: Options) -> Planned:
    """One row's run."""
    if not cells.get("source"):
        raise InputError(f"{where} has no source; give the path of a capture")
    name = cells.get("name", "")
    if name and (name in RESERVED or name.startswith(".") or "/" in name or "\0" in name or len(name) > LONGEST_NAME):
        raise InputError(f"{where} has the name {brief(name)!r}, which cannot be that of a folder here; use letters, digits and hyphens")
    given: dict[str, Any] = {}
    kinds = get_type_hints(Options)
    for column, text in cells.items():
        if column in ("source", "name") or not text:
            continue
        if column == "pairs":
            given["pairs"] = [*(options.pairs or []), *(pair.strip() for pair in text.split(";") if pair.strip())]
            continue
        try:
            value = TypeAdapter(kinds[column]).validate_python(text)
        except ValidationError as error:
            reason = error.errors(include_url=False)[0]["msg"]
            shown = column.replace("_", "-")
            raise InputError(f"{where}: {shown} is {brief(text)!r}, which is not usable ({reason}); correct it") from error
        given[column] = folder / value if column == "config" else value
    return Planned(name, folder / cells["source"], replace(options, **given), where)


# ------------------------------------------------------------------------------------------------- what a run takes


def estimated(runs: Iterable[Planned], seconds: bool = False) -> list[Planned]:
    """Runs with their rough memory, and seconds if they are wanted, from what the headers of their captures say; a capture that cannot be
    read, whose run will say why, takes next to nothing."""
    from fieldfuse.capture.detect import read_source

    out = []
    for one in runs:
        settings = read_settings(one.options.settings())
        try:
            capture = read_source(one.source)
            size = run_memory(capture, settings)
            out.append(replace(one, memory=size, seconds=run_seconds(capture, settings, one.options.total_budget) if seconds else 0.0))
        except Exception:  # whatever is wrong with it, its own run says so
            out.append(replace(one, memory=int(BASE), seconds=START))
    return out


def run_memory(capture: Capture, settings: Settings) -> int:
    """Bytes that a run needs at most, roughly: what libraries take, all images at the size of the fit, one as it lies on disk."""
    width, height = (side or 640 for side in picture_size(capture))
    frames = settings.capture.max_frames if capture.filmed else len(capture.frames)
    shrunk = min(1.0, (settings.capture.image_size or 640) / max(width, height))
    posed = settings.poses.source == "given" or (settings.poses.source == "auto" and capture.posed)
    return int(BASE + VIEW_BYTES * frames * width * height * shrunk**2 + ORIGINAL_BYTES * width * height + (0 if posed else SFM))


def run_seconds(capture: Capture, settings: Settings, total: float | None) -> float:
    """Seconds of a run, roughly: by the model of `--total-budget`, where it has measured this machine, else by the number of images."""
    import psutil

    from fieldfuse.evaluation import budget as model
    from fieldfuse.pipelines.total_budget import work_of

    if total is not None:
        return total
    work, fit, export = work_of(capture, settings), float(settings.fit.budget or 60), settings.export
    speed = model.remembered(model.signature(settings.threads or psutil.cpu_count() or 1, settings.device))
    if speed is None:
        return fit + START + (A_FRAME if work.posed else A_FRAME_SFM) * work.frames
    choice = model.Choice(settings.capture.image_size or 640, mesh_size=export.mesh_size)
    parts = model.predict(speed, work, choice)
    parts["export"] = model.most_export_seconds(speed, work, choice, export.mesh_views, export.video_frames) if export.formats else 0.0
    return fit + sum(parts.values())
