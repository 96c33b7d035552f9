"""Files that stages left are looked at before they are used."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from fieldfuse.errors import InputError
from fieldfuse.pipelines import kept
from fieldfuse.pipelines.kept import FLAG, NUMBER, TEXT, misfit, read_kept
from tests.pipelines.made import call


@pytest.mark.parametrize(
    ("value", "form", "wrong"),
    [
        (1.5, NUMBER, ""),
        (10**400, NUMBER, "is not a number"),
        (float("nan"), NUMBER, "is not a number"),
        (True, NUMBER, "is not a number"),
        (1, FLAG, "is not true or false"),
        (None, (None, TEXT), ""),
        (3, (None, TEXT), "is not text"),
        ([1, "a"], [NUMBER], "[1] is not a number"),
        ({}, [NUMBER], "is not a list"),
        ({"a": 1}, {"a": NUMBER, "?b": TEXT}, ""),
        ({"a": 1, "b": 2}, {"a": NUMBER, "?b": TEXT}, "b is not text"),
        ({"b": "x"}, {"a": NUMBER, "?b": TEXT}, "has no 'a'"),
        ({"a": 1, "c": 2}, {"a": NUMBER}, "has 'c'"),
        ({"a": 1, "c": {"d": [float("inf")]}}, {"a": NUMBER, "*": kept.ANY}, "is not finite"),
    ],
)
def test_forms(value: Any, form: Any, wrong: str) -> None:
    told = misfit(value, form)
    assert (told == "") == (wrong == "") and wrong in told


@pytest.mark.parametrize(
    "text", ['{"effects": []}', "[]", "1", '{"effects": [{}], "seconds": 1, "looked_at": {}}', '{"effects": {"a": 1}}']
)
def test_a_damaged_file_is_refused_in_a_sentence(text: str, tmp_path: Path) -> None:
    (tmp_path / "effects.json").write_text(text)
    with pytest.raises(InputError, match=r"effects\.json is damaged .* remove it and run the command again"):
        read_kept(tmp_path / "effects.json", kept.EFFECTS)


@pytest.mark.parametrize(("told", "notes"), [({}, []), ({"note": None}, []), ({"note": "a"}, ["a"]), ({"notes": ["a", "b"]}, ["a", "b"])])
def test_facts_of_exports_of_earlier_versions_are_read(told: dict[str, Any], notes: list[str], tmp_path: Path) -> None:
    """They had one note or none, and were called damaged."""
    (tmp_path / "facts.json").write_text(json.dumps({"mesh": None, **told}))
    assert kept.read_export_facts(tmp_path / "facts.json") == {"mesh": None, "notes": notes}


def test_what_the_stages_write_has_the_forms(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A finished small run, read back."""
    from tests.stability.runs import OPTIONS, make_source

    out = tmp_path / "out"
    answer = call(capsys, "run", make_source(tmp_path / "room"), "--out", out, *OPTIONS)
    assert answer.code == 0, answer.err
    for name, form in (
        ("effects.json", kept.EFFECTS),
        ("evaluation.json", kept.EVALUATION),
        ("timeline.json", kept.TIMELINE),
        ("exports/facts.json", kept.EXPORT_FACTS),
    ):
        assert misfit(json.loads((out / name).read_text()), form) == "", name
