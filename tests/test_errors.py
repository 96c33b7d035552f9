"""What is said of a failure is one line that every terminal can show, whatever it quotes."""

from __future__ import annotations

import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldfuse.config import load_settings
from fieldfuse.errors import LONGEST, FieldfuseError, InputError, PoseError, all_lines, first_line

ANYTHING = st.text(st.characters(exclude_categories=()))


@given(ANYTHING, st.sampled_from([FieldfuseError, InputError, PoseError]))
def test_a_message_is_one_line_that_can_be_written(text, kind):
    said = str(kind(f"photos/{text}: nothing"))
    assert len(said.splitlines()) == 1 and "\x1b" not in said
    assert said.encode("utf-8").decode("utf-8") == said


def test_what_can_be_shown_stays():
    assert str(InputError("Küche/фото 1.jpg – ‘a’  b")) == "Küche/фото 1.jpg – ‘a’  b"


@pytest.mark.parametrize("name", [b"a\nb", b"caf\xe9", b"\x1b[31mred"])
def test_a_name_that_no_terminal_can_show(tmp_path, name):
    """File names are bytes on Linux."""
    command = [sys.executable, "-m", "fieldfuse.pipelines.cli", "run", bytes(tmp_path) + b"/" + name, "--out", str(tmp_path / "out")]
    run = subprocess.run(command, capture_output=True)
    assert run.returncode == 2
    said = run.stderr.decode("utf-8")
    assert "\x1b" not in said and "unexpected" not in said and not (tmp_path / "out").exists()


@given(ANYTHING, st.sampled_from([first_line, all_lines]))
def test_what_another_library_says_is_short(text, quote):
    said = quote(ValueError(text * 200))
    assert 0 < len(said) <= LONGEST + 2 and len(said.splitlines()) == 1
    assert all_lines(ValueError("sizes:\n  16 of 8 ")) == "sizes: 16 of 8" and all_lines(ValueError()) == "ValueError"


def test_what_the_system_says_is_without_its_number():
    assert first_line(OSError(28, "No space left on device", "somewhere")) == "No space left on device"
    assert first_line(OSError("of its own")) == "of its own" and first_line(KeyError()) == "KeyError"


@pytest.mark.parametrize(
    ("key", "value"), [("fit.slow_within", 10**400), ("network.recolour", "a" * 5000), ("a" * 5000, 1), ("engine", "b" * 5000)]
)
def test_settings_that_are_too_long_are_quoted_in_part(key, value):
    with pytest.raises(InputError) as said:
        load_settings(stored={key: value})
    assert len(str(said.value)) < 800
