"""Procedural scenes with one small set of textures: making eight large ones would take longer than the tests."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch

from fieldfuse.nerfusion.training import mixture, procedural, samples


@pytest.fixture(autouse=True, scope="package")
def small() -> Iterator[None]:
    """Small textures and lattices, and one thread: sums of several may differ in their order."""
    monkeypatch = pytest.MonkeyPatch()
    monkeypatch.setattr(procedural, "TEXELS", 128)
    monkeypatch.setattr(mixture, "BANKS", 1)
    monkeypatch.setattr(samples, "LEAST", 16)
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
    monkeypatch.undo()
