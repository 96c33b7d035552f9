"""One run of a batch, as a worker makes it: `fieldfuse run …` in a process of its own, listened to by what it writes."""

from __future__ import annotations

import io
import os
import re
import tarfile
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from fieldfuse.errors import FieldfuseError, InputError, OutputError, first_line
from fieldfuse.files import read_json, remove
from fieldfuse.poses import child
from fieldfuse.progress import Progress

# As `python -m fieldfuse run`, but it ends with the worker: else the next attempt would find its folder locked. And it hears Ctrl-C, which
# Ray keeps from its workers and so from their children.
RUN = (
    "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT]); "
    "from fieldfuse.poses.child import die_with_parent; die_with_parent(); from fieldfuse.pipelines.cli import program; program()"
)
MARK = "fieldfuse: "  # what the one sentence of an error begins with
STOPPED = 130
SCORES = ("psnr", "ssim", "lpips")
# "field 43%, 0:12 left, 32³, 24.3 dB"; "views: 1.2 s"
AT_WORK = re.compile(r"^(?P<stage>[a-z_-]+)(?: (?P<share>\d+)%)?(?:, (?P<left>[\d:]+) left)?(?:, (?P<note>.*))?$")
ENDED = re.compile(r"^(?P<stage>[a-z_-]+): (?:reused|[\d.]+ s)$")


@dataclass(frozen=True)
class Upload:
    """Files that travel with a task, where workers do not share storage: the capture, and what an earlier run left.

    Attributes:
        source, folder: tar archives; `folder` is None where there is none.
    """

    source: bytes
    folder: bytes | None = None


@dataclass(frozen=True)
class RunSpec:
    """What a worker is to run.

    Attributes:
        words: options of `fieldfuse run`. log: file for all that the run writes. timeout: seconds; inf: none.
        upload: None where workers see `source` and `out`.
    """

    source: str
    out: str
    words: tuple[str, ...]
    log: str
    timeout: float
    upload: Upload | None = None


def execute(spec: RunSpec, link: Progress) -> dict[str, Any]:
    """Make the run.

    Returns:
        `code` (of the process), `error` (a sentence or None), `seconds`, of a finished run `facts`; `folder`, if the spec had an upload: an
        archive of what was made.

    Raises:
        OutputError: the log cannot be written.
    """
    if spec.upload is None:
        return _run(spec, link)
    with tempfile.TemporaryDirectory(prefix="fieldfuse-") as scratch:
        place = Path(scratch)
        source, out, log = place / "capture" / Path(spec.source).name, place / "runs" / Path(spec.out).name, place / "run.log"
        unpack(spec.upload.source, source.parent)
        if spec.upload.folder is not None:
            unpack(spec.upload.folder, out.parent)
        found = _run(replace(spec, source=str(source), out=str(out), log=str(log)), link)
        return {**found, "folder": pack(out) if out.is_dir() else None}


def _run(spec: RunSpec, link: Progress) -> dict[str, Any]:
    log, began = Path(spec.log), time.monotonic()
    reader = LogReader(log, link)
    command = ["-c", RUN, "run", spec.source, "--out", spec.out, *spec.words]
    try:
        log.parent.mkdir(parents=True, exist_ok=True)
        code = child.run_logged(command, log, reader.listen, spec.timeout, child.import_path(), link.stopping)
    except TimeoutError as error:
        return {"code": None, "error": f"{error}; give --timeout more, or a smaller --budget", "seconds": time.monotonic() - began}
    except OSError as error:
        raise OutputError(f"cannot write {log}: {error.strerror or error}; free space or choose another --out") from error
    found: dict[str, Any] = {"code": code, "error": None, "seconds": round(time.monotonic() - began, 3)}
    if code == 0:
        try:
            found["facts"] = facts(Path(spec.out))
            remove(log)
        except (FieldfuseError, LookupError, TypeError, AttributeError) as error:
            found["error"] = f"its report cannot be read ({first_line(error)})"
    elif code != STOPPED:
        said = child.log_tail(log)
        ended = f"its process {child.end_reason(code)}; it last wrote: {said}"
        found["error"] = said.removeprefix(MARK) if said.startswith(MARK) else ended
    return found


class LogReader:
    """Reads what a run has written to its log since the last look, and passes on how far it is."""

    def __init__(self, log: Path, link: Progress) -> None:
        self._log, self._link, self._read, self._rest = log, link, 0, ""

    def listen(self, seconds: float) -> None:
        """Called again and again while the run is at work."""
        try:
            with self._log.open("rb") as file:
                file.seek(self._read)
                new = file.read()
        except OSError:
            return
        if not new:
            return
        self._read += len(new)
        *lines, self._rest = (self._rest + new.decode(errors="replace")).split("\n")
        for line in reversed(lines):
            if (found := parse_progress(line)) is not None:
                self._link.report(found)  # type: ignore[attr-defined]
                return


def parse_progress(line: str) -> dict[str, Any] | None:
    """What a line of a run's progress says: `stage`, `share` (percent), `left`, `psnr`, each None where it says nothing of it."""
    if (ended := ENDED.match(line)) is not None:
        return {"stage": ended["stage"], "share": 100, "left": None, "psnr": None}
    at = AT_WORK.match(line)
    if at is None or (at["share"] is None and at["note"] is None):
        return None
    score = re.search(r"([\d.]+) dB", at["note"] or "")
    share = None if at["share"] is None else int(at["share"])
    return {"stage": at["stage"], "share": share, "left": at["left"], "psnr": None if score is None else float(score[1])}


def facts(folder: Path) -> dict[str, Any]:
    """Of a finished run's report: scores, warnings, seconds, and whether a stage was stopped early.

    Raises:
        FieldfuseError, LookupError, TypeError, AttributeError: it is damaged.
    """
    report = read_json(folder / "report.json")
    field, nearest = report["evaluation"]["field"] or {}, report["evaluation"]["nearest_image"] or {}
    records = [read_json(path) for path in sorted((folder / "stages").glob("*.json"))]
    return {
        **{name: field.get(name) for name in SCORES},
        "nearest_image": nearest.get("psnr"),
        "frames": report["capture"]["frames"],
        "seconds_total": report["seconds_total"],
        "warnings": [str(warning) for warning in report["warnings"]],
        "stopped": any(record.get("stopped") for record in records),
    }


def pack(path: Path) -> bytes:
    """A file or folder as a tar archive with names from its own on; times are kept, by which a run knows its capture again."""
    data = io.BytesIO()
    with tarfile.open(fileobj=data, mode="w", dereference=True) as archive:
        archive.add(path, arcname=path.name, filter=lambda entry: None if Path(entry.name).name == ".lock" else entry)
    return data.getvalue()


def unpack(data: bytes, folder: Path) -> None:
    """Write what `pack` packed into a folder.

    Raises:
        InputError: an entry leads outside it.
        OutputError: it cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tarfile.open(fileobj=io.BytesIO(data)) as archive:
            archive.extractall(folder, filter="data")
    except tarfile.TarError as error:
        raise InputError(f"what was sent for {folder} cannot be unpacked ({first_line(error)}); use storage that workers share") from error
    except OSError as error:
        raise OutputError(f"cannot write in {folder}: {error.strerror or os.strerror(error.errno or 0)}; free space there") from error
