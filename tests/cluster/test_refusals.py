"""Addresses, versions and storage that are refused, without a cluster."""

from __future__ import annotations

import socket
import sys
import time
from pathlib import Path

import pytest

from fieldfuse.cluster import Task, checks, open_workers
from fieldfuse.cluster.checks import require
from fieldfuse.errors import InputError, OutputError
from tests.cluster.functions import invert


def test_what_a_node_finds_becomes_a_sentence(tmp_path: Path) -> None:
    good = {"fieldfuse": "1", "probe": True, "missing": [], "write": None}
    require("a", good, {"fieldfuse": "1"}, tmp_path)
    with pytest.raises(InputError, match="the node a cannot import fieldfuse; install fieldfuse 1 there"):
        require("a", {**good, "fieldfuse": None}, {"fieldfuse": "1"}, tmp_path)
    with pytest.raises(InputError, match="the node a does not see /captures/fox; put it on storage"):
        require("a", {**good, "missing": ["/captures/fox"]}, {}, tmp_path)
    with pytest.raises(OutputError, match=f"the node a cannot write in {tmp_path}: No space left on device; free space"):
        require("a", {**good, "write": "No space left on device"}, {}, tmp_path)


@pytest.mark.parametrize(
    ("address", "sentence"),
    [
        ("cluster", "the address 'cluster' is neither auto nor HOST:PORT"),
        ("host:0", "the address 'host:0' is neither auto nor HOST:PORT"),
        ("127.0.0.1:1", "nothing answers at 127.0.0.1:1 (Connection refused); start Ray there"),
    ],
)
def test_an_address_where_nothing_is(address: str, sentence: str) -> None:
    pytest.importorskip("ray", reason="Ray is not installed (the extra cluster)")
    began = time.monotonic()
    with pytest.raises(InputError) as error, open_workers(address):
        pass
    assert sentence in str(error.value) and time.monotonic() - began < 20


def test_an_address_at_which_no_ray_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ray", reason="Ray is not installed (the extra cluster)")
    monkeypatch.setattr(checks, "CONNECT", 2.0)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"127.0.0.1:{silent.getsockname()[1]}"
        with pytest.raises(InputError, match=f"no Ray answers at {address} within 2 s"), open_workers(address):
            pass


def test_without_ray_a_cluster_is_refused_and_this_machine_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(InputError, match=r'needs the package ray; install it \(pip install "fieldfuse\[cluster\]"\)'), open_workers("auto"):
        pass
    monkeypatch.setattr("fieldfuse.cluster.has_ray", lambda: False)
    with open_workers() as workers:
        ((_, outcome),) = workers.run(invert, [Task("half", 2)])
        assert outcome.value == 0.5 and workers.at_once(Task("half", 2)) == 1
