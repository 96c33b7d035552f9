"""Field files: round trip, and what happens to files that were cut, changed or made to hurt."""

from __future__ import annotations

import json
import struct
import subprocess
import sys
import textwrap
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from safetensors.torch import load_file, save_file

from fieldfuse.camera import Similarity
from fieldfuse.errors import InputError, OutputError
from fieldfuse.volume import store
from fieldfuse.volume.edit import corner_nodes
from fieldfuse.volume.store import FieldFile, compact, expand, read_field, write_field
from fieldfuse.volume.topology import VOXELS, Topology

ROOT = Path(__file__).resolve().parents[2]


def make_field(blocks: int = 3, channels: int = 4, seed: int = 0) -> FieldFile:
    generator = torch.Generator().manual_seed(seed)
    cells = torch.randperm(5**3, generator=generator)[:blocks]
    keys = torch.stack([cells % 5 - 2, cells // 5 % 5, cells // 25 - 4], 1).int()
    occupied = torch.rand(blocks, VOXELS, generator=generator) < 0.02
    nodes = corner_nodes(Topology(keys), occupied.view(-1)).nonzero().view(-1).int()
    angle = 0.3
    rotation = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    return FieldFile(
        keys=keys,
        occupied=occupied,
        node_index=nodes,
        features=torch.randn(len(nodes), channels, generator=generator),
        density=torch.randn(len(nodes), generator=generator),
        decoder={"hidden.weight": torch.randn(5, channels, generator=generator), "hidden.bias": torch.randn(5, generator=generator)},
        config={"decoder": "deferred", "levels": [1, 2.5, None, "ü"]},
        voxel_size=0.04,
        origin=(-1.0, 0.5, 1e-3),
        working_from_input=Similarity(2.5, rotation, np.array([1.0, -2.0, 1e6])),
        meta={"seconds": 1.5},
    )


def assert_same(one: FieldFile, two: FieldFile) -> None:
    for name in ("keys", "occupied", "node_index", "features", "density"):
        assert torch.equal(getattr(one, name), getattr(two, name)), name
    assert one.decoder.keys() == two.decoder.keys() and all(torch.equal(one.decoder[k], two.decoder[k]) for k in one.decoder)
    assert (one.config, one.voxel_size, one.origin, one.meta, one.version) == (
        two.config,
        two.voxel_size,
        two.origin,
        two.meta,
        two.version,
    )
    assert one.working_from_input.to_dict() == two.working_from_input.to_dict()


@pytest.mark.parametrize("blocks", [0, 1, 7])
def test_round_trip(tmp_path: Path, blocks: int) -> None:
    data = make_field(blocks)
    write_field(tmp_path / "a.safetensors", data)
    assert_same(read_field(tmp_path / "a.safetensors"), data)
    write_field(tmp_path / "b.safetensors", make_field(blocks))
    assert (tmp_path / "a.safetensors").read_bytes() == (tmp_path / "b.safetensors").read_bytes(), "the same field is the same bytes"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.safetensors", "b.safetensors"]


def test_half_precision_is_half_the_size_and_rounds_only_features(tmp_path: Path) -> None:
    data = make_field(20, channels=16)
    write_field(tmp_path / "full", data)
    write_field(tmp_path / "half", data, precision="float16")
    back = read_field(tmp_path / "half")
    assert torch.equal(back.features, data.features.half()) and back.features.dtype == torch.float16
    rows = expand(back.features, back.node_index, len(back.keys))
    assert torch.equal(compact(rows, back.node_index), data.features.half().float()) and rows.dtype == torch.float32
    assert_same(replace(back, features=data.features), data)
    saved = (tmp_path / "full").stat().st_size - (tmp_path / "half").stat().st_size
    assert saved == pytest.approx(data.features.numel() * 2, abs=64)


def test_compact_and_expand_are_inverse_on_stored_corners() -> None:
    data = make_field(6)
    blocks = len(data.keys)
    rows = expand(data.features, data.node_index, blocks)
    assert rows.shape == (blocks * VOXELS + 1, 4)
    assert torch.equal(compact(rows, data.node_index), data.features)
    unstored = torch.ones(len(rows), dtype=torch.bool)
    unstored[data.node_index.long()] = False
    assert bool(unstored[-1]) and float(rows[unstored].abs().sum()) == 0
    assert expand(data.density, data.node_index, blocks).shape == (blocks * VOXELS + 1,)
    half = compact(rows, data.node_index, torch.float16)
    assert half.dtype == torch.float16 and torch.equal(half, data.features.half())
    rows[data.node_index[-1].long(), 0] = -1e5  # does not fit
    assert torch.equal(compact(rows, data.node_index, torch.float16), rows[data.node_index.long()])


# ------------------------------------------------------------------------------------------------ tampering


def refused(path: Path, match: str) -> None:
    with pytest.raises(InputError, match=match) as caught:
        read_field(path)
    text = str(caught.value)
    assert "\n" not in text and len(text) < 600 + len(str(path)) and "Traceback" not in text


def rewrite(path: Path, tensors: dict[str, torch.Tensor] | None = None, information: dict[str, Any] | str | None = None) -> Path:
    """A field file with some tensors or metadata replaced (None removes a tensor), written behind the writer's back."""
    write_field(path, make_field())
    held = load_file(path)
    for name, tensor in (tensors or {}).items():
        if tensor is None:
            del held[name]
        else:
            held[name] = tensor
    raw = path.read_bytes()
    header = json.loads(raw[8 : 8 + struct.unpack("<Q", raw[:8])[0]])
    text = header["__metadata__"][store.METADATA_KEY]
    if isinstance(information, dict):
        text = json.dumps({**json.loads(text), **information})
    elif information is not None:
        text = information
    save_file(held, path, metadata={store.METADATA_KEY: text})
    return path


def changed(name: str, place: Any, value: float) -> dict[str, torch.Tensor]:
    data = make_field()
    tensor = (data.decoder[name.removeprefix("decoder.")] if name.startswith("decoder.") else getattr(data, name)).clone()
    tensor[place] = value
    return {name: tensor}


FIELD = make_field()
BAD_TENSORS = {
    "missing": ({"density": None}, "'density' is missing"),
    "unknown": ({"evil": torch.zeros(1)}, "unknown tensor 'evil'"),
    "key dtype": ({"keys": FIELD.keys.long()}, "type torch.int64"),
    "feature dtype": ({"features": FIELD.features.double()}, "type torch.float64"),
    "decoder dtype": ({"decoder.hidden.bias": torch.zeros(5, dtype=torch.int32)}, "decoder tensor"),
    "key shape": ({"keys": torch.zeros(3, dtype=torch.int32)}, "shape"),
    "scalar keys": ({"keys": torch.tensor(3, dtype=torch.int32)}, "shape"),
    "one block less": ({"keys": FIELD.keys[:-1].clone()}, "shape"),
    "one feature row less": ({"features": FIELD.features[:-1].clone()}, "shape"),
    "flat features": ({"features": FIELD.features.view(-1).clone()}, "shape"),
    "no channels": ({"features": FIELD.features[:, :0].clone()}, "channels"),
    "far key": (changed("keys", (0, 0), store.KEY_LIMIT), "out of range"),
    "extreme key": (changed("keys", (0, 0), -(2**31)), "out of range"),
    "scattered": ({"keys": torch.tensor([[0, 0, 0], [2**19, 2**19, 2**19], [1, 1, 1]], dtype=torch.int32)}, "too far apart"),
    "twice": ({"keys": FIELD.keys[[0, 1, 0]].clone()}, "twice"),
    "index below": (changed("node_index", 0, -1), "node index"),
    "index beyond": (changed("node_index", -1, 3 * VOXELS), "node index"),
    "index not ascending": ({"node_index": FIELD.node_index.flip(0).clone()}, "node index"),
    "NaN feature": (changed("features", (2, 1), float("nan")), "'features' holds values that are not finite"),
    "infinite density": (changed("density", 1, float("-inf")), "'density' holds values that are not finite"),
    "NaN decoder": (changed("decoder.hidden.bias", 1, float("nan")), "not finite"),
}
BAD_INFORMATION: dict[str, tuple[dict[str, Any] | str, str]] = {
    "newer": ({"version": 7}, "version 7 and only version 1"),
    "version text": ({"version": "1"}, "no version"),
    "version true": ({"version": True}, "no version"),
    "not JSON": ("{", "not valid JSON"),
    "NaN in JSON": ('{"version": NaN}', "not valid JSON"),
    "a list": ("[]", "no version"),
    "nested": ("[" * 200_000, "not valid JSON"),
    "huge number": ('{"version": ' + "9" * 10_000 + "}", "cannot be used"),
    "config": ({"config": []}, "its config"),
    "meta": ({"meta": None}, "its meta"),
    "similarity": ({"working_from_input": 3}, "its working_from_input"),
    "scale": ({"working_from_input": {**Similarity.identity().to_dict(), "scale": 0.0}}, "scale is not one .*greater than 0"),
    "mirror": ({"working_from_input": {**Similarity.identity().to_dict(), "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}}, "rotation"),
    "sheared": ({"working_from_input": {**Similarity.identity().to_dict(), "rotation": [[1, 1, 0], [0, 1, 0], [0, 0, 1]]}}, "rotation"),
    "ragged": ({"working_from_input": {**Similarity.identity().to_dict(), "rotation": [[1, 1], [0, 1, 0], [0]]}}, "rotation"),
    "voxel size": ({"voxel_size": -1}, "voxel_size .*greater than 0"),
    "voxel text": ({"voxel_size": "4"}, "its voxel_size is not one"),
    "voxel missing": ({"voxel_size": None}, "its voxel_size is not one"),
    "voxel size huge": ({"voxel_size": 10**400}, "voxel_size"),
    "origin": ({"origin": [1, 2]}, "origin"),
    "far origin": ({"origin": [1, 2, 1e300]}, "its origin.2 is not one"),
}


@pytest.mark.parametrize("name", BAD_TENSORS)
def test_tampered_tensor_is_refused(tmp_path: Path, name: str) -> None:
    tensors, match = BAD_TENSORS[name]
    refused(rewrite(tmp_path / "f", tensors), match)


@pytest.mark.parametrize("name", BAD_INFORMATION)
def test_tampered_metadata_is_refused(tmp_path: Path, name: str) -> None:
    information, match = BAD_INFORMATION[name]
    refused(rewrite(tmp_path / "f", information=information), match)


def test_an_untouched_rewrite_is_read(tmp_path: Path) -> None:
    assert_same(read_field(rewrite(tmp_path / "f")), make_field())  # so the refusals above are not the rewriting's doing


def test_things_that_are_no_field(tmp_path: Path) -> None:
    refused(tmp_path / "absent", "there is no field file")
    refused(tmp_path, "there is no field file")
    path = tmp_path / "f"
    for raw in (b"", b"\x00" * 7, b"\x89PNG\r\n\x1a\n" + bytes(100), b"PK\x03\x04" + bytes(64), b"\x80\x04\x95" + bytes(64)):
        path.write_bytes(raw)
        refused(path, "cannot be used")
    save_file({"keys": torch.zeros(1)}, path)
    refused(path, "not a Fieldfuse field")


def test_headers_that_lie_about_their_size(tmp_path: Path) -> None:
    path = tmp_path / "f"
    write_field(path, make_field())
    raw = path.read_bytes()
    for size in (2**63, 2**40, 200 * 2**20, len(raw), 0, 5):
        path.write_bytes(struct.pack("<Q", size) + raw[8:])
        refused(path, "cannot be used")
    for keep in (len(raw) - 1, len(raw) // 2, 100, 9):
        path.write_bytes(raw[:keep])
        refused(path, "cannot be used")
    path.write_bytes(raw + b"\0")
    refused(path, "cannot be used")


@settings(max_examples=400, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.booleans(), st.integers(0, 255)), min_size=1, max_size=4))
@example([(0.0, True, 255)])
def test_changed_bytes_are_refused_or_give_a_valid_field(tmp_path: Path, changes: list[tuple[float, bool, int]]) -> None:
    path, raw = tmp_path / "f", bytearray(_BYTES)
    header = 8 + struct.unpack("<Q", raw[:8])[0]
    for where, in_header, value in changes:  # half of the changes in the header, which is the smaller part
        raw[int(where * (header if in_header else len(raw)))] = value
    path.write_bytes(raw)
    try:
        data = read_field(path)
    except InputError as error:
        assert "\n" not in str(error)
        return
    # What was accepted must stand a second round trip and hold no index that leads outside.
    assert data.features.shape[0] == len(data.density) == len(data.node_index)
    assert expand(data.features, data.node_index, len(data.keys)).isfinite().all()
    Topology(data.keys)
    write_field(tmp_path / "g", data)
    assert_same(read_field(tmp_path / "g"), data)


def _bytes() -> bytes:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        write_field(Path(folder) / "f", make_field(2, 2))
        return (Path(folder) / "f").read_bytes()


_BYTES = _bytes()


# ------------------------------------------------------------------------------------------------ writing


@pytest.mark.parametrize(
    "broken",
    [
        replace(FIELD, features=FIELD.features * float("nan")),
        replace(FIELD, keys=FIELD.keys[[0, 0, 1]]),
        replace(FIELD, node_index=FIELD.node_index.flip(0)),
        replace(FIELD, config={"a": float("inf")}),
        replace(FIELD, config={"a": object()}),
        replace(FIELD, voxel_size=0.0),
        replace(FIELD, density=FIELD.density[:-1]),
    ],
)
def test_a_field_that_could_not_be_read_is_not_written(tmp_path: Path, broken: FieldFile) -> None:
    path = tmp_path / "f"
    write_field(path, FIELD)
    with pytest.raises(OutputError, match="is not written"):
        write_field(path, broken)
    assert_same(read_field(path), FIELD)  # the good one from before is still there
    assert [entry.name for entry in tmp_path.iterdir()] == ["f"]


def test_values_beyond_half_precision_are_not_written_as_infinity(tmp_path: Path) -> None:
    large = replace(FIELD, features=FIELD.features + 1e5)
    write_field(tmp_path / "f", large, precision="float16")
    assert torch.equal(read_field(tmp_path / "f").features, large.features)  # kept in float32
    with pytest.raises(ValueError, match="float16 or float32"):
        write_field(tmp_path / "f", large, precision="int8")


def test_full_disk_is_said_and_leaves_nothing_behind(tmp_path: Path) -> None:
    code = f"""
        import resource, signal, sys
        sys.path.insert(0, {str(ROOT)!r})
        from tests.volume.test_store import make_field
        from fieldfuse.errors import OutputError
        from fieldfuse.volume.store import write_field
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
        try:
            write_field("f", make_field(50))
        except OutputError as error:
            print("refused:", error)
    """
    done = subprocess.run(
        [sys.executable, "-B", "-c", textwrap.dedent(code)], check=False, cwd=tmp_path, capture_output=True, text=True, timeout=600
    )
    assert done.stdout.startswith("refused: cannot write f"), done
    assert list(tmp_path.iterdir()) == []
