"""A Ray cluster of two nodes with one core each on this machine, made once for all tests of a file."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="package")  # other tests in this process look at its children
def cluster() -> Iterator[Any]:
    pytest.importorskip("ray", reason="Ray is not installed (the extra cluster)")
    os.environ.update(RAY_USAGE_STATS_ENABLED="0", RAY_DEDUP_LOGS_SKIP_REGEX=".", PYTHONPATH=str(ROOT), OMP_NUM_THREADS="1")
    from ray.cluster_utils import Cluster

    node = {"num_cpus": 1, "include_dashboard": False, "object_store_memory": 80 * 2**20}
    made = Cluster(initialize_head=True, head_node_args=node)
    made.add_node(**node)
    yield made
    made.shutdown()
