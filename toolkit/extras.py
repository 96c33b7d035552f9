"""Packages that only some captures and formats need: each is an extra of the installation (`setup.cfg`)."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from fieldfuse.errors import InputError


def extra(name: str, module: str, what: str, otherwise: str = "") -> Any:
    """The module of an extra.

    Args:
        name: of the extra. what: needs it; the message begins with it. otherwise: what to do without it; its end.

    Raises:
        InputError: it is not installed.
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise InputError(f'{what} needs the package {module}; install it (pip install "fieldfuse[{name}]"){otherwise}') from error
