"""Pages looked at: in headless Chromium where it is installed, and taken apart without one."""

from __future__ import annotations

import base64
import html as escapes
import json
import os
import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest

from fieldfuse.camera import Array

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
# Collected before the page's own scripts run, told after everything has loaded.
BEFORE = (
    "<script>window.seenErrors = []; window.addEventListener('error', e => window.seenErrors.push(e.message || 'failed to load'));</script>"
)
AFTER = """<script>
window.addEventListener('load', () => {
  const all = [...document.images];
  for (const details of document.querySelectorAll('details')) details.open = true;
  const broken = [];
  for (const image of all)
    if (!image.complete || !image.naturalWidth || !image.getBoundingClientRect().width) broken.push(image.alt);
  const told = document.createElement('pre');
  told.id = 'told';
  told.textContent = JSON.stringify({pictures: all.length, broken: broken, errors: window.seenErrors, title: document.title});
  document.body.append(told);
});
</script>"""


@dataclass(frozen=True)
class Seen:
    """What a browser made of a page."""

    pictures: int
    broken: list[str]  # texts of pictures that do not load or have no size on the page
    errors: list[str]
    title: str


def chromium() -> str:
    """A Chromium, or skip with the reason."""
    found = os.environ.get("CHROMIUM") or next((path for name in NAMES if (path := shutil.which(name))), None)
    if not found:
        pytest.skip("no Chromium is installed (apt-get install chromium, or set CHROMIUM); the page was only taken apart")
    return found


def open_page(page: Path, scratch: Path) -> Seen:
    """Load a copy of the page that reports on itself in headless Chromium."""
    program = chromium()
    text = page.read_text(encoding="utf-8")
    copy = scratch / f"watched-{page.name}"
    copy.write_text(text.replace("<head>", "<head>" + BEFORE, 1).replace("</body>", AFTER + "</body>", 1), encoding="utf-8")
    command = [program, "--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run"]
    command += [f"--user-data-dir={scratch / 'browser'}", "--timeout=300000", "--virtual-time-budget=20000", "--window-size=1300,900"]
    done = subprocess.run([*command, "--dump-dom", copy.as_uri()], capture_output=True, text=True, timeout=400, check=False)
    told = re.search(r'<pre id="told">(.*?)</pre>', done.stdout, re.DOTALL)
    assert told is not None, f"Chromium did not finish the page: {done.stderr[-1500:]}"
    return Seen(**json.loads(escapes.unescape(told[1])))


def embedded_pictures(html: str) -> list[Array | None]:
    """Every embedded picture decoded, None where it cannot be."""
    out: list[Array | None] = []
    for data in re.findall(r'<img[^>]* src="data:image/(?:png|jpeg);base64,([^"]*)"', html):
        picture = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
        out.append(picture if picture is not None and picture.size else None)
    return out
