"""What a node must have before it gets work: an address that answers, the same versions, the same storage."""

from __future__ import annotations

import errno
import os
import socket
import subprocess
import sys
import tempfile
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from fieldfuse.errors import InputError, OutputError

ANSWER = 5.0  # seconds in which an address must accept a connection
CONNECT = 45.0  # seconds in which Ray must answer at it
SHARED = "put it on storage that all nodes mount at the same path (or, for a batch, use --upload)"


def examiner() -> Callable[[str | None, list[str]], dict[str, Any]]:
    """The function with which a node looks at itself. Ray sends a local function as code: the node may not have this package."""

    def examine(probe: str | None, sources: list[str]) -> dict[str, Any]:
        import os
        import platform

        import ray

        found: dict[str, Any] = {"Python": platform.python_version(), "Ray": ray.__version__, "fieldfuse": None, "write": None}
        try:
            import fieldfuse

            found["fieldfuse"] = fieldfuse.__version__
        except Exception:  # missing, or broken in whatever way
            pass
        found["probe"] = probe is not None and os.path.isfile(probe)  # noqa: PTH113
        found["missing"] = [path for path in sources if not os.path.exists(path)]  # noqa: PTH110
        if found["probe"]:
            own = f"{probe}-{os.getpid()}"
            try:
                with open(own, "wb") as file:  # noqa: PTH123
                    file.write(bytes(2**20))
                    file.flush()
                    os.fsync(file.fileno())
            except OSError as error:
                found["write"] = error.strerror or str(error)
            finally:
                if os.path.exists(own):  # noqa: PTH110
                    os.remove(own)  # noqa: PTH107
        return found

    return examine


def require(name: str, found: dict[str, Any], expected: dict[str, str], out: Path | None) -> None:
    """Refuse a node that is not as this machine is.

    Raises:
        InputError, OutputError: see `Workers.check`.
    """
    for what, version in expected.items():
        if found[what] is None:
            raise InputError(f"the node {name} cannot import {what}; install {what} {version} there, in the environment of its Ray")
        if found[what] != version:
            raise InputError(f"the node {name} has {what} {found[what]} and this machine {version}; install the same version on both")
    if out is None:
        return
    if not found["probe"]:
        raise InputError(f"the node {name} does not see {out.absolute()}; {SHARED}")
    if found["missing"]:
        raise InputError(f"the node {name} does not see {found['missing'][0]}; {SHARED}")
    if found["write"]:
        raise OutputError(f"the node {name} cannot write in {out.absolute()}: {found['write']}; free space there or choose another --out")


@contextmanager
def probe(out: Path | None) -> Iterator[Path | None]:
    """A small file in `out` by which others see that they have the same storage; None without a folder.

    Raises:
        OutputError: it cannot be written.
    """
    if out is None:
        yield None
        return
    path = out.absolute() / f".tmp-{os.getpid()}-probe-{uuid.uuid4().hex[:8]}"
    made = [place for place in (out.absolute(), *out.absolute().parents) if not place.exists()]
    try:
        out.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"fieldfuse")
        yield path
    except OSError as error:
        raise OutputError(f"cannot write in {out}: {error.strerror or error}; free space or choose another --out") from error
    finally:
        with suppress(OSError):
            path.unlink(missing_ok=True)
            for place in made:  # a refusal leaves nothing behind
                place.rmdir()


CHILD = "import ray, sys; ray.init(address=sys.argv[1], logging_level='ERROR', log_to_driver=False); ray.nodes()"


def require_answer(address: str) -> None:
    """See that Ray answers at an address: first whether anything listens there, then, in a process of its own, whether it is a Ray that
    takes us. Ray itself waits for two minutes and then ends the process that asked.

    Raises:
        InputError: in all other cases.
    """
    if address != "auto":
        host, _, port = address.rpartition(":")
        if not host or not port.isdigit() or not 0 < int(port) < 65536:
            raise InputError(f"the address {address!r} is neither auto nor HOST:PORT; `ray start --head` prints it (usually port 6379)")
        try:
            socket.create_connection((host.strip("[]"), int(port)), timeout=ANSWER).close()
        except OSError as error:
            reason = "no answer" if isinstance(error, TimeoutError) or error.errno == errno.EHOSTUNREACH else error.strerror or error
            raise InputError(f"nothing answers at {address} ({reason}); start Ray there (ray start --head), or correct it") from error
    with tempfile.TemporaryFile() as said:
        command = [sys.executable, "-c", CHILD, address]
        child = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=said, stderr=said, start_new_session=True)
        try:
            code = child.wait(CONNECT)
        except subprocess.TimeoutExpired:
            raise InputError(f"no Ray answers at {address} within {CONNECT:.0f} s; see that it is the port of a head node (6379)") from None
        finally:
            child.kill()
            child.wait()
        said.seek(0)
        lines = [line.strip() for line in said.read().decode(errors="replace").splitlines() if line.strip()]
    if code == 0:
        return
    if any("Version mismatch" in line for line in lines):
        versions = " ".join(line for line in lines if line.startswith(("Ray:", "Python:", "This process")))
        raise InputError(f"the cluster at {address} has another version than this machine ({versions[:200]}); install the same on both")
    if any("AuthenticationError" in line or "InvalidAuthToken" in line for line in lines):
        where = "~/.ray/auth_token here, and set RAY_AUTH_MODE=token"
        raise InputError(f"the cluster at {address} wants its token; put what `ray get-auth-token` prints at its head into {where}")
    if address == "auto" and any("Could not find any running Ray" in line for line in lines):
        raise InputError("no Ray runs on this machine; start it (ray start --head, or ray start --address HOST:PORT), or give no --address")
    if any(word in line for line in lines for word in ("node_ip_address", "Can't find", "no raylet", "this node")):
        raise InputError(f"this machine is not a node of the cluster at {address}; make it one: ray start --address {address}")
    reason = lines[-1][-200:] if lines else f"exit code {code}"
    raise InputError(f"Ray at {address} refused to be used: {reason}; look at it with: ray status --address {address}")
