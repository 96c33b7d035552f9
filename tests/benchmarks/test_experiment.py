"""Plans, runs and tables: what is measured once, what is measured again, and where it is written."""

from __future__ import annotations

import json
import threading
from pathlib import Path
from typing import Any

import pytest

from benchmarks.experiment import Experiment, Row, chosen, markdown, numbers, portable, put_between_marks, section
from fieldfuse.errors import InputError, Interrupted
from fieldfuse.files import read_json, write_json
from fieldfuse.pipelines.console import ConsoleProgress


def table(data: Row) -> str:
    return markdown(["n", "square"], ([row["n"], f"{row['square']:d}"] for row in data["rows"]))


class Squares:
    """An experiment, and the entries that were run."""

    def __init__(self, out: Path) -> None:
        self.out, self.ran, self.progress = out, list[int](), ConsoleProgress()

    def run(self, entry: Row) -> Row:
        self.progress.check()
        self.ran.append(entry["n"])
        if entry["n"] == 13:
            self.progress.request_stop()
        return {"square": entry["n"] ** 2}

    def conduct(self, *plan: int, state: str | None = "a", **more: Any) -> list[tuple[int, int]]:
        experiment = Experiment("squares", [{"n": n} for n in plan], self.run, table, state, {"title": "Squares"}, **more)
        return [(row["n"], row["square"]) for row in experiment.conduct(self.out, self.progress)["rows"]]


def test_rows_are_measured_once_for_each_state(tmp_path: Path) -> None:
    squares = Squares(tmp_path)
    assert squares.conduct(1, 2) == [(1, 1), (2, 4)] and squares.ran == [1, 2]
    assert squares.conduct(3, 2) == [(1, 1), (3, 9), (2, 4)] and squares.ran == [1, 2, 3]
    data = read_json(tmp_path / "squares.json")
    assert {"experiment": "squares", "title": "Squares", "state": "a"}.items() <= data.items()
    assert data["machine"]["cores"] and data["machine"]["measured"] and data["command"] and data["version"]
    text = (tmp_path / "squares.md").read_text()
    assert text == section(data, table) and text.startswith("### Squares\n\nMeasured ") and "| 3 | 9 |" in text and data["command"] in text
    assert squares.conduct(3, state="b") == [(3, 9)] and squares.ran == [1, 2, 3, 3]
    assert squares.conduct(3, state=None) == [(3, 9)] == squares.conduct(3, state=None) and squares.ran == [1, 2, 3, 3, 3, 3]


@pytest.mark.parametrize("jobs", [1, 2])
def test_what_is_finished_stays_when_the_user_stops(tmp_path: Path, jobs: int) -> None:
    squares = Squares(tmp_path)
    with pytest.raises(Interrupted):
        squares.conduct(1, 13, 3, 4, jobs=jobs)
    assert 3 not in squares.ran or jobs == 2
    squares.ran.clear()
    squares.progress.resume()
    squares.conduct(1, 3, 4, jobs=jobs)
    assert jobs == 2 or squares.ran == [3, 4], "1 and 13 were there"
    assert read_json(tmp_path / "squares.json")["rows"]


def test_entries_are_run_at_the_same_time(tmp_path: Path) -> None:
    both = threading.Barrier(2, timeout=30)
    experiment = Experiment("b", [{"n": n} for n in range(4)], lambda entry: {"square": both.wait() * 0}, table, jobs=2)
    assert [row["n"] for row in experiment.conduct(None, ConsoleProgress())["rows"]] == [0, 1, 2, 3]


@pytest.mark.parametrize("damage", [{"rows": 3}, {"rows": [{"n": 1, "square": "one"}]}, {"rows": [{"n": 1}]}, {"machine": None}])
def test_damaged_results_are_refused(tmp_path: Path, damage: Row) -> None:
    squares = Squares(tmp_path)
    squares.conduct(1)
    write_json(tmp_path / "squares.json", {**read_json(tmp_path / "squares.json"), **damage})
    with pytest.raises(InputError, match=r"squares\.json holds no results"):
        squares.conduct(1)
    (tmp_path / "squares.json").write_text(json.dumps([]))
    with pytest.raises(InputError, match=r"squares\.json holds no results"):
        squares.conduct(1)


def test_lists_in_options() -> None:
    assert numbers("30, 120", "--budgets") == [30.0, 120.0]
    assert chosen("b, a,b", "abc", "--x") == ["b", "a"] and chosen(None, "abc", "--x") == ["a", "b", "c"]
    assert chosen(",", "abc", "--x") == []
    for text in ("", "x", "-1", "nan"):
        with pytest.raises(InputError, match="--budgets"):
            numbers(text, "--budgets")
    with pytest.raises(InputError, match="there is no 'd'; known are a, b, c"):
        chosen("a,d", "abc", "--x")


def test_commands_lose_the_places_of_this_machine() -> None:
    command = "fieldfuse tradeoff /captures/sets/fox --out /elsewhere/x/fox --times 1,3 --config /mine/a.yaml"
    assert portable(command, Path("/captures")) == "fieldfuse tradeoff DATA/sets/fox --out runs/fox --times 1,3 --config a.yaml"
    assert portable("python -m benchmarks.suites dtu sets/dtu --out 'my runs'", None).endswith("dtu sets/dtu --out 'my runs'")


def test_tables_are_put_between_their_marks(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("# Title\n\nBefore.\n")
    put_between_marks(page, "dtu", "first")
    put_between_marks(page, "lego", "other")
    page.write_text(page.read_text() + "\nAfter.\n")
    put_between_marks(page, "dtu", "second\n")
    text = page.read_text()
    assert "first" not in text and "<!-- measured: dtu -->\nsecond\n<!-- end of dtu -->" in text
    assert text.startswith("# Title\n\nBefore.\n") and text.endswith("\nAfter.\n") and "other" in text
    page.write_text("<!-- measured: dtu -->\n")
    with pytest.raises(InputError, match="both marks"):
        put_between_marks(page, "dtu", "text")
    with pytest.raises(InputError, match="cannot read the page"):
        put_between_marks(tmp_path / "none.md", "dtu", "text")
    with pytest.raises(InputError, match="cannot be the name"):
        put_between_marks(page, "a --> b", "text")
