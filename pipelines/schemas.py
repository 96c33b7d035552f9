"""JSON that earlier commands left in a run's folder, checked before anything relies on it: it may be damaged, or somebody else's."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, create_model

from fieldfuse.errors import InputError, brief
from fieldfuse.files import read_json

LARGEST = 1e300  # numbers beyond it cannot be computed with
# Types are made while this is loaded, so that a type checker takes them for values.
Many: Any = list
ByName: Any = dict
Number: Any = Annotated[float, Field(gt=-LARGEST, lt=LARGEST)]
Maybe: Any = Number | None
Numbers = ByName[str, Maybe]
NO_OTHERS = object()


def table(name: str, others: Any = NO_OTHERS, /, **keys: Any) -> Any:
    """The form of a JSON object: keys → types, (type, default) for keys that may be missing; `others`: type of all other keys."""
    extra = {"__pydantic_extra__": ByName[str, others]} if others is not NO_OTHERS else {}
    config = ConfigDict(strict=True, extra="allow" if extra else "forbid")
    base = type(name, (BaseModel,), {"__annotations__": extra, "__module__": __name__, "model_config": config})
    fields: Any = {key: kind if isinstance(kind, tuple) else (kind, ...) for key, kind in keys.items()}
    return create_model(name, __base__=base, **fields)


Text = (str | None, None)
Mesh = table("Mesh", vertices=Number, triangles=Number, watertight=bool, components=Number, area=Number, bounds=Many[Many[Number]])
View = table("View", Number | str | None, index=Number, name=str, depth=(Numbers | None, None))
Scores = table(
    "Scores",
    Number | bool | None,
    per_view=(Many[View], []),
    depth=(Numbers | None, None),
    mesh=(Mesh | None, None),
    depth_from=Text,
    on=(ByName[str, Numbers], {}),
)
Wanted = table("Wanted", Maybe, decoder=Text, precision=Text)
Setting = table("Setting", Maybe, decoder=Text, precision=Text, wanted=(Wanted | None, None))
Point = table(
    "Point",
    Maybe,
    method=str,
    setting=Setting,
    stages=(Numbers | None, None),
    load=(Many[Maybe] | None, None),
    axes=(Many[str] | None, None),
    id=Text,
    variant=Text,
    error=Text,
    measured=(Any, None),
    wanted=(Wanted | None, None),
    changed=(Wanted | None, None),
)
Finding = table(
    "Finding",
    Any,
    effect=str,
    there=bool,
    number=Number,
    threshold=Number,
    reason=str,
    held_out=(table("HeldOut", Any, before=Number, after=Number, unit=str) | None, None),
    wish=(str, ""),
    on=(bool, False),
    note=(str, ""),
    seconds=(Number, 0),
    decided_by=(str, ""),
    trial=(ByName[str, Number], {}),
)
LookedAt = table("LookedAt", Any, frames=Number, points=Number, points_seconds=(Number, 0))

NOTES = Many[str]
EVALUATION = ByName[str, Scores]
TIMELINE = Many[table("Moment", Number | str | None, seconds=Number, psnr=Maybe)]
Effects = table("Effects", effects=Many[Finding], seconds=Number, corrections=(ByName[str, Any], {}), looked_at=LookedAt)
Matched = table("Matched", views=Number, pixels=Number, share=Number, bare=(Number, 0), seconds=Number)
Network = table(
    "Network",
    key_frames=Number,
    seconds=Number,
    fusion_seconds=(Number, 0),
    encode_seconds=Number,
    first_preview_seconds=Number,
    resolution=Number,
)
ExportFacts = table("ExportFacts", mesh=Mesh | None, notes=(Many[str], []), note=Text, part=(str, "off"))
CompareScores = table(
    "CompareScores", scores=EVALUATION, geometry=ByName[str, Numbers] | None, seen_share=Maybe, matching=Numbers | None
)
Tradeoff = table("Tradeoff", Any, rows=Many[Point], command=str, unit=str | None, machine=ByName[str, Number | str | None])
MeasuredPoint = table("MeasuredPoint", key=str, crashed=bool, wall_seconds=Number, rows=Many[Point])


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
    """`exports/facts.json`; earlier versions wrote one note, or none, and no part.

    Raises:
        InputError: it cannot be read, or it has another form.
    """
    facts: dict[str, Any] = read_checked(path, ExportFacts)
    note = facts.pop("note", None)
    return {"notes": [] if note is None else [note], "part": "off", **facts}
