"""What `fieldfuse view` serves of a run's exports: the page, its parts, and nothing else."""

from __future__ import annotations

import http.client
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from fieldfuse.errors import InputError
from fieldfuse.pipelines.page_server import PageServer, has_parts


@pytest.fixture
def server(tmp_path: Path) -> Iterator[PageServer]:
    parts = tmp_path / "run" / "exports" / "field_parts"
    parts.mkdir(parents=True)
    for name, text in (
        ("../field.html", "<p>page"),
        ("index.json", "{}"),
        ("00ff.bin", "part"),
        ("../mesh.ply", "no"),
        ("../../run.json", "no"),
    ):
        (parts / name).write_text(text)
    (tmp_path / "secret").write_text("no")
    (parts / "bad.bin").symlink_to(tmp_path / "secret")
    with PageServer(parts.parent, "127.0.0.1", 0) as found:
        yield found


def answer(server: PageServer, path: str, method: str = "GET") -> tuple[int, bytes, str | None]:
    connection = http.client.HTTPConnection("127.0.0.1", server.server.server_port, timeout=60)
    connection.request(method, path)
    got = connection.getresponse()
    return got.status, got.read(), got.getheader("Content-Type")


@pytest.mark.parametrize(
    ("path", "text"),
    [("/", b"<p>page"), ("/field.html?x#view=1", b"<p>page"), ("/field_parts/index.json", b"{}"), ("/field_parts/00ff.bin", b"part")],
)
def test_the_page_and_its_parts_are_served(server: PageServer, path: str, text: bytes) -> None:
    status, got, kind = answer(server, path)
    assert status == 200 and got == text and (kind or "").startswith(("text/html", "application/"))
    assert answer(server, path, "HEAD")[:2] == (200, b"")


@pytest.mark.parametrize(
    "path",
    [
        *(
            "/mesh.ply",
            "/run.json",
            "/../run.json",
            "/field_parts/../mesh.ply",
            "/field_parts/%2e%2e/mesh.ply",
            "/field_parts/",
            "//etc/passwd",
        ),
        *("/field_parts/bad.bin", "/field_parts/00fe.bin", "/field_parts/00ff.bin/", "/field.html/", "/field_parts/..%2f..%2frun.json"),
    ],
)
def test_nothing_else_is(server: PageServer, path: str) -> None:
    status, got, _ = answer(server, path)
    assert status == 404 and got != b"no"


def test_the_next_free_port_is_taken(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with PageServer(tmp_path, "127.0.0.1", port) as server:
            assert server.server.server_port != port
    assert not has_parts(tmp_path)


def test_a_host_of_others_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nothing can be served at --host 192\.0\.2\.1"):
        PageServer(tmp_path, "192.0.2.1", 0)
