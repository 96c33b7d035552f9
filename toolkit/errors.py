"""Errors that a user can act on. Each message is one sentence: what is wrong, where, and what to do about it."""

from __future__ import annotations

import re

# Messages quote names of files and values of foreign files, which may hold anything: line ends, codes that move a terminal's cursor,
# and halves of characters, which no terminal or report can write.
_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]+")
_HALVES = re.compile(r"[\ud800-\udfff]")
LONGEST = 200  # characters of what others say that are quoted


def first_line(error: BaseException) -> str:
    """What another library's exception says, without what follows its first line that is not empty; its kind where it says nothing.

    Such messages may quote a whole damaged file: they end after `LONGEST` characters. Of what the system reports the number and the path
    are left out, since our sentences name the path.
    """
    said = str(error.strerror or error) if isinstance(error, OSError) else str(error)
    return brief(next((line.strip() for line in said.splitlines() if line.strip()), type(error).__name__))


def all_lines(error: BaseException) -> str:
    """The same of all lines in one, for libraries whose first line says nothing (torch's of weights that do not fit)."""
    return brief(" ".join(str(error).split()) or type(error).__name__)


def brief(text: str) -> str:
    """What a foreign file says, to be quoted: its first `LONGEST` characters."""
    return text if len(text) <= LONGEST else f"{text[:LONGEST]} …"


class FieldfuseError(Exception):
    """Something that stops the job and has a reason that a user can act on (the command line exits with code 2).

    Its message is one line that can be written as UTF-8: line ends and other control characters become spaces, halves of characters "?".
    """

    def __init__(self, message: str = "") -> None:
        super().__init__(_HALVES.sub("?", _CONTROL.sub(" ", message)))


class InputError(FieldfuseError):
    """The source, a file in a run's folder, or a setting is not usable."""


class PoseError(FieldfuseError):
    """Camera poses could not be found, and why."""


class OutputError(FieldfuseError):
    """A result could not be written (disk full, folder not writable)."""


class Interrupted(FieldfuseError):
    """The user asked to stop and what was finished is kept."""
