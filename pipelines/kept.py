"""JSON that earlier commands left in a run's folder, looked at before anything relies on it: it may be damaged, or somebody else's."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from fieldfuse.errors import InputError
from fieldfuse.files import read_json

NUMBER = "a number"
TEXT = "text"
FLAG = "true or false"
LARGEST = 1e300  # numbers beyond it cannot be computed with

# A form is NUMBER, TEXT or FLAG; None (null); a tuple of forms, one of which fits; a list of one form, for each entry; a table of forms,
# where keys with a question mark may be missing and "*" stands for all that are not named.
ANY = "anything"
MAYBE = (None, NUMBER)
NUMBERS = {"*": MAYBE}
MESH = {
    "vertices": NUMBER, "triangles": NUMBER, "watertight": FLAG, "components": NUMBER, "area": NUMBER, "bounds": [[NUMBER]]
}  # fmt: skip
VIEW = {"index": NUMBER, "name": TEXT, "?depth": (None, NUMBERS), "*": (None, NUMBER, TEXT)}
SCORES = {
    "?per_view": [VIEW], "?depth": (None, NUMBERS), "?mesh": (None, MESH), "?depth_from": (None, TEXT), "?on": {"*": NUMBERS},
    "*": (None, NUMBER, FLAG)
}  # fmt: skip
EVALUATION = {"*": SCORES}
COMPARED = {"scores": EVALUATION, "geometry": (None, {"*": NUMBERS}), "seen_share": MAYBE, "matching": (None, NUMBERS)}
WANTED = {"?decoder": (None, TEXT), "?precision": (None, TEXT), "*": MAYBE}
SETTING = {**WANTED, "?wanted": (None, WANTED)}
POINT = {
    "method": TEXT, "setting": SETTING, "?stages": (None, NUMBERS), "?load": (None, [MAYBE]), "?axes": (None, [TEXT]), "?id": (None, TEXT),
    "?variant": (None, TEXT), "?error": (None, TEXT), "?measured": ANY, "?wanted": (None, WANTED), "?changed": (None, WANTED), "*": MAYBE
}  # fmt: skip
TRADEOFF = {"rows": [POINT], "command": TEXT, "unit": (None, TEXT), "machine": {"*": (None, NUMBER, TEXT)}, "*": ANY}
MEASURED_POINT = {"key": TEXT, "crashed": FLAG, "wall_seconds": NUMBER, "rows": [POINT]}
EXPORT_FACTS = {"mesh": (None, MESH), "?notes": [TEXT], "?note": (None, TEXT)}
TIMELINE = [{"seconds": NUMBER, "psnr": (None, NUMBER), "*": (None, NUMBER, TEXT)}]
NOTES = [TEXT]
MATCHED = {"views": NUMBER, "pixels": NUMBER, "share": NUMBER, "?bare": NUMBER, "seconds": NUMBER}
NETWORK = {
    "key_frames": NUMBER, "seconds": NUMBER, "?fusion_seconds": NUMBER, "encode_seconds": NUMBER, "first_preview_seconds": NUMBER,
    "resolution": NUMBER,
}  # fmt: skip
HELD_OUT = {"before": NUMBER, "after": NUMBER, "unit": TEXT, "*": ANY}
FINDING = {
    "effect": TEXT, "there": FLAG, "number": NUMBER, "threshold": NUMBER, "reason": TEXT, "?held_out": (None, HELD_OUT),
    "?wish": TEXT, "?on": FLAG, "?note": TEXT, "?seconds": NUMBER, "?decided_by": TEXT, "?trial": {"without": NUMBER, "with": NUMBER},
    "*": ANY
}  # fmt: skip
EFFECTS = {
    "effects": [FINDING], "seconds": NUMBER, "?corrections": {"*": ANY},
    "looked_at": {"frames": NUMBER, "points": NUMBER, "?points_seconds": NUMBER, "*": ANY}
}  # fmt: skip


def read_kept(path: Path, form: Any) -> Any:
    """The JSON file at `path`, which must have the `form`.

    Raises:
        InputError: it cannot be read, or it has another form.
    """
    return fitting(read_json(path), form, path)


def read_export_facts(path: Path) -> dict[str, Any]:
    """`exports/facts.json`; earlier versions kept one note, or none.

    Raises:
        InputError: it cannot be read, or it has another form.
    """
    facts: dict[str, Any] = read_kept(path, EXPORT_FACTS)
    note = facts.pop("note", None)
    return {"notes": [] if note is None else [note], **facts}


def fitting(value: Any, form: Any, path: Path) -> Any:
    """`value`, read from `path`, when it has the form.

    Raises:
        InputError: it has another.
    """
    if wrong := misfit(value, form):
        raise InputError(f"{path} is damaged ({wrong}); remove it and run the command again")
    return value


def misfit(value: Any, form: Any, where: str = "the whole") -> str:
    """What does not have the form, and where; empty when all fits. Numbers are finite everywhere, also under "anything"."""
    if isinstance(form, tuple):
        told = [misfit(value, one, where) for one in form]
        return "" if "" in told else told[-1]
    if form is None:
        return "" if value is None else f"{where} is not null"
    if isinstance(form, str):
        return _plain(value, form, where)
    if isinstance(form, list):
        if not isinstance(value, list):
            return f"{where} is not a list"
        return next((wrong for index, one in enumerate(value) if (wrong := misfit(one, form[0], f"{where}[{index}]"))), "")
    if not isinstance(value, dict):
        return f"{where} is not a table"
    named = {key.removeprefix("?"): one for key, one in form.items() if key != "*"}
    missing = [key for key in form if key not in value and not key.startswith("?") and key != "*"]
    if missing:
        return f"{where} has no {missing[0]!r}"
    others = form.get("*")
    unknown = [key for key in value if key not in named]
    if unknown and others is None:
        return f"{where} has {unknown[0]!r:.40}"
    return next((wrong for key, one in value.items() if (wrong := misfit(one, named.get(key, others), f"{key:.40}"))), "")


def _plain(value: Any, form: str, where: str) -> str:
    if form == ANY:
        return _finite(value, where)
    if form == FLAG:
        return "" if isinstance(value, bool) else f"{where} is not {form}"
    if form == TEXT:
        return "" if isinstance(value, str) else f"{where} is not {form}"
    fits = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < LARGEST
    return "" if fits else f"{where} is not {form}"


def _finite(value: Any, where: str) -> str:
    if isinstance(value, dict):
        return next((wrong for key, one in value.items() if (wrong := _finite(one, f"{key:.40}"))), "")
    if isinstance(value, list):
        return next((wrong for index, one in enumerate(value) if (wrong := _finite(one, f"{where}[{index}]"))), "")
    if isinstance(value, int | float) and not isinstance(value, bool):
        return "" if not (isinstance(value, float) and math.isnan(value)) and abs(value) < LARGEST else f"{where} is not finite"
    return ""
