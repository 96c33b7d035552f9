"""How work reports its progress and is asked to stop. Silent unless a pipeline listens."""

from __future__ import annotations

from collections.abc import Callable

from fieldfuse.errors import Interrupted


class Progress:
    """Base class and silent default. `pipelines` has the one that draws bars and listens to Ctrl-C."""

    def update(self, done: float, total: float, note: str = "") -> None:
        """`done` of `total` units of the current stage are finished; `note` is a short live remark."""

    def stopping(self) -> bool:
        """True once the user asked to stop. Work that can keep what it has ends its loop; other work calls `check`."""
        return False

    def check(self) -> None:
        """Raise when the user asked to stop.

        Raises:
            Interrupted: always caught by the pipeline, which keeps the stages that are finished.
        """
        if self.stopping():
            raise Interrupted("stopped on request; what was finished is kept, run the same command again to go on")


SILENT = Progress()


class Callback(Progress):
    """Passes on to a function of the caller's: stage, done, total and a remark; it asks to stop by returning False."""

    def __init__(self, listener: Callable[[str, float, float, str], bool | None], stage: str) -> None:
        self.listener, self.stage, self._stop = listener, stage, False

    def update(self, done: float, total: float, note: str = "") -> None:
        self._stop = self.listener(self.stage, done, total, note) is False or self._stop

    def stopping(self) -> bool:
        return self._stop


class Bar(Progress):
    """A bar of rich's for one stage, in a terminal or a notebook; it goes when the stage has ended."""

    def __init__(self, stage: str) -> None:
        from rich.progress import Progress as Bars

        self._bars = Bars(transient=True)
        self._task = self._bars.add_task(stage, total=None)
        self._stage = stage
        self._bars.start()

    def update(self, done: float, total: float, note: str = "") -> None:
        self._bars.update(self._task, completed=done, total=max(total, done), description=f"{self._stage} {note}".strip())
        if done >= total:
            self._bars.stop()

    def __del__(self) -> None:
        self._bars.stop()
