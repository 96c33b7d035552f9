"""What an input must not do: write or read outside the capture, run code, open a socket, take a gigabyte, or more than five seconds."""

from __future__ import annotations

import faulthandler
import os
import resource
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from fieldfuse.errors import FieldfuseError

SYSTEM = ("/proc/self", "/proc/meminfo", "/proc/cpuinfo", "/sys/fs/cgroup", "/dev/null", "/dev/urandom")
SECONDS = 5.0  # of computing: on a busy machine the wall clock says nothing about an input
WAITING = 120.0  # seconds of the wall clock, for what waits instead of computing
DEAD = 300.0  # seconds after which even code that never returns to Python is ended
MEMORY = 2**30
RUNS = ("os.system", "os.exec", "os.posix_spawn", "os.spawn", "os.fork", "subprocess.Popen", "pickle.find_class", "socket.connect",
        "socket.bind", "socket.getaddrinfo", "ctypes.dlopen", "pty.spawn", "code.__new__", "webbrowser.open")  # fmt: skip
CHANGES = ("os.remove", "os.rename", "os.mkdir", "os.rmdir", "os.link", "os.symlink", "os.truncate", "os.chmod", "os.chown",
           "shutil.rmtree", "shutil.move", "shutil.copyfile", "shutil.unpack_archive", "tempfile.mkstemp", "tempfile.mkdtemp")  # fmt: skip
COMPILED = ("imagecodecs/_lzfse.pyx",)  # Cython makes an empty code object for the place that an error comes from, and it never runs


class Hang(BaseException):
    """The time is over (no `except Exception` may swallow it)."""


class Watch:
    """Listens to the interpreter's audit events while an input is read. Make one a process: audit hooks stay for ever."""

    def __init__(self, inside: Path) -> None:
        """`inside` holds the captures; everything else but the program's own files is off limits."""
        self.inside = str(inside.resolve())
        own = (sys.prefix, sys.base_prefix, str(Path(__file__).resolve().parents[3]))
        self.allowed = (*(os.path.realpath(place) for place in own), *SYSTEM, f"/proc/{os.getpid()}/")
        self.escapes: list[str] = []
        self.on = False
        sys.addaudithook(self._hear)

    def _hear(self, event: str, arguments: tuple[Any, ...]) -> None:
        if not self.on:
            return
        if event == "code.__new__" and arguments[1] in COMPILED:
            return
        if event in RUNS:
            self.escapes.append(f"{event} {arguments!r:.200}")
        elif event == "exec":
            code = arguments[0]
            # No code of the file's: the program's own modules, typing's evaluation of its annotations, the package's page templates.
            own = str(getattr(code, "co_filename", "")).startswith((*self.allowed, "<frozen"))
            caller = sys._getframe(1).f_code.co_filename
            if not own and Path(caller).name != "typing.py" and not caller.endswith("/jinja2/environment.py"):
                self.escapes.append(f"exec of {code!r:.200}")
        elif event == "open":
            path, mode, flags = arguments
            if isinstance(path, int):
                return
            writes = bool((flags or 0) & (os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC)) or (
                isinstance(mode, str) and set(mode) & set("wax+")
            )
            place = os.path.realpath(os.fsdecode(path))
            if writes or not (place.startswith((self.inside + os.sep, *self.allowed))):
                self.escapes.append(f"open {place!r:.200} {mode}")
        elif event in CHANGES:
            self.escapes.append(f"{event} {arguments!r:.200}")

    @contextmanager
    def watching(self) -> Iterator[None]:
        """One input: `Hang` after five seconds of computing; the process ends when not even that can be raised."""
        self.escapes.clear()
        faulthandler.dump_traceback_later(DEAD, exit=True)
        for number in (signal.SIGPROF, signal.SIGALRM):
            signal.signal(number, self._late)
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        signal.setitimer(signal.ITIMER_REAL, WAITING)
        self.on = True
        try:
            yield
        finally:
            self.on = False
            signal.setitimer(signal.ITIMER_PROF, 0)
            signal.setitimer(signal.ITIMER_REAL, 0)
            faulthandler.cancel_dump_traceback_later()

    def _late(self, number: int, frame: Any) -> None:
        raise Hang(f"more than {SECONDS:g} seconds of computing" if number == signal.SIGPROF else f"more than {WAITING:g} seconds")


def bound_memory(more: int = MEMORY) -> None:
    """From now on this process may take `more` bytes beyond what it has."""
    status = Path("/proc/self/status").read_text(encoding="ascii")
    now = int(next(line for line in status.splitlines() if line.startswith("VmSize:")).split()[1]) * 1024
    resource.setrlimit(resource.RLIMIT_AS, (now + more, resource.getrlimit(resource.RLIMIT_AS)[1]))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def tree(folder: Path) -> dict[str, tuple[int, int]]:
    """Every file below a folder with size and time: what must be the same after the inputs."""
    return {str(path.relative_to(folder)): (path.lstat().st_size, path.lstat().st_mtime_ns) for path in sorted(folder.rglob("*"))}


def all_of(*readers: Callable[[], object]) -> None:
    """Call all; raise the first error that is no sentence, else the first."""
    errors: list[Exception] = []
    for read in readers:
        try:
            read()
        except Exception as error:
            errors.append(error)
    for error in sorted(errors, key=lambda error: isinstance(error, FieldfuseError)):
        raise error
