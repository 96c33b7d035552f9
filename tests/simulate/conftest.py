"""One torch thread: images here are so small that threads would only wait for each other. And small textures."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch

from fieldfuse.simulate.materials import TextureBank, texture_bank


@pytest.fixture(autouse=True, scope="package")
def one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="session")
def bank() -> TextureBank:
    return texture_bank(size=128)
