"""One way to measure: a plan, a run of each of its entries, a table of the rows.

`Experiment.conduct` runs the entries whose rows are not there yet. After each it writes OUT/NAME.json (command, machine, date, rows) and
OUT/NAME.md, so an interrupted benchmark goes on when its command is repeated.
"""

from __future__ import annotations

import re
import shlex
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import typer

from fieldfuse import __version__
from fieldfuse.errors import InputError, first_line
from fieldfuse.files import atomic_path, read_json, write_json
from fieldfuse.pipelines import cli
from fieldfuse.pipelines.console import ConsoleProgress
from fieldfuse.pipelines.folder import command_line

Row = dict[str, Any]
Folder = Annotated[
    Path | None, typer.Option("--out", "-o", help="Folder for the results; without it they are shown only.", show_default=False)
]
BEGIN, END = "<!-- measured: {} -->", "<!-- end of {} -->"
MEASURES = {"psnr": 2, "ssim": 3, "lpips": 3}  # digits


@dataclass(frozen=True)
class Experiment:
    """A benchmark.

    Attributes:
        name: of its module, whose function `table` makes Markdown of the file's content.
        plan: what is measured: an entry for each row, with the values that tell rows apart.
        run: entry → what was measured; a row is both.
        table: the file's content → Markdown.
        state: of settings and data. Rows of another state are measured again; None: all rows are, from runs that reuse their own stages.
        about: what else the file holds; `title` becomes a heading.
        file: the files' name without suffix; default: `name`.
        jobs: entries that are run at the same time.
    """

    name: str
    plan: Sequence[Row]
    run: Callable[[Row], Row]
    table: Callable[[Row], str]
    state: str | None = None
    about: Row = field(default_factory=dict)
    file: str = ""
    jobs: int = 1

    def conduct(self, out: Path | None, progress: ConsoleProgress, threads: int | None = None, device: str = "cpu") -> Row:
        """Run what is not there yet.

        Args:
            out: the folder of both files; None: nothing is written.

        Returns:
            what the JSON file holds: `experiment`, `version`, `command`, `machine`, `state`, `about`'s entries, `rows`.

        Raises:
            InputError: the file of an earlier call is damaged.
            Interrupted: the user asked to stop; rows that are finished are in the files.
        """
        from fieldfuse.evaluation.machine import machine

        began = time.monotonic()
        rows = self.earlier(out, progress)
        done = {self._key(row) for row in rows}
        todo = [entry for entry in self.plan if self._key(entry) not in done]
        about = machine(threads, device)
        data: Row = {"experiment": self.name, "version": __version__, "command": command_line(), "machine": about, "state": self.state}
        data |= {**self.about, "rows": rows}
        order = {self._key(entry): place for place, entry in enumerate(self.plan)}
        with progress.listening():
            progress.begin(self.name)
            for number, (entry, found) in enumerate(self._results(todo, progress), 1):
                rows.append({**entry, **found})
                rows.sort(key=lambda row: order.get(self._key(row), -1))
                self.write(out, data)
                progress.say(f"{', '.join(map(str, entry.values()))}: {_outcome(found)}")
                progress.update(number, len(todo), f"{number} of {len(todo)}")
            progress.finish(self.name, time.monotonic() - began, not todo)
        if not todo:
            self.write(out, data)
        return data

    def earlier(self, out: Path | None, progress: ConsoleProgress) -> list[Row]:
        """Rows that an earlier call with the same state left.

        Raises:
            InputError: its file is damaged.
        """
        path = None if out is None else out / f"{self.file or self.name}.json"
        if path is None or self.state is None or not path.is_file():
            return []
        data = read_json(path)
        checked(path, lambda: section(data, self.table))
        if data.get("state") != self.state:
            progress.say(f"the rows in {path} are of other settings or of another state of the data, and are measured again")
            return []
        return list(data["rows"])

    def write(self, out: Path | None, data: Row) -> None:
        """Both files, with the rows that there are."""
        if out is not None:
            write_json(out / f"{self.file or self.name}.json", data)
            with atomic_path(out / f"{self.file or self.name}.md") as temporary:
                temporary.write_text(section(data, self.table), encoding="utf-8")

    def _key(self, row: Row) -> str:
        names = self.plan[0] if self.plan else ()
        return repr([row.get(name) for name in names])

    def _results(self, todo: list[Row], progress: ConsoleProgress) -> Iterator[tuple[Row, Row]]:
        """Entries with what was measured, in the order in which they are finished."""
        if self.jobs == 1:
            for entry in todo:
                progress.check()
                yield entry, self.run(entry)
            return
        pool = ThreadPoolExecutor(self.jobs)
        waiting = {pool.submit(self.run, entry): entry for entry in todo}
        try:
            while waiting:
                progress.check()
                for future in wait(waiting, timeout=0.2, return_when=FIRST_COMPLETED).done:
                    yield waiting.pop(future), future.result()
        except BaseException:
            progress.request_stop()  # so that the others end what they run
            raise
        finally:
            pool.shutdown(cancel_futures=True)


def _outcome(found: Row) -> str:
    """A row in a few words."""
    if found.get("error"):
        return str(found["error"])
    return "done" if found.get("psnr") is None else f"{found['psnr']:.2f} dB"


# --------------------------------------------------------------------------------------------------------------------- the command line


def application(command: Callable[..., None]) -> typer.Typer:
    """The command line of a benchmark."""
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)
    app.command()(command)
    return app


def program(app: typer.Typer) -> None:
    """Run it as `fieldfuse` runs its commands: an error is one sentence, and an exit code."""
    cli.program(app)


def show(text: str, quiet: bool) -> None:
    """A table on standard output."""
    if not quiet:
        sys.stdout.write(text.rstrip() + "\n")


def chosen(text: str | None, known: Iterable[str], option: str) -> list[str]:
    """`a, b` → its parts, all of `known`; None: all of them.

    Raises:
        InputError: one is not known.
    """
    known = list(known)
    if text is None:
        return known
    parts = [part.strip() for part in text.split(",") if part.strip()]
    for part in parts:
        if part not in known:
            raise InputError(f"{option} {text!r}: there is no {part!r}; known are {', '.join(known)}")
    return list(dict.fromkeys(parts))


def numbers(text: str, option: str) -> list[float]:
    """`30,120` → its numbers.

    Raises:
        InputError: something is not a positive number.
    """
    try:
        values = [float(part) for part in text.split(",") if part.strip()]
    except ValueError as error:
        raise InputError(f"{option} {text!r} must be numbers separated by commas") from error
    if not values or any(not 0 < value < 1e6 for value in values):
        raise InputError(f"{option} {text!r} must be positive numbers")
    return values


# --------------------------------------------------------------------------------------------------------------------- Markdown


def markdown(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """A table; what would end a cell is replaced."""
    lines = [head, ["---"] * len(head), *rows]
    return "".join("| " + " | ".join(str(cell).replace("|", "/") for cell in cells) + " |\n" for cells in lines)


def section(data: Row, table: Callable[[Row], str]) -> str:
    """Heading, machine and command of a file's content, and its table."""
    title = [f"### {data['title']}", ""] if data.get("title") else []
    return "\n".join([*title, machine_line(data["machine"]), "", f"    {data['command']}", "", table(data).rstrip(), ""])


def checked(path: Path, make: Callable[[], str]) -> str:
    """The text that is made of the content of `path`.

    Raises:
        InputError: it is not what a benchmark writes.
    """
    try:
        return make()
    except (LookupError, TypeError, AttributeError, ValueError, ArithmeticError) as error:
        raise InputError(
            f"{path} holds no results of a benchmark, a comparison or a trade-off ({first_line(error)}); remove it, or give another file"
        ) from error


def machine_line(machine: Row) -> str:
    """The machine in a sentence."""
    load = machine.get("load")
    busy = "" if load is None else f", load {load:.1f} (where it is above the cores, times are upper bounds)"
    return (
        f"Measured {machine.get('measured', '')} on a machine of {machine.get('cores')} cores, threads: {machine.get('threads')},"
        f" device: {machine.get('device', 'cpu')}{busy}:"
    )


def portable(command: str, data: Path | None) -> str:
    """A command without this machine's places: what lies in the folder `data` becomes DATA/…, other absolute paths their last part."""
    words = shlex.split(command)
    for index, word in enumerate(words):
        if data is not None and Path(word).is_absolute() and Path(word).is_relative_to(data):
            words[index] = (Path("DATA") / Path(word).relative_to(data)).as_posix()
        elif Path(word).is_absolute():
            before = words[index - 1] if index else ""
            words[index] = f"runs/{Path(word).name}" if before in ("--out", "-o") else Path(word).name
    return shlex.join(words)


def put_between_marks(page: Path, name: str, text: str) -> None:
    """Replace what stands between the marks of `name` in a Markdown page by `text`; marks that are not there are added at its end.

    Raises:
        InputError: the page cannot be read, or one of its marks is missing.
    """
    if not re.fullmatch(r"[\w .-]+", name):
        raise InputError(f"{name!r} cannot be the name of a table; use letters, digits, dots and dashes")
    begin, end = BEGIN.format(name), END.format(name)
    try:
        old = page.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not text in UTF-8"
        raise InputError(f"cannot read the page {page} ({reason}); give a Markdown file") from error
    block = f"{begin}\n{text.strip()}\n{end}"
    if (begin in old) != (end in old) or old.count(begin) > 1 or old.count(end) > 1:
        raise InputError(f"{page} must hold both marks of {name!r} once, or neither: {begin} and {end}")
    if begin in old:
        before, rest = old.split(begin, 1)
        new = before + block + rest.split(end, 1)[1]
    else:
        new = old.rstrip("\n") + f"\n\n{block}\n"
    with atomic_path(page) as temporary:
        temporary.write_text(new, encoding="utf-8")
