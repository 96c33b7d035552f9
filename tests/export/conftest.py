"""A browser for the tests of pages."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.evaluation.driven import Driven, driven


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Driven]:
    """One for all pages, which are opened in it one after the other."""
    with driven("about:blank", tmp_path_factory.mktemp("browser"), (320, 240)) as found:
        yield found
