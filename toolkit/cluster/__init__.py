"""Functions as tasks on the machines of a Ray cluster, on a pool of Ray's on this one, or in this process: one interface for the three.

    def square(number, link):                   # link: a Progress, through which a task is heard and stopped
        link.update(1, 1, "squared")
        return number**2

    with open_workers("auto") as workers:       # "auto" or HOST:PORT: a cluster; None: this machine
        workers.check(out)                      # versions and storage of all nodes
        for task, outcome in workers.run(square, [Task("three", 3), Task("four", 4, memory=2**30)]):
            print(task.name, outcome.value if outcome.error is None else outcome.error)

Functions must be importable by their module's name on every node, arguments and values be plain data: paths rather than arrays.
Ray restarts tasks whose worker or node is lost, so a function must be able to run again. Ray is imported when it is used, not before.
"""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from fieldfuse.cluster.checks import require_answer
from fieldfuse.cluster.on_ray import Cluster
from fieldfuse.cluster.tasks import RETRIES, Here, Link, Listener, Message, Node, Outcome, Task, Workers, held
from fieldfuse.extras import extra

__all__ = ["RETRIES", "Link", "Listener", "Message", "Node", "Outcome", "Task", "Workers", "has_ray", "held", "open_workers"]
STORE = 256 * 2**20  # bytes of Ray's object store on a pool of this machine: tasks pass paths


def has_ray() -> bool:
    """Whether the extra `cluster` is installed."""
    return importlib.util.find_spec("ray") is not None


@contextmanager
def open_workers(address: str | None = None, *, pool: bool = True, cpus: int | None = None) -> Iterator[Workers]:
    """Connect to the cluster at an address, "auto" or HOST:PORT, or use this machine: a pool of Ray's, or this process alone.

    When the context ends, tasks that still run are ended at once, and a pool of this machine with them.

    Args:
        pool: without an address, whether Ray starts processes here, if it is installed; else tasks run one after the other.
        cpus: of such a pool; default: all cores.

    Raises:
        InputError: Ray is not installed, the address is none, does not answer in time, or is of another version of Ray or Python.
    """
    if address is None and not (pool and has_ray()):
        yield Here()
        return
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_DEDUP_LOGS_SKIP_REGEX", ".")  # else Ray prints paragraphs on standard output when a worker dies
    extra("cluster", "ray", f"the cluster at {address}")
    import ray

    quiet: dict[str, Any] = {"logging_level": "ERROR", "log_to_driver": False}
    try:
        if address is None:
            ray.init(address="local", num_cpus=cpus, include_dashboard=False, object_store_memory=STORE, **quiet)
        else:
            require_answer(address)
            ray.init(address=address, **quiet)
        yield Cluster(ray)
    finally:
        ray.shutdown()
