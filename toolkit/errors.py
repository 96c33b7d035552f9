"""Errors that a user can act on. Each message is one sentence: what is wrong, where, and what to do about it."""

from __future__ import annotations


def first_line(error: BaseException) -> str:
    """What an exception says, without what follows its first line; its kind where it says nothing."""
    return (str(error).splitlines() or [type(error).__name__])[0]


class FieldfuseError(Exception):
    """Something that stops the job and has a reason that a user can act on (the command line exits with code 2)."""


class InputError(FieldfuseError):
    """The source, a file in a run's folder, or a setting is not usable."""


class PoseError(FieldfuseError):
    """Camera poses could not be found, and why."""


class OutputError(FieldfuseError):
    """A result could not be written (disk full, folder not writable)."""


class Interrupted(FieldfuseError):
    """The user asked to stop and what was finished is kept."""
