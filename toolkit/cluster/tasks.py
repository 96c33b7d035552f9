"""Tasks, what becomes of them, and who runs them; the interface of `fieldfuse.cluster`, and the one that needs nothing: this process."""

from __future__ import annotations

import os
import socket
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from fieldfuse import memory
from fieldfuse.cluster.checks import probe
from fieldfuse.errors import FieldfuseError, first_line
from fieldfuse.progress import Progress

LISTEN = 2.0  # seconds between two questions of a task whether it is to stop
RETRIES = 3


@dataclass(frozen=True)
class Node:
    """A machine (or what Ray was told to take of it): its resources in all, used or not.

    Attributes:
        key: Ray's id. memory: bytes.
    """

    name: str
    key: str
    cpus: float
    gpus: float
    memory: int


@dataclass(frozen=True)
class Task:
    """One call of a function.

    Attributes:
        argument: what the function gets first; plain data.
        cpus, gpus: parts are possible. memory: bytes; by these Ray decides how many tasks run on a node at once.
        retries: how often it is begun again after its worker or node was lost. What the function raises is final.
    """

    name: str
    argument: Any
    cpus: float = 1.0
    gpus: float = 0.0
    memory: int = 0
    retries: int = RETRIES


@dataclass(frozen=True)
class Outcome:
    """How a task ended.

    Attributes:
        error: one sentence, None if there is a value. node: name of the one where it ended, "" where it is not known.
        begun: False: it was not started, because the user wants to stop.
        kind: class of a FieldfuseError that the function raised, "" of other errors.
    """

    value: Any = None
    error: str | None = None
    node: str = ""
    begun: bool = True
    kind: str = ""


@dataclass(frozen=True)
class Message:
    """What a running task said."""

    task: str
    node: str
    data: Any


Function = Callable[[Any, "Link"], Any]
Listener = Callable[[Message], None]


class Link(Progress):
    """Between a running task and who started it. As a `Progress` it can be passed to whatever takes one."""

    def __init__(self, send: Callable[[Any], bool]) -> None:
        self._send, self._stop, self._asked = send, False, -LISTEN

    def report(self, data: Any) -> None:
        """Plain data to the listener of `Workers.run`."""
        self._stop = self._send(data) or self._stop
        self._asked = time.monotonic()

    def update(self, done: float, total: float, note: str = "") -> None:
        if time.monotonic() - self._asked >= LISTEN or done >= total:
            self.report({"done": done, "total": total, "note": note})

    def stopping(self) -> bool:
        """Whether the task is to end what it is at and return."""
        if not self._stop and time.monotonic() - self._asked >= LISTEN:
            self.report(None)
        return self._stop


class Workers(ABC):
    """Where tasks run; made by `open_workers`."""

    stopped = False

    @property
    @abstractmethod
    def nodes(self) -> list[Node]:
        """Those that are there now."""

    @abstractmethod
    def check(self, out: Path | None, sources: Sequence[Path] = ()) -> None:
        """Have every node look at its versions, at `out`, in which it must be able to write, and at `sources`, as far as they exist here.

        Without `out` storage is not looked at.

        Raises:
            InputError: a node has another version, or does not see a path; names node and path.
            OutputError: a node cannot write in `out`, or its disk is full.
        """

    @abstractmethod
    def run(self, function: Function, tasks: Sequence[Task], listen: Listener | None = None) -> Iterator[tuple[Task, Outcome]]:
        """Each task with its outcome, in the order in which they end.

        `listen` gets what they say, and `{"begun": True}` whenever one begins, or begins again because its worker was lost.
        """

    def finish(self, function: Function, tasks: Sequence[Task], show: Callable[[float], None]) -> list[str]:
        """Run tasks to their end.

        Args:
            show: gets how many are done, with parts of those that run, whenever that is known anew.

        Returns:
            a sentence for each that failed: its name, where, and why.
        """
        shares = dict.fromkeys((task.name for task in tasks), 0.0)
        failed: list[str] = []

        def listen(news: Message) -> None:
            if isinstance(news.data, dict) and "done" in news.data:
                shares[news.task] = news.data["done"] / max(news.data["total"], 1e-9)
            show(sum(shares.values()))

        for task, outcome in self.run(function, tasks, listen):
            shares[task.name] = 1.0 if outcome.error is None and outcome.begun else 0.0
            if outcome.error is not None and outcome.kind != "Interrupted":
                failed.append(f"{task.name} (on {outcome.node or 'a node that was lost'}): {outcome.error}")
            show(sum(shares.values()))
        return failed

    def stop(self) -> None:
        """No task begins any more, and `Link.stopping` is true in those that run. May be called by a signal's handler."""
        self.stopped = True

    def too_large(self, task: Task) -> str | None:
        """Why no node that is there could ever run the task; None if one can."""
        nodes = self.nodes
        if any(held(task, node) for node in nodes):
            return None
        wants = [f"{task.cpus:g} cores", *([f"{task.gpus:g} GPUs"] if task.gpus else [])]
        wants += [f"{task.memory / memory.GIB:.1f} GB of memory"] if task.memory else []
        there = "; ".join(f"{node.name} has {node.cpus:g}, {node.gpus:g} and {node.memory / memory.GIB:.1f} GB" for node in nodes[:4])
        return f"{task.name} needs {', '.join(wants)}, and no node has that much ({there})"

    def at_once(self, task: Task) -> int:
        """How many such tasks can run at the same time."""
        return sum(held(task, node) for node in self.nodes)


def held(task: Task, node: Node) -> int:
    """How many such tasks a node can run at the same time."""
    pairs = ((node.cpus, task.cpus), (node.gpus, task.gpus), (node.memory, task.memory))
    return int(min((there / wanted for there, wanted in pairs if wanted), default=1))


class Here(Workers):
    """Tasks one after the other, in this process."""

    def __init__(self) -> None:
        self._node = Node(socket.gethostname(), "", float(os.cpu_count() or 1), _gpus(), memory.available())

    @property
    def nodes(self) -> list[Node]:
        return [self._node]

    def at_once(self, task: Task) -> int:
        return min(1, super().at_once(task))

    def check(self, out: Path | None, sources: Sequence[Path] = ()) -> None:
        with probe(out):
            pass

    def run(self, function: Function, tasks: Sequence[Task], listen: Listener | None = None) -> Iterator[tuple[Task, Outcome]]:
        for task in tasks:
            if self.stopped:
                yield task, Outcome(begun=False)
                continue

            def send(data: Any, name: str = task.name) -> bool:
                if listen is not None and data is not None:
                    listen(Message(name, self._node.name, data))
                return self.stopped

            send({"begun": True})
            yield task, replace(call(function, task.argument, Link(send)), node=self._node.name)


def _gpus() -> float:
    """Graphics cards that torch would find, without loading it."""
    with suppress(OSError):
        return float(len(list(Path("/proc/driver/nvidia/gpus").iterdir())))
    return 0.0


def call(function: Function, argument: Any, link: Link) -> Outcome:
    """Whatever the function raises becomes a sentence: what Ray would make of it is its text with a stack of calls."""
    try:
        return Outcome(function(argument, link))
    except FieldfuseError as error:
        return Outcome(error=str(error), kind=type(error).__name__)
    except MemoryError:
        return Outcome(error="there was not enough memory for it")
    except Exception as error:
        return Outcome(error=f"something unexpected went wrong ({type(error).__name__}: {first_line(error)})")
