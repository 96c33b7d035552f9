"""A server for `field.html` and the parts beside it, and nothing else of a run's folder."""

from __future__ import annotations

import re
import shutil
import socket
import threading
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import urlsplit

from fieldfuse.errors import InputError
from fieldfuse.export.parts import INDEX, PARTS
from fieldfuse.files import inside
from fieldfuse.pipelines.pictures import NAME

SERVED = re.compile(rf"{re.escape(NAME)}|{PARTS}/(?:{re.escape(INDEX)}|[0-9a-f]+\.bin)")
KINDS = {".html": "text/html; charset=utf-8", ".json": "application/json"}
PORTS = 20  # that are tried, from the wanted one on, before any free one is taken
CHUNK = 2**20  # bytes that are sent at a time


def has_parts(exports: Path) -> bool:
    """Whether the page in this folder loads details from beside it, and so has to be served."""
    return (exports / NAME).is_file() and (exports / PARTS / INDEX).is_file()


class PageServer:
    """Serves while it is entered as a context."""

    def __init__(self, exports: Path, host: str, port: int) -> None:
        """
        Args:
            port: the first that is tried.

        Raises:
            InputError: nothing can be served at `host`.
        """
        family = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)[0][0]
        kind = type("Server", (ThreadingHTTPServer,), {"address_family": family, "daemon_threads": True})
        for number in (*range(port, min(port + PORTS, 65536)), 0):
            try:
                self.server = kind((host, number), partial(_Handler, exports))
                break
            except OSError as error:
                if number == 0:
                    raise InputError(f"nothing can be served at --host {host} ({error.strerror or error}); try 127.0.0.1") from error
        name = "localhost" if host in ("127.0.0.1", "0.0.0.0", "::") else host
        self.address = f"http://{name}:{self.server.server_port}/{NAME}"

    def __enter__(self) -> PageServer:
        threading.Thread(target=self.server.serve_forever, name="page", daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self.server.shutdown()
        self.server.server_close()


class _Handler(BaseHTTPRequestHandler):
    def __init__(self, exports: Path, *given: object) -> None:
        self.exports = exports
        super().__init__(*given)  # type: ignore[arg-type]

    def do_GET(self) -> None:
        name = urlsplit(self.path).path.lstrip("/") or NAME
        try:
            if not SERVED.fullmatch(name):
                raise InputError(name)
            path = inside(self.exports, name)
            with path.open("rb") as source:
                self.send_response(200)
                self.send_header("Content-Type", KINDS.get(path.suffix, "application/octet-stream"))
                self.send_header("Content-Length", str(path.stat().st_size))
                self.send_header("Cache-Control", "no-cache" if path.suffix in KINDS else "max-age=31536000, immutable")
                self.end_headers()
                if self.command == "GET":
                    shutil.copyfileobj(source, self.wfile, CHUNK)
        except (ConnectionError, TimeoutError):  # the visitor left
            self.close_connection = True
        except (InputError, OSError):
            self.send_error(404)

    do_HEAD = do_GET

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing: the command's output is for people."""
