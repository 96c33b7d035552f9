"""The kernels for CUDA, in Triton's interpreter on the CPU: against the tensors that they stand for."""

from __future__ import annotations

import importlib.util
import os

import pytest
import torch

os.environ.setdefault("TRITON_INTERPRET", "1")
pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("triton") is None or os.environ["TRITON_INTERPRET"] != "1", reason="needs Triton, interpreting"
)

from tests.networks.test_compiled import everything, places  # noqa: E402
from tests.networks.test_sweep import wall  # noqa: E402
from toolkit.networks import compiled, gpu  # noqa: E402
from toolkit.networks.matching import LARGE, SMALL, distribution, semi_global  # noqa: E402
from toolkit.networks.sweep import _table, sweep  # noqa: E402


def forced(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tensors on the CPU take the way of those on CUDA."""
    monkeypatch.setattr(compiled, "fits", lambda *values: False)
    monkeypatch.setattr(gpu, "fits", lambda *values: True)


@pytest.mark.parametrize("shape", [(40, 7, 9), (33, 5, 4), (3, 6, 1), (64, 1, 5)])
def test_matching(shape: tuple[int, int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    cost = torch.rand(shape, generator=torch.Generator().manual_seed(0))
    monkeypatch.setattr(compiled, "fits", lambda *values: False)
    smooth, likely = semi_global(cost), distribution(cost)
    table = _table(likely, 0.1)
    forced(monkeypatch)
    torch.testing.assert_close(semi_global(cost), smooth, atol=1e-6, rtol=0)
    torch.testing.assert_close(distribution(cost), likely, atol=1e-5, rtol=0)
    made = _table(likely, 0.1)
    torch.testing.assert_close(made, table, atol=1e-5, rtol=0)
    assert made.stride() == table.stride()


@pytest.mark.parametrize("views", [1, 2, 4])
def test_a_sweep_and_its_witnesses(views: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiled, "fits", lambda *values: False)
    slow = everything(views, 1000)
    forced(monkeypatch)
    for name, quick in everything(views, 1000).items():
        torch.testing.assert_close(quick, slow[name], atol=2e-4, rtol=1e-4, msg=lambda text, name=name: f"{name}: {text}")
