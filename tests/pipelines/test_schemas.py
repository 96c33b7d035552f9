"""Files that stages left are looked at before they are used."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from fieldfuse.errors import InputError
from fieldfuse.pipelines import schemas
from tests.pipelines.made import call

NETWORK = {"key_frames": 3, "seconds": 1.5, "encode_seconds": 1, "first_preview_seconds": 0.1, "resolution": 64}


@pytest.mark.parametrize(
    ("form", "value", "wrong"),
    [
        (schemas.Network, NETWORK, ""),
        (schemas.Network, {**NETWORK, "seconds": 10**400}, "seconds"),
        (schemas.Network, {**NETWORK, "seconds": 1e305}, "seconds"),
        (schemas.Network, {**NETWORK, "seconds": float("nan")}, "not finite"),
        (schemas.Network, {**NETWORK, "seconds": True}, "seconds"),
        (schemas.Network, {**NETWORK, "seconds": "1"}, "seconds"),
        (schemas.Network, {**NETWORK, "fusion_seconds": None}, "fusion_seconds"),
        (schemas.Network, {**NETWORK, "more": 1}, "more"),
        (schemas.Network, {}, "key_frames"),
        (schemas.NOTES, ["a", "b"], ""),
        (schemas.NOTES, ["a", 1], "1: "),
        (schemas.NOTES, {}, "list"),
        (schemas.EVALUATION, {"field": {"views": 3, "psnr": None, "per_view": [{"index": 0, "name": "a", "seen": 0.5}]}}, ""),
        (schemas.EVALUATION, {"field": {"psnr": [1]}}, "psnr"),
        (schemas.EVALUATION, {"field": {"per_view": [{"index": 0}]}}, "name"),
        (schemas.TIMELINE, [{"seconds": 1, "psnr": 20.0, "level": 2}], ""),
        (schemas.TIMELINE, [{"seconds": 1}], "psnr"),
    ],
)
def test_forms(form: Any, value: Any, wrong: str) -> None:
    if not wrong:
        assert schemas.checked(value, form, Path("a.json")) is value
        return
    with pytest.raises(InputError, match=rf"a\.json is damaged .*{wrong}.*; remove it"):
        schemas.checked(value, form, Path("a.json"))


@pytest.mark.parametrize(
    "text", ['{"effects": []}', "[]", "1", '{"effects": [{}], "seconds": 1, "looked_at": {}}', '{"effects": {"a": 1}}']
)
def test_a_damaged_file_is_refused_in_a_sentence(text: str, tmp_path: Path) -> None:
    (tmp_path / "effects.json").write_text(text)
    with pytest.raises(InputError, match=r"effects\.json is damaged .* remove it and run the command again"):
        schemas.read_checked(tmp_path / "effects.json", schemas.Effects)


@pytest.mark.parametrize(("told", "notes"), [({}, []), ({"note": None}, []), ({"note": "a"}, ["a"]), ({"notes": ["a", "b"]}, ["a", "b"])])
def test_facts_of_exports_of_earlier_versions_are_read(told: dict[str, Any], notes: list[str], tmp_path: Path) -> None:
    """They had one note or none, and were called damaged."""
    (tmp_path / "facts.json").write_text(json.dumps({"mesh": None, **told}))
    assert schemas.read_export_facts(tmp_path / "facts.json") == {"mesh": None, "notes": notes, "part": "off"}


def test_what_the_stages_write_has_the_forms(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A finished small run, read back."""
    from tests.stability.runs import OPTIONS, make_source

    out = tmp_path / "out"
    answer = call(capsys, "run", make_source(tmp_path / "room"), "--out", out, *OPTIONS)
    assert answer.code == 0, answer.err
    for name, form in (
        ("effects.json", schemas.Effects),
        ("evaluation.json", schemas.EVALUATION),
        ("timeline.json", schemas.TIMELINE),
        ("exports/facts.json", schemas.ExportFacts),
    ):
        schemas.read_checked(out / name, form)
