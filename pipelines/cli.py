"""`fieldfuse`: gathers the commands, one thin file each, and turns errors into one sentence and an exit code.

Exit codes: 0 done; 1 something unexpected, with a log file; 2 bad input, settings or flags; 130 stopped by the user.
"""

from __future__ import annotations

import inspect
import os
import signal
import sys
import traceback
from contextlib import suppress
from typing import Annotated

import typer

from fieldfuse import __version__
from fieldfuse.errors import FieldfuseError, Interrupted
from fieldfuse.pipelines.bake import bake
from fieldfuse.pipelines.batch import batch
from fieldfuse.pipelines.compare import compare
from fieldfuse.pipelines.doctor import doctor
from fieldfuse.pipelines.evaluate import evaluate
from fieldfuse.pipelines.export import export
from fieldfuse.pipelines.finetune import finetune
from fieldfuse.pipelines.info import info
from fieldfuse.pipelines.poses import poses
from fieldfuse.pipelines.render import render
from fieldfuse.pipelines.run import run
from fieldfuse.pipelines.simulate import simulate
from fieldfuse.pipelines.tradeoff import tradeoff
from fieldfuse.pipelines.train import train
from fieldfuse.pipelines.tsdf import tsdf
from fieldfuse.pipelines.view import view

STOPPED = 130

app = typer.Typer(
    name="fieldfuse",
    help="From a video, photos or an RGB-D capture to a radiance field on sparse voxels, and a TSDF surface beside it.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"fieldfuse {__version__}")
        raise typer.Exit()


@app.callback()
def _all(version: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")] = False) -> None:
    pass


for _command in (doctor, run, batch, poses, tsdf, finetune, render, view, export, bake, evaluate, compare, tradeoff, info, train, simulate):
    # In the list of commands their first sentences are wrapped like this, and cut off otherwise.
    app.command(short_help=" ".join((inspect.getdoc(_command) or "").partition("\n\n")[0].split()))(_command)


def main(commands: typer.Typer = app) -> None:
    """Entry point of the command line."""
    try:
        commands()
    except Interrupted as error:
        _fail(f"{error}", STOPPED)
    except FieldfuseError as error:
        _fail(f"{error}", 2, error)
    except KeyboardInterrupt:
        _fail("stopped", STOPPED)
    except MemoryError as error:
        _fail("there is not enough memory for this; use a smaller --image-size", 1, error)
    except Exception as error:  # whatever it is, a user gets a sentence and a log
        log = getattr(error, "fieldfuse_log", None)
        place = f"the details are in {log}" if log else "set FIELDFUSE_DEBUG=1 to see the details"
        _fail(f"something unexpected went wrong ({type(error).__name__}); {place}", 1, error)


def program(commands: typer.Typer = app) -> None:
    """The command line as a process of its own: while it ends, one more Ctrl-C changes nothing."""
    stopped = True
    try:
        with suppress(KeyboardInterrupt):  # it came when `main` was ending already
            main(commands)
            stopped = False
    except SystemExit as end:
        stopped = end.code == STOPPED
        if not stopped:
            raise
    finally:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
    if stopped:
        # If the signal came while code was made from text (every dataclass is), CPython ends `python -m` by it, unless other text is
        # evaluated afterwards.
        eval("0")  # noqa: S307
        sys.exit(STOPPED)


def _fail(text: str, code: int, error: BaseException | None = None) -> None:
    if error is not None and os.environ.get("FIELDFUSE_DEBUG") == "1":
        traceback.print_exception(error)
    sys.stderr.write("fieldfuse: " + " ".join(text.split()) + "\n")
    sys.exit(code)


if __name__ == "__main__":
    program()
