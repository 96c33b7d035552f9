"""JSON that earlier commands left in a run's folder, checked before anything relies on it: it may be damaged, or somebody else's."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from fieldfuse.errors import InputError, brief
from fieldfuse.files import read_json

LARGEST = 1e300  # numbers beyond it cannot be computed with
Number = Annotated[float, Field(gt=-LARGEST, lt=LARGEST)]
Numbers = dict[str, Number | None]
Cell = Number | bool | str | None


class Table(BaseModel):
    """Keys that are named and no others."""

    model_config = ConfigDict(strict=True, extra="forbid")


class OpenTable(BaseModel):
    """Keys that are named, and others of any finite content."""

    model_config = ConfigDict(strict=True, extra="allow")


class Mesh(Table):
    vertices: Number
    triangles: Number
    watertight: bool
    components: Number
    area: Number
    bounds: list[list[Number]]


class View(OpenTable):
    index: Number
    name: str
    depth: Numbers | None = None
    __pydantic_extra__: dict[str, Number | str | None]


class Scores(OpenTable):
    per_view: list[View] = []
    depth: Numbers | None = None
    mesh: Mesh | None = None
    depth_from: str | None = None
    on: dict[str, Numbers] = {}
    __pydantic_extra__: dict[str, Number | bool | None]


class CompareScores(Table):
    scores: dict[str, Scores]
    geometry: dict[str, Numbers] | None
    seen_share: Number | None
    matching: Numbers | None


class Wanted(OpenTable):
    decoder: str | None = None
    precision: str | None = None
    __pydantic_extra__: dict[str, Number | None]


class Setting(Wanted):
    wanted: Wanted | None = None


class Point(OpenTable):
    method: str
    setting: Setting
    stages: Numbers | None = None
    load: list[Number | None] | None = None
    axes: list[str] | None = None
    id: str | None = None
    variant: str | None = None
    error: str | None = None
    measured: Any = None
    wanted: Wanted | None = None
    changed: Wanted | None = None
    __pydantic_extra__: dict[str, Number | None]


class Tradeoff(OpenTable):
    rows: list[Point]
    command: str
    unit: str | None
    machine: dict[str, Number | str | None]


class MeasuredPoint(Table):
    key: str
    crashed: bool
    wall_seconds: Number
    rows: list[Point]


class ExportFacts(Table):
    mesh: Mesh | None
    notes: list[str] = []
    note: str | None = None


class Moment(OpenTable):
    seconds: Number
    psnr: Number | None
    __pydantic_extra__: dict[str, Number | str | None]


class Matched(Table):
    views: Number
    pixels: Number
    share: Number
    bare: Number = 0
    seconds: Number


class Network(Table):
    key_frames: Number
    seconds: Number
    fusion_seconds: Number = 0
    encode_seconds: Number
    first_preview_seconds: Number
    resolution: Number


class HeldOut(OpenTable):
    before: Number
    after: Number
    unit: str


class Finding(OpenTable):
    effect: str
    there: bool
    number: Number
    threshold: Number
    reason: str
    held_out: HeldOut | None = None
    wish: str = ""
    on: bool = False
    note: str = ""
    seconds: Number = 0
    decided_by: str = ""
    trial: dict[str, Number] = {}


class LookedAt(OpenTable):
    frames: Number
    points: Number
    points_seconds: Number = 0


class Effects(Table):
    effects: list[Finding]
    seconds: Number
    corrections: dict[str, Any] = {}
    looked_at: LookedAt


EVALUATION, TIMELINE, NOTES = dict[str, Scores], list[Moment], list[str]


@cache
def _adapter(form: Any) -> TypeAdapter[Any]:
    return TypeAdapter(form, config=None if isinstance(form, type) and issubclass(form, BaseModel) else ConfigDict(strict=True))


def read_checked(path: Path, form: Any) -> Any:
    """The JSON file at `path`, which must have the `form`, as plain data.

    Raises:
        InputError: it cannot be read, or it has another form.
    """
    return checked(read_json(path), form, path)


def checked(value: Any, form: Any, path: Path) -> Any:
    """`value`, read from `path`, when it has the form and its numbers are finite.

    Raises:
        InputError: it has another.
    """
    try:
        json.dumps(value, allow_nan=False)
        _adapter(form).validate_python(value)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        wrong = brief(f"{'.'.join(map(str, first['loc'])) or 'the whole'}: {first['msg'][:1].lower()}{first['msg'][1:]}")
        raise InputError(f"{path} is damaged ({wrong}); remove it and run the command again") from error
    except ValueError as error:
        raise InputError(f"{path} is damaged (a number is not finite); remove it and run the command again") from error
    return value


def read_export_facts(path: Path) -> dict[str, Any]:
    """`exports/facts.json`; earlier versions wrote one note, or none.

    Raises:
        InputError: it cannot be read, or it has another form.
    """
    facts: dict[str, Any] = read_checked(path, ExportFacts)
    note = facts.pop("note", None)
    return {"notes": [] if note is None else [note], **facts}
