"""Protocols of published benchmarks, one file each: which scenes, which pictures train and test, what the paper reports."""

from __future__ import annotations

from fieldfuse.errors import InputError
from fieldfuse.evaluation.suites import dtu, llff, nerf_synthetic, posed, scannet
from fieldfuse.evaluation.suites.base import Suite

SUITES: dict[str, Suite] = {one.SUITE.name: one.SUITE for one in (nerf_synthetic, dtu, scannet, llff, posed)}


def suite_of(name: str) -> Suite:
    """A suite by name.

    Raises:
        InputError: there is none.
    """
    if name not in SUITES:
        raise InputError(f"there is no benchmark {name!r}; known are {', '.join(SUITES)}")
    return SUITES[name]
