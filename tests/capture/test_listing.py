"""Small files that may come from anybody."""

from __future__ import annotations

from pathlib import Path

import pytest

from fieldfuse.capture.listing import read_text
from fieldfuse.errors import InputError


def test_a_text_file_is_read_up_to_its_bound_and_no_further(tmp_path: Path) -> None:
    (tmp_path / "rgb.txt").write_bytes(b"\xef\xbb\xbfa b\n")
    assert read_text(tmp_path / "rgb.txt", 7) == "a b\n"
    with pytest.raises(InputError, match=r"rgb\.txt is larger than"):
        read_text(tmp_path / "rgb.txt", 6)
