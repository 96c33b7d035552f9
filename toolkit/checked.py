"""Plain data and YAML to checked dataclasses: pydantic looks at every value, and what does not fit becomes one sentence."""

from __future__ import annotations

import difflib
import json
import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from typing import Annotated, Any, TypeVar

import yaml
from pydantic import BeforeValidator, Field, TypeAdapter, ValidationError
from pydantic_core import PydanticCustomError

from fieldfuse.errors import InputError, brief, first_line

MAX_YAML = 2**18  # characters
MAX_NESTING = 16
T = TypeVar("T")

Positive = Annotated[int, Field(gt=0, lt=10**9)]
NotNegative = Annotated[int, Field(ge=0, lt=2**63)]
PositiveNumber = Annotated[float, Field(gt=0, lt=1e9, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, lt=2**63, allow_inf_nan=False)]  # any number that is not below 0


def nearest(name: str, known: Iterable[str], cutoff: float = 0.6) -> str:
    """` (did you mean 'x'?)` for the nearest of the known names; empty where none is near."""
    near = difflib.get_close_matches(name, list(known), n=1, cutoff=cutoff)
    return f" (did you mean {near[0]!r}?)" if near else ""


def one_of(*choices: str) -> BeforeValidator:
    """For `Annotated[str, …]`. YAML reads a bare on and off as true and false; they are what was written where `off` is a choice."""

    def check(value: Any) -> Any:
        if isinstance(value, bool) and "off" in choices:
            value = "on" if value else "off"
        if value not in choices:
            sentence = f"it must be one of {', '.join(choices)}{nearest(str(value), choices)}"
            raise PydanticCustomError("choice", "{sentence}", {"sentence": sentence})
        return value

    return BeforeValidator(check)


def names_of(kind: str, known: tuple[str, ...]) -> BeforeValidator:
    """For a list of names."""

    def check(values: Any) -> Any:
        for value in values if isinstance(values, list) else ():
            if value not in known:
                sentence = f"there is no {kind} {brief(repr(value))}{nearest(str(value), known)}; known are {', '.join(known)}"
                raise PydanticCustomError("name", "{sentence}", {"sentence": sentence})
        return values

    return BeforeValidator(check)


@cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    return TypeAdapter(kind)


def checked(kind: type[T], data: Mapping[str, Any], where: str) -> T:
    """An instance of the dataclass `kind` from plain data. Numbers are not made of text, nor whole ones of fractions.

    Raises:
        InputError: a key that does not exist (with the nearest that does), or a value that does not fit.
    """
    _require_names(kind, data, where)
    try:
        made: T = _adapter(kind).validate_json(json.dumps(data, default=str), strict=True)  # type: ignore[arg-type]
        return made
    except ValidationError as error:
        raise InputError(f"{where}: {_sentence(data, error)}") from error


def _require_names(kind: Any, data: Mapping[str, Any], where: str, prefix: str = "") -> None:
    groups = {entry.name: entry.default_factory for entry in fields(kind) if is_dataclass(entry.default_factory)}
    known = [entry.name for entry in fields(kind)]
    for name, value in data.items():
        if name not in known:
            raise InputError(f"{where}: {unknown(prefix + name, [prefix + one for one in known])}")
        if name in groups and not isinstance(value, Mapping):
            raise InputError(f"{where}: {prefix}{name} must hold `key: value` pairs")
        if name in groups:
            _require_names(groups[name], value, where, f"{prefix}{name}.")


WORDING = {"input should be": "it must be", "greater than or equal to": "at least", "less than or equal to": "at most"}


def _sentence(data: Any, error: ValidationError) -> str:
    """What is wrong with the first value that does not fit."""
    first = error.errors(include_url=False)[0]
    name, value = "", data
    for part in first["loc"]:
        if isinstance(part, int) and isinstance(value, list) and part < len(value):
            name, value = f"{name}[{part}]", value[part]
        elif isinstance(value, Mapping) and part in value:  # what else stands there names pydantic's own branches
            name, value = f"{name}.{part}" if name else str(part), value[part]
    said = first["msg"][:1].lower() + first["msg"][1:]
    for theirs, ours in WORDING.items():
        said = said.replace(theirs, ours)
    if not name:
        return f"a value cannot be written as UTF-8 ({said})"
    if first["type"] == "name":
        return f"{name}: {said}"
    return f"{name} is {brief(repr(value))}; {said}"


def unknown(name: str, known: Iterable[str]) -> str:
    """A sentence on a setting that does not exist."""
    near = difflib.get_close_matches(name, list(known), n=1, cutoff=0.3)
    return f"there is no setting {brief(repr(name))}" + (f"; did you mean {near[0]!r}?" if near else "")


def all_names(kind: Any, prefix: str = "") -> list[str]:
    """Full names of all settings of a dataclass of dataclasses."""
    found: list[str] = []
    for entry in fields(kind):
        nested = entry.default_factory if is_dataclass(entry.default_factory) else None
        found += [prefix + entry.name] if nested is None else all_names(nested, f"{prefix}{entry.name}.")
    return found


# --------------------------------------------------------------------------------------------------- YAML


class _Loader(yaml.SafeLoader):
    """`1e-3` is a number, as in YAML 1.2, and a key stands once."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        made = super().construct_mapping(node, deep)
        if len(made) < len(node.value):
            keys = [self.construct_object(key, deep=True) for key, _ in node.value]
            twice = next(key for key, count in Counter(keys).items() if count > 1)
            raise yaml.YAMLError(f"the key {brief(repr(twice))} stands there twice")
        return made


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(?:\d[\d_]*)(?:\.[\d_]*)?[eE][-+]?\d+$|^[-+]?\.\d+(?:[eE][-+]?\d+)?$|^[-+]?\d+\.\d*$|^[-+]?\.(?:inf|nan)$"),
    list("-+0123456789."),
)


def read_yaml(text: str, where: str) -> dict[str, Any]:
    """`key: value` pairs of YAML that may come from anybody.

    Raises:
        InputError: it is no YAML, or not such pairs.
    """
    try:
        refuse_traps(text, where)
        data = yaml.load(text, Loader=_Loader)  # noqa: S506 (a SafeLoader)
    except InputError:
        raise
    except Exception as error:  # the parser raises its own family
        raise InputError(f"{where} is not valid YAML: {first_line(error)}") from error
    if not isinstance(data := {} if data is None else data, dict):
        raise InputError(f"{where}: settings must be `key: value` pairs")
    return _named(data)


def _named(data: Any) -> Any:
    """Keys as text. YAML reads a bare on and off as true and false."""
    if not isinstance(data, dict):
        return data
    return {{True: "on", False: "off"}[key] if isinstance(key, bool) else str(key): _named(value) for key, value in data.items()}


def refuse_traps(text: str, where: str) -> None:
    """Look at YAML that may come from anybody before a parser does, for what breaks the parser itself.

    That is nesting (it recurses in C and takes the process with it) and aliases that multiply. Call it where errors of the parser are
    caught: this one raises them too.

    Raises:
        InputError: too long, nested too deeply, or with aliases.
    """
    if len(text) > MAX_YAML:
        raise InputError(f"{where} holds {len(text)} characters, more than the {MAX_YAML} that settings may have")
    depth = 0
    for event in yaml.parse(text, Loader=yaml.SafeLoader):  # one event after the other, without recursion
        if isinstance(event, yaml.AliasEvent):
            raise InputError(f"{where} refers to the anchor {event.anchor[:40]!r}, which settings cannot; write the value out")
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > MAX_NESTING:
            raise InputError(f"{where} is nested more than {MAX_NESTING} levels deep; settings are `group: {{key: value}}`")


def put(data: dict[str, Any], name: str, value: Any) -> None:
    """Set `group.key` in nested plain data."""
    *groups, key = name.split(".")
    for group in groups:
        if not isinstance(data.get(group), dict):
            data[group] = {}
        data = data[group]
    data[key] = value


def flat(data: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """`{"group": {"key": 1}}` → `{"group.key": 1}`."""
    found: dict[str, Any] = {}
    for key, value in data.items():
        found |= flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
    return found
