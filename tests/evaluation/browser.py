"""Pages looked at: in headless Chromium where it is installed, and taken apart without one."""

from __future__ import annotations

import base64
import re
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from fieldfuse.camera import Array
from tests.evaluation.driven import driven, until

LOOK = """(() => {
  for (const details of document.querySelectorAll('details')) details.open = true;
  const all = [...document.images];
  const whole = image => image.complete && image.naturalWidth && image.getBoundingClientRect().width;
  return {pictures: all.length, broken: all.filter(image => !whole(image)).map(image => image.alt), title: document.title};
})()"""


@dataclass(frozen=True)
class Seen:
    """What a browser made of a page."""

    pictures: int
    broken: list[str]  # texts of pictures that do not load or have no size on the page
    title: str
    errors: list[str]


def open_page(page: Path, scratch: Path) -> Seen:
    """Load a page in headless Chromium and look at all of it."""
    with driven("about:blank", scratch, (1300, 900)) as browser:
        browser.ask("Page.navigate", url=page.as_uri())
        until(lambda: browser.run(f"location.href === '{page.as_uri()}' && document.readyState === 'complete'"))
        return Seen(**browser.run(LOOK), errors=browser.errors)


def embedded_pictures(html: str) -> list[Array | None]:
    """Every embedded picture decoded, None where it cannot be."""
    out: list[Array | None] = []
    for data in re.findall(r'<img[^>]* src="data:image/(?:png|jpeg);base64,([^"]*)"', html):
        picture = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
        out.append(picture if picture is not None and picture.size else None)
    return out
