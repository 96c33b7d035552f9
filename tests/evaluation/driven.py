"""A page in headless Chromium that a test drives: looks at it, clicks, drags. For pages that go on talking to their server."""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from fieldfuse.camera import Array

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
FLAGS = ("--headless", "--no-sandbox", "--disable-dev-shm-usage", "--no-first-run", "--disable-background-networking", "--disable-sync")
NO_GPU = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")  # WebGL by the processor
START_SECONDS = 240.0  # after which a page counts as hung, on the busiest machine


def chromium() -> str:
    """A Chromium, or skip with the reason."""
    found = os.environ.get("CHROMIUM") or next((path for name in NAMES if (path := shutil.which(name))), None)
    if not found:
        pytest.skip("no Chromium is installed (apt-get install chromium, or set CHROMIUM); the page was only taken apart")
    return found


class Driven:
    """One page, spoken to by the DevTools protocol."""

    def __init__(self, address: str) -> None:
        from websockets.sync.client import connect

        self.socket = connect(address, max_size=2**27)
        self.asked = 0
        self.errors: list[str] = []  # what scripts threw, and what the page could not load
        for part in ("Page", "Runtime", "Log"):
            self.ask(f"{part}.enable")

    def ask(self, method: str, **values: Any) -> dict[str, Any]:
        """The answer to one command; errors that the page tells meanwhile are kept."""
        self.asked += 1
        self.socket.send(json.dumps({"id": self.asked, "method": method, "params": values}))
        while True:
            told = json.loads(self.socket.recv(timeout=START_SECONDS))
            if told.get("method") == "Runtime.exceptionThrown":
                details = told["params"]["exceptionDetails"]
                self.errors.append(f"{details.get('text')} {details.get('exception', {}).get('description', '')}")
            elif told.get("method") == "Log.entryAdded" and told["params"]["entry"]["level"] == "error":
                self.errors.append(str(told["params"]["entry"]["text"]))
            elif told.get("id") == self.asked:
                assert "error" not in told, told["error"]
                return dict(told["result"])

    def run(self, script: str) -> Any:
        """The value of an expression on the page."""
        return self.ask("Runtime.evaluate", expression=script, returnByValue=True)["result"].get("value")

    def picture(self) -> Array:
        """(H, W, 3) uint8 BGR: what a person would see now."""
        found = cv2.imdecode(np.frombuffer(base64.b64decode(self.ask("Page.captureScreenshot")["data"]), np.uint8), cv2.IMREAD_COLOR)
        assert found is not None
        return found

    def drag(self, start: tuple[int, int], end: tuple[int, int], steps: int = 8, shift: bool = False) -> None:
        """With the left button held from one place of the page to another."""
        held = {"button": "left", "buttons": 1, "clickCount": 1, "modifiers": 8 if shift else 0}
        places = [tuple(np.add(start, np.subtract(end, start) * i / steps)) for i in range(steps + 1)]
        for kind, (x, y) in [("mousePressed", places[0]), *(("mouseMoved", place) for place in places), ("mouseReleased", places[-1])]:
            self.ask("Input.dispatchMouseEvent", type=kind, x=float(x), y=float(y), **held)
            time.sleep(0.03)


def until(found: Callable[[], Any], seconds: float = START_SECONDS, every: float = 0.25) -> Any:
    """The first answer that is neither None nor False; an AssertionError when none comes in time."""
    end = time.monotonic() + seconds
    while (answer := found()) is None or answer is False:
        assert time.monotonic() < end, "what was waited for did not come"
        time.sleep(every)
    return answer


@contextmanager
def driven(url: str, scratch: Path, size: tuple[int, int]) -> Iterator[Driven]:
    """A page of (width, height) pixels in a Chromium of its own, which ends with the block; skips where there is no Chromium."""
    home = scratch / "driven"
    command = [chromium(), *FLAGS, *NO_GPU, f"--user-data-dir={home}", f"--window-size={size[0]},{size[1]}", "--remote-debugging-port=0"]
    process = subprocess.Popen([*command, url], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        told = home / "DevToolsActivePort"
        port = until(lambda: told.read_text().split()[0] if told.exists() and told.stat().st_size else None)

        def page() -> Any:
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=START_SECONDS) as answer:
                return next((one["webSocketDebuggerUrl"] for one in json.load(answer) if one["type"] == "page"), None)

        found = Driven(until(page))
        yield found
        found.socket.close()
    finally:
        process.terminate()
        process.wait(timeout=START_SECONDS)
