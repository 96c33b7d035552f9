"""Faults that are planted: where they are found, that they go again, and which tests are run for them."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from benchmarks.mutation.choose import Imports
from benchmarks.mutation.faults import FAULTS, Fault
from benchmarks.mutation.measure import outcome, table
from benchmarks.mutation.planted import Copy, place_of

ROOT = Path(__file__).parents[2]


def test_the_product_still_has_the_lines_that_are_changed() -> None:
    imports = Imports(ROOT)
    assert len({fault.name for fault in FAULTS}) == len(FAULTS) >= 60
    found = [place_of(fault, ROOT, imports.product) for fault in FAULTS]
    assert sum(place is not None for place in found) >= 0.9 * len(FAULTS), [
        f.name for f, place in zip(FAULTS, found, strict=True) if not place
    ]
    assert imports.tests_of("toolkit/tone.py", 1) == ["tests/test_tone.py"]
    assert all(imports.tests_of(place[0], 1) for place in found if place)


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    for name, text in {
        "toolkit/__init__.py": "",
        "toolkit/half.py": "def half(x):\n    return x / 2\n\n\ndef unused(x):\n    return x + 1\n",
        "pipelines/__init__.py": "",
        "configs/__init__.py": "",
        "tests/__init__.py": "",
        "tests/test_half.py": "from fieldfuse.half import half\n\n\ndef test_half():\n    assert half(4) == 2\n",
        "tests/test_other.py": "def test_other():\n    raise AssertionError\n",
        "setup.cfg": "[tool:pytest]\nmarkers =\n    slow: long\n",
    }.items():
        (tmp_path / "checkout" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "checkout" / name).write_text(text)
    return tmp_path / "checkout"


def test_a_fault_is_found_by_the_test_that_imports_its_module_and_goes_again(checkout: Path, tmp_path: Path) -> None:
    copy = Copy(checkout, tmp_path, Path(sys.executable))
    rows = []
    for name, anchor in {"half": ("x / 2", "x / 3"), "unused": ("x + 1", "x - 1"), "gone": ("y + 1", "")}.items():
        found = outcome(copy, Fault(name, "wrong constant", (anchor,)), 60)
        rows.append({"fault": name, "kind": "wrong constant", **found})
        assert (copy.path / "toolkit" / "half.py").read_bytes() == (checkout / "toolkit" / "half.py").read_bytes()
    assert [row["by"] for row in rows] == ["tests/test_half.py::test_half", None, None] and rows[1]["complete"]
    text = table({"rows": rows})
    assert "| all | 2 | 1 |" in text and "Not in this product: gone." in text
