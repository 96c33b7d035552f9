"""Numbers as people read them, for the report and the terminal. None becomes a dash."""

from __future__ import annotations

import re
from typing import Any

NONE = "–"
SCORE = ("views", "psnr", "ssim", "lpips", "depth_abs_err", "seconds_per_view")  # what a method's score has, null where it is not known


def decimal(value: float | None, digits: int = 2) -> str:
    return NONE if value is None else f"{value:.{digits}f}"


def significant(value: float | None) -> str:
    """Three significant digits, without an exponent where people would not write one."""
    if value is None:
        return NONE
    if abs(value) >= 1000:
        return f"{value:,.0f}"
    return f"{value:.3g}" if value == 0 or abs(value) >= 1e-4 else f"{value:.2e}"


def whole(value: float | None) -> str:
    """1234567 → 1,234,567."""
    return NONE if value is None else f"{value:,.0f}"


def size(count: float | None) -> str:
    """Bytes in decimal units."""
    if count is None:
        return NONE
    for unit in ("bytes", "kB", "MB", "GB"):
        if count < 999.5 or unit == "GB":
            return f"{count:.0f} {unit}" if unit == "bytes" or count >= 99.5 else f"{count:.1f} {unit}"
        count /= 1000
    return NONE


def memory(megabytes: float | None) -> str:
    return NONE if megabytes is None else size(megabytes * 1e6)


def duration(seconds: float | None) -> str:
    """0.012 → 12 ms, 4.2 → 4.2 s, 60 → 1 min, 372 → 6 min 12 s, 7322 → 2 h 2 min."""
    if seconds is None:
        return NONE
    if seconds < 0.0995:
        return f"{seconds * 1000:.0f} ms"
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    total = round(seconds)
    if total < 60:
        return f"{total} s"
    if total < 3600:
        return _two(total, "min", "s")
    return _two(round(seconds / 60), "h", "min")


def _two(total: int, large: str, small: str) -> str:
    """60 of the small unit make a large one; none of it is not shown."""
    return f"{total // 60} {large}" + (f" {total % 60} {small}" if total % 60 else "")


def counted(count: float | None, thing: str) -> str:
    """1 key frame, 1,234 key frames."""
    return f"{whole(count)} {thing}{'' if count == 1 else 's'}"


def held(text: str) -> str:
    """No line ends between a number and its unit: `7 min 34 s` breaks before 34 alone."""
    return re.sub(r"(?<=\d) (?=[^\W\d])", "\N{NO-BREAK SPACE}", text)


def share(value: float | None) -> str:
    return NONE if value is None else f"{100 * value:.1f}%"


def unit_of(data: dict[str, Any]) -> str:
    """The unit of lengths in a report's data: metres for captures with scale, else working units."""
    scene = data.get("scene")
    return "m" if isinstance(scene, dict) and scene.get("metric") else "units"
