"""The fixture of the hard cases, and what writes them into a page: `pytest tests/stability/hard --page docs/stability.md`."""

from __future__ import annotations

import re
from collections.abc import Generator, Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.stability.hard.within import Within
from tests.stability.page import case_lines, replace_part

RECORDS = pytest.StashKey[list[Within]]()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--page", metavar="FILE", help="run the long cases too, and write the part `cases` of this page")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if config.getoption("--page", None) is None:
        for item in items:
            if item.get_closest_marker("long") and Path(__file__).parent in item.path.parents:
                item.add_marker(pytest.mark.skip(reason="long: `make stability` runs it"))


@pytest.fixture
def within(request: pytest.FixtureRequest) -> Iterator[Within]:
    """Records errors and their bounds; the test fails at its end if any is missed. The first line of the test's docstring is its title."""
    name = (request.function.__doc__ or request.node.name).splitlines()[0].rstrip(".")
    if re.match("[A-Z][a-z ]", name):
        name = name[0].lower() + name[1:]
    title = f"{request.module.GROUP}: {name}"
    callspec = getattr(request.node, "callspec", None)
    record = Within(f"{title} ({callspec.id})" if callspec else title)
    request.config.stash.setdefault(RECORDS, []).append(record)
    with np.errstate(all="ignore"):  # overflow in a hard case is the point of it; what counts is the result
        yield record


@pytest.hookimpl(wrapper=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> Generator[None, object, object]:
    record = pyfuncitem.funcargs.get("within")
    try:
        result = yield
    except Exception as error:
        if isinstance(record, Within):
            record.failure = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise
    if isinstance(record, Within):
        record.check()
    return result


def pytest_sessionfinish(session: pytest.Session) -> None:
    page, records = session.config.getoption("--page", None), session.config.stash.get(RECORDS, [])
    if page and records:
        replace_part(Path(page), "cases", case_lines(records))
