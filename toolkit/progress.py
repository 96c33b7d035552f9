"""How long work tells how far it is and learns that the user wants it to stop. Silent unless a pipeline listens."""

from __future__ import annotations

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
