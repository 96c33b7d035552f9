"""Networks in fewer digits: where it is done, and that nearly the same comes out."""

from __future__ import annotations

import pytest
import torch

from fieldfuse.nerfusion import precision
from fieldfuse.nerfusion.fusion import Fusion, FusionOptions
from fieldfuse.nerfusion.precision import computing, has_bfloat16
from tests.nerfusion.made import cameras, lattice, pictures, small_model

CPU = torch.device("cpu")


def test_it_is_as_the_name_says(monkeypatch: pytest.MonkeyPatch) -> None:
    def kind(name: str) -> torch.dtype:
        with computing(name, CPU):
            return torch.nn.functional.linear(torch.ones(1, 2), torch.ones(3, 2)).dtype

    assert kind("float32") == torch.float32 and kind("bfloat16") == torch.bfloat16
    for found, expected in ((True, torch.bfloat16), (False, torch.float32)):
        monkeypatch.setattr(precision, "has_bfloat16", lambda device, found=found: found)
        assert kind("auto") == expected
    assert not torch.is_autocast_enabled("cpu")


def test_a_processor_has_it_only_if_torch_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    assert not has_bfloat16(torch.device("cuda")), "not measured there"
    for one in (False, True):
        for other in (False, True):
            monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda one=one: one, raising=False)
            monkeypatch.setattr(torch.cpu, "_is_amx_tile_supported", lambda other=other: other, raising=False)
            assert has_bfloat16(CPU) == (one or other)
    for name in ("_is_avx512_bf16_supported", "_is_amx_tile_supported"):
        monkeypatch.delattr(torch.cpu, name, raising=False)
    assert not has_bfloat16(CPU), "an older torch"


@torch.no_grad()
def test_a_key_frame_fused_in_fewer_digits_is_nearly_the_same() -> None:
    model, seen_by = small_model().eval(), cameras(3)
    volumes = {}
    for name in ("float32", "bfloat16"):
        fusion = Fusion(model, lattice(), FusionOptions(1, 0.2, 4.0))
        with computing(name, CPU):
            fusion.add(model.encode(pictures(3), seen_by), seen_by)
        volumes[name] = fusion.volume
    exact, low = volumes["float32"], volumes["bfloat16"]
    assert low.rows.dtype == torch.float32 and torch.equal(low.topology.keys, exact.topology.keys)
    assert torch.equal(low.known, exact.known) and float(low.count.sum()) > 0
    apart = (low.rows - exact.rows).abs()
    assert 0 < float(apart.max()) < 0.1 and float(apart.mean()) < 0.003
