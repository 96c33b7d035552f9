"""Tasks on a cluster and in this process: values, errors, stopping, lost workers and nodes, what nodes must have."""

from __future__ import annotations

import platform
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from fieldfuse.cluster import Message, Node, Task, Workers, held, on_ray, open_workers
from fieldfuse.errors import InputError
from tests.cluster.functions import die_at_first, invert, wait_to_stop


@pytest.fixture(scope="module")
def connection(cluster: Any) -> Iterator[Workers]:
    with open_workers(cluster.address) as workers:
        yield workers


@pytest.fixture
def connected(connection: Workers) -> Workers:
    connection.stopped = False
    return connection


@pytest.fixture(params=["here", "cluster"])
def workers(request: pytest.FixtureRequest) -> Iterator[Workers]:
    if request.param == "cluster":
        yield request.getfixturevalue("connected")
        return
    with open_workers(pool=False) as here:
        yield here


def test_what_no_node_holds_is_named(connected: Workers) -> None:
    assert connected.too_large(Task("small", None)) is None
    text = connected.too_large(Task("huge", None, cpus=2, memory=2**50))
    assert text is not None and text.startswith("huge needs 2 cores, 1048576.0 GB of memory, and no node has that much")
    assert connected.at_once(Task("small", None)) == 2
    assert held(Task("gpu", None, gpus=0.5), Node("one", "", 8, 2, 0)) == 4


def test_nodes_with_the_same_versions_and_storage_pass(connected: Workers, tmp_path: Path) -> None:
    connected.check(tmp_path / "new" / "out", [tmp_path, tmp_path / "missing here, too"])
    assert list(tmp_path.iterdir()) == []  # nothing is left of the probe


@pytest.mark.parametrize("what", ["fieldfuse", "Python", "Ray"])
def test_another_version_on_a_node_is_named(connected: Workers, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str) -> None:
    import ray

    monkeypatch.setattr(on_ray, "__version__", "9.9" if what == "fieldfuse" else on_ray.__version__)
    monkeypatch.setattr(platform, "python_version", lambda: "9.9" if what == "Python" else sys.version.split()[0])
    monkeypatch.setattr(ray, "__version__", "9.9" if what == "Ray" else ray.__version__)
    with pytest.raises(InputError, match=rf"^the node \S+ has {what} [\d.]+ and this machine 9\.9; install the same version on both$"):
        connected.check(tmp_path)


def test_storage_that_a_node_does_not_see_is_named(connected: Workers, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    @contextmanager
    def elsewhere(out: Path) -> Iterator[Path]:
        yield out / "not there"

    monkeypatch.setattr(on_ray, "probe", elsewhere)
    with pytest.raises(InputError, match=rf"^the node \S+ does not see {tmp_path}; put it on storage that all nodes mount"):
        connected.check(tmp_path)


def test_a_killed_worker_is_replaced_as_often_as_allowed(connected: Workers, tmp_path: Path) -> None:
    wanted = {"twice": (2, 2), "always": (9, 1), "never": (0, 3)}  # name → deaths, retries
    tasks = [Task(name, (str(tmp_path / name), deaths), retries=retries) for name, (deaths, retries) in wanted.items()]
    found = {task.name: outcome for task, outcome in connected.run(die_at_first, tasks)}
    assert found["twice"].value == 3 and found["never"].value == 1
    assert found["always"].error == "its worker process died, 2 times in all" and found["always"].node


def test_values_and_errors_come_as_tasks_end(workers: Workers) -> None:
    said: list[Any] = []
    tasks = [Task("half", 2), Task("wrong", -1), Task("broken", 0)]
    found = {task.name: outcome for task, outcome in workers.run(invert, tasks, said.append)}
    names = {node.name for node in workers.nodes}
    assert found["half"].value == 0.5 and found["half"].error is None
    assert found["wrong"].error == "-1 is below zero; give another" and found["wrong"].kind == "InputError"
    assert found["broken"].error == "something unexpected went wrong (ZeroDivisionError: division by zero)"
    assert {outcome.node for outcome in found.values()} <= names
    assert {news.task for news in said if news.data.get("note") == "inverting"} == set(found)


def test_how_many_are_done_and_which_failed(workers: Workers) -> None:
    done: list[float] = []
    (failed,) = workers.finish(invert, [Task("half", 2), Task("wrong", -1), Task("third", 3)], done.append)
    assert failed in [f"wrong (on {node.name}): -1 is below zero; give another" for node in workers.nodes]
    assert done[-1] == 2 and max(done) <= 3


def test_stopping_lets_what_runs_end_and_begins_nothing_more(workers: Workers, tmp_path: Path) -> None:
    tasks = [Task(str(number), str(tmp_path / str(number))) for number in range(6)]

    def stop() -> None:
        while not list(tmp_path.iterdir()):
            time.sleep(0.02)
        workers.stop()

    threading.Thread(target=stop, daemon=True).start()
    outcomes = [outcome for _, outcome in workers.run(wait_to_stop, tasks)]
    begun = [outcome for outcome in outcomes if outcome.begun]
    assert len(outcomes) == 6 and 1 <= len(begun) <= 2
    assert {outcome.value for outcome in begun} == {"stopped"}


@pytest.mark.long
def test_a_task_goes_on_where_a_node_was_added(cluster: Any, connected: Workers, tmp_path: Path) -> None:
    node = {"num_cpus": 1, "resources": {}, "include_dashboard": False, "object_store_memory": 80 * 2**20, "memory": 77 * 2**30}
    there = [cluster.add_node(**node)]
    large = Task("large", str(tmp_path / "begun"), memory=76 * 2**30, retries=1)  # only such a node has room for it
    places: list[str] = []

    def change(news: Message) -> None:
        places.append(news.node)
        if len(there) == 1:
            cluster.remove_node(there[0], allow_graceful=False)
            there.append(cluster.add_node(**node))
        else:
            connected.stop()

    ((_, outcome),) = connected.run(wait_to_stop, [large], change)
    cluster.remove_node(there[1])
    assert outcome.value == "stopped" and len(set(places)) == 2, (outcome, places)
