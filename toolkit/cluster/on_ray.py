"""Tasks on Ray: the workers of a cluster, or of a pool on this machine."""

from __future__ import annotations

import platform
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from fieldfuse import __version__
from fieldfuse.cluster.checks import examiner, probe, require
from fieldfuse.cluster.tasks import Function, Link, Listener, Message, Node, Outcome, Task, Workers, call
from fieldfuse.errors import InputError, first_line

EXAMINE = 120.0  # seconds in which each node must have looked at its versions and storage: its first worker imports this package
TICK = 2.0  # seconds between two looks at what tasks say


class _Board:
    """An actor: what tasks say, until it is taken, and whether they are to stop."""

    def __init__(self) -> None:
        self.news: list[tuple[str, str, Any]] = []
        self.stop = False

    def report(self, task: str, node: str, data: Any) -> bool:
        if data is not None:
            self.news.append((task, node, data))
        return self.stop

    def take(self, stop: bool) -> list[tuple[str, str, Any]]:
        self.stop = self.stop or stop
        news, self.news = self.news, []
        return news


def _on_node(function: Function, name: str, argument: Any, board: Any) -> Outcome:
    """The task as a worker of Ray's runs it; `node` of the outcome is Ray's id."""
    import ray

    node = ray.get_runtime_context().get_node_id()

    def send(data: Any) -> bool:
        # Not `ray.get`: while a task waits in it, Ray gives its cores to another.
        return bool(board.report.remote(name, node, data).future().result())

    if send(None):
        return Outcome(begun=False, node=node)
    send({"begun": True})
    return replace(call(function, argument, Link(send)), node=node)


@dataclass
class Cluster(Workers):
    """Tasks of a Ray that this process is connected to."""

    ray: Any
    _names: dict[str, str] = field(default_factory=dict)

    @property
    def nodes(self) -> list[Node]:
        found = [one for one in self.ray.nodes() if one["Alive"]]
        hosts = [one["NodeManagerHostname"] for one in found]
        out = []
        for one in found:
            host, key, has = one["NodeManagerHostname"], one["NodeID"], one["Resources"]
            # Nodes of one host, as tests and some clusters have them, get a part of Ray's id.
            self._names.setdefault(key, f"{host}-{key[:6]}" if hosts.count(host) > 1 else host)
            out.append(Node(self._names[key], key, has.get("CPU", 0.0), has.get("GPU", 0.0), int(has.get("memory", 0))))
        return out

    def _name(self, key: str) -> str:
        if key and key not in self._names:
            _ = self.nodes
        return self._names.get(key, key[:12])

    def check(self, out: Path | None, sources: Sequence[Path] = ()) -> None:
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        expected = {"fieldfuse": __version__, "Python": platform.python_version(), "Ray": self.ray.__version__}
        look = self.ray.remote(examiner())
        with probe(out) as path:
            texts = [str(source.absolute()) for source in sources if source.exists()]
            refs = {}
            for node in self.nodes:
                there = NodeAffinitySchedulingStrategy(node.key, soft=False)
                refs[look.options(num_cpus=0, max_retries=1, scheduling_strategy=there).remote(path and str(path), texts)] = node
            ready, late = self.ray.wait(list(refs), num_returns=len(refs), timeout=EXAMINE)
            if late:
                slow = refs[late[0]].name
                raise InputError(f"the node {slow} did not start a worker within {EXAMINE:.0f} s; look at its Ray (ray status)")
            for ref in ready:
                node = refs[ref]
                try:
                    found = self.ray.get(ref)
                except self.ray.exceptions.RayError as error:
                    reason = first_line(error)
                    raise InputError(f"the node {node.name} cannot run a task: {reason}; look at its Ray (ray status)") from error
                require(node.name, found, expected, out)

    def run(self, function: Function, tasks: Sequence[Task], listen: Listener | None = None) -> Iterator[tuple[Task, Outcome]]:
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        here = NodeAffinitySchedulingStrategy(self.ray.get_runtime_context().get_node_id(), soft=False)
        lasting = {"max_restarts": -1, "max_task_retries": -1}  # whatever is killed, tasks can be heard
        board = self.ray.remote(_Board).options(num_cpus=0, scheduling_strategy=here, **lasting).remote()
        remote = self.ray.remote(_on_node)
        left = {}
        for task in tasks:
            options = {"num_cpus": task.cpus, "num_gpus": task.gpus, "memory": task.memory or None, "max_retries": task.retries}
            ref = remote.options(scheduling_strategy="SPREAD", name=task.name, **options).remote(function, task.name, task.argument, board)
            left[ref] = task
        places: dict[str, str] = {}  # task → node where it was begun last

        def hear() -> None:
            for name, node, data in self.ray.get(board.take.remote(self.stopped)):
                places[name] = self._name(node)
                if listen is not None:
                    listen(Message(name, places[name], data))

        while left:
            ended, _ = self.ray.wait(list(left), num_returns=1, timeout=TICK)
            hear()
            for ref in ended:
                task = left.pop(ref)
                yield task, self._outcome(ref, task, places.get(task.name, ""))

    def _outcome(self, ref: Any, task: Task, place: str) -> Outcome:
        errors = self.ray.exceptions
        try:
            outcome: Outcome = self.ray.get(ref)
            return replace(outcome, node=self._name(outcome.node))
        except errors.OutOfMemoryError:
            text = "Ray ended its worker because the memory of the node was nearly full; reserve more for it, so that fewer run at once"
        except (errors.NodeDiedError, errors.ObjectLostError):
            text = f"its node was lost, {_times_over(task)}"
        except errors.WorkerCrashedError:
            text = f"its worker process died, {_times_over(task)}"
        except errors.RayError as error:
            reason = getattr(error, "cause", None) or error  # of an error in the worker the text begins with where, in colours
            text = f"Ray could not run it ({type(reason).__name__}: {first_line(reason)})"
        return Outcome(error=text, node=place)


def _times_over(task: Task) -> str:
    return f"{task.retries + 1} times in all" if task.retries else "and it is not begun again (0 retries)"
