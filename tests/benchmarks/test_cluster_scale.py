"""The simulation of many captures and of a large site, and what it is fitted to."""

from __future__ import annotations

import pytest

from benchmarks import cluster_scale as scale

COSTS = {"run": 0.5, "cell": 1.0, "task": 0.002, "report": 0.001, "coarse": 0.3, "pixel": 3.5e-6, "pixel_bytes": 15.0}


def test_tasks_on_one_core_follow_one_another(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scale, "DAYS_TO_FAILURE", 1e9)
    end, lost = scale.simulated([10.0, 20.0, 30.0], 1, 1.0, 0.0)
    assert (end, lost) == (pytest.approx(63.0), 0)
    assert scale.simulated([10.0, 20.0, 30.0], 3, 1.0, 0.0)[0] == pytest.approx(31.0)
    assert scale.simulated([1.0] * 1000, 1000, 0.0, 0.1)[0] == pytest.approx(101.0)  # the head is what they wait for


def test_lost_nodes_cost_time(monkeypatch: pytest.MonkeyPatch) -> None:
    usual = scale.simulated([3600.0] * 200, 10, 0.0, 0.0)
    monkeypatch.setattr(scale, "DAYS_TO_FAILURE", 0.1)
    end, lost = scale.simulated([3600.0] * 200, 10, 0.0, 0.0)
    assert 20 < lost < 150 and usual[0] < end < 1.5 * usual[0]


@pytest.mark.parametrize("what", list(scale.ROWS))
def test_more_nodes_are_faster_and_less_used(what: str) -> None:
    few, many = (scale.ROWS[what](nodes, COSTS) for nodes in (10, 100))
    assert many["hours"] < few["hours"] and many["used"] < few["used"] <= 1 and many["core_hours"] == few["core_hours"]
    assert f"| {what} | 100 |" in scale.table({"costs": COSTS, "rows": [{"what": what, "nodes": 100, **many}]})
