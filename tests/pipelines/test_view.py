"""The viewer, visited as a browser would: the page is there, a camera is rendered, controls work, Ctrl-C ends it."""

from __future__ import annotations

import signal
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from fieldfuse.camera import Array
from fieldfuse.files import read_json
from fieldfuse.pipelines.viewer import lens_of, pose_of
from tests.evaluation.driven import driven, until
from tests.pipelines.made import CAMERA, call, make_room
from tests.pipelines.short import FAST, HUNG, finished, start

Capsys = pytest.CaptureFixture[str]
msgspec, zstandard, viser = (pytest.importorskip(name) for name in ("msgspec", "zstandard", "viser"))


class Browser:
    """Speaks viser's protocol as its page does."""

    def __init__(self, port: int) -> None:
        from websockets.sync.client import connect
        from websockets.typing import Subprotocol

        protocol = Subprotocol(f"viser-v{viser.__version__}")
        self.socket = connect(f"ws://127.0.0.1:{port}", subprotocols=[protocol], max_size=2**26)
        self.seen: list[dict[str, Any]] = []

    def look(self, wxyz: Any, position: Any, fov: float, size: tuple[int, int]) -> None:
        camera = {"wxyz": [float(value) for value in wxyz], "position": [float(value) for value in position], "fov": fov}
        window = {"image_width": size[0], "image_height": size[1], "near": 0.01, "far": 1000.0}
        self.say("ViewerCameraMessage", **camera, **window, look_at=[0.0, 0.0, 0.0], up_direction=[0.0, 0.0, 1.0])

    def say(self, kind: str, **facts: Any) -> None:
        self.socket.send(msgspec.msgpack.encode({"type": kind, **facts}))

    def until(self, done: Callable[[dict[str, Any]], bool], seconds: float = HUNG) -> dict[str, Any]:
        """The first message for which it is so; all go to `seen`."""
        end = time.monotonic() + seconds
        while True:
            raw = self.socket.recv(timeout=max(end - time.monotonic(), 0.01))
            assert isinstance(raw, bytes)
            size, packed = (int.from_bytes(raw[at : at + 8], "little") for at in (0, 8))
            text = zstandard.ZstdDecompressor().decompress(raw[16 : 16 + packed], max_output_size=size)
            messages = msgspec.msgpack.decode(text)["messages"]
            self.seen += messages
            for message in messages:
                if done(message):
                    return dict(message)

    def picture(self, width: int) -> Array:
        """(H, W, 3) uint8, the next one that is so wide."""
        found = self.until(lambda message: _decoded(message).shape[1] == width)
        return _decoded(found)[..., ::-1]


def _decoded(message: dict[str, Any]) -> Array:
    """BGR of a message's picture; one of no width where it has none."""
    if message["type"] != "BackgroundImageMessage" or not message["rgb_data"]:
        return np.zeros((1, 0, 3), np.uint8)
    picture = cv2.imdecode(np.frombuffer(message["rgb_data"], np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    return picture


def kept(out: Path) -> int:
    """How many cameras are kept."""
    path = out / "cameras_kept.json"
    return len(read_json(path)["frames"]) if path.exists() else 0


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Any, int, Path]]:
    """The viewer of a small run at work, whose page has parts, its port, and the run. In the end Ctrl-C ends it without a word."""
    out = tmp_path_factory.mktemp("view") / "out"
    finished(out, 9, *FAST, "--quiet")
    (out / "exports" / "field_parts").mkdir(parents=True)
    for name in ("field.html", "field_parts/index.json"):
        (out / "exports" / name).write_text(name)
    process = start("view", out, "--port", 0, "--image-size", max(CAMERA.width, CAMERA.height), "--threads", 1, "--quiet")
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert "http://localhost:" in line, process.communicate()[1]
        page = process.stdout.readline().split()[0].replace("localhost", "127.0.0.1")
        with urllib.request.urlopen(page.replace("field.html", "field_parts/index.json"), timeout=HUNG) as part:
            assert page.endswith("/field.html") and part.read() == b"field_parts/index.json"
        yield process, int(line.split("http://localhost:")[1].split()[0]), out
        assert process.poll() is None  # visitors who leave end nothing
        process.send_signal(signal.SIGINT)
        said, errors = process.communicate(timeout=HUNG)
        assert process.returncode == 0 and said == errors == ""
    finally:
        process.kill()
        process.communicate()


@pytest.mark.slow
def test_a_visitor_sees_what_the_cameras_saw(served: tuple[Any, int, Path], capsys: Capsys) -> None:
    process, port, out = served
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=HUNG) as page:
        assert page.status == 200 and b"<html" in page.read().lower()
    browser = Browser(port)
    fov = float(2 * np.arctan(CAMERA.height / 2 / CAMERA.fy))
    browser.look((1, 0, 0, 0), (0, 0, 0), fov, (CAMERA.width, CAMERA.height))
    browser.picture(CAMERA.width)

    def placed(kind: str) -> dict[str, Any]:
        return next(message for message in browser.seen if message["type"] == kind and message.get("name") == "/cameras/0000")

    browser.look(placed("SetOrientationMessage")["wxyz"], placed("SetPositionMessage")["position"], fov, (CAMERA.width, CAMERA.height))
    shown = browser.picture(CAMERA.width)
    scored = cv2.imread(str(next((out / "renders").glob("field_000_*[!h].png"))))  # the first camera is held out, so its picture is there
    assert scored is not None and scored.shape == shown.shape
    assert 10 * np.log10(255**2 / np.mean((scored[..., ::-1].astype(float) - shown) ** 2)) > 28  # a JPEG of the same

    before = kept(out)
    keep = next(message for message in browser.seen if message["type"] == "GuiButtonMessage")
    browser.say("GuiUpdateMessage", uuid=keep["uuid"], updates={"value": True})
    browser.until(lambda message: message["type"] == "GuiUpdateMessage" and f"{before + 1} in" in str(message["updates"]))
    answer = call(capsys, "render", out, "--cameras", out / "cameras_kept.json", "--to", out / "again", "--threads", 1, "--quiet")
    assert answer.code == 0, answer.err
    again = cv2.imread(str(max((out / "again").glob("*.png"))))
    assert again is not None and abs(again.astype(int) - scored).max() <= 2  # the same camera, by way of the input's frame

    choice = next(message for message in browser.seen if message["type"] == "GuiDropdownMessage")
    browser.say("GuiUpdateMessage", uuid=choice["uuid"], updates={"value": "opacity"})
    grey = browser.picture(CAMERA.width).astype(int)
    assert np.ptp(grey, axis=2).max() < 8 and abs(shown.astype(int) - grey).mean() > 20
    browser.say("GuiUpdateMessage", uuid=choice["uuid"], updates={"value": choice["value"]})  # controls are every visitor's
    browser.picture(CAMERA.width)
    browser.socket.close()
    time.sleep(0.5)
    assert process.poll() is None  # a visitor who leaves ends nothing


@pytest.mark.slow
def test_the_page_shows_the_field_in_a_browser(served: tuple[Any, int, Path], capsys: Capsys, tmp_path: Path) -> None:
    _, port, out = served
    with driven(f"http://127.0.0.1:{port}", tmp_path, (640, 620)) as page:

        def at_rest() -> Array | None:
            """What stays the same for a while and is a picture of something."""
            first = page.picture()
            time.sleep(1.5)
            second = page.picture()
            return second if second[240:].std() > 10 and abs(first.astype(int) - second).max() < 8 else None

        before, count = until(at_rest), kept(out)
        page.drag((260, 340), (380, 320))
        shown = until(at_rest)
        assert abs(shown.astype(int) - before).mean() > 3  # another view of the room
        page.run("[...document.querySelectorAll('button')].find(one => one.textContent.includes('Keep')).click()")
        until(lambda: kept(out) > count)
        assert not page.errors
    answer = call(capsys, "render", out, "--cameras", out / "cameras_kept.json", "--to", out / "kept", "--threads", 1, "--quiet")
    assert answer.code == 0, answer.err
    picture = cv2.imread(str(max((out / "kept").glob("*.png"))))
    assert picture is not None
    again = cv2.resize(picture, shown.shape[1::-1], interpolation=cv2.INTER_LINEAR)
    below = slice(shown.shape[0] // 2, None)  # the upper half is beside, or behind, the page's controls
    off = [np.mean((again[below].astype(float) - one[below]) ** 2) for one in (shown, before)]
    assert 10 * np.log10(255**2 / off[0]) > 30 and off[0] < off[1] / 4, "the kept camera shows something else than the page did"


def test_an_address_that_is_not_ours_is_told(tmp_path: Path, capsys: Capsys) -> None:
    make_room(tmp_path / "room", 2)
    answer = call(capsys, "view", tmp_path / "room", "--out", tmp_path / "out", "--host", "203.0.113.7")
    assert answer.code == 2 and "203.0.113.7" in answer.sentence() and not (tmp_path / "out").exists()


def test_a_missing_viewer_is_told(tmp_path: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    answer = call(capsys, "view", tmp_path)
    assert answer.code == 2 and "pip install 'viser>=1'" in answer.sentence()


def test_a_window_becomes_a_lens() -> None:
    wide, tall = lens_of(np.pi / 2, 2.0, 400), lens_of(np.pi / 2, 0.5, 400)
    assert (wide.width, wide.height, wide.fy) == (400, 200, pytest.approx(100)) and (tall.width, tall.height) == (200, 400)
    assert np.allclose(pose_of((0, 0, 0, 2), (1, 2, 3)), [[-1, 0, 0, 1], [0, -1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
