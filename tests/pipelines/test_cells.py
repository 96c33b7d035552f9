"""`fieldfuse run --cells`: the field does not depend on the workers, fitted cells are reused, errors name the cell."""

from __future__ import annotations

import json
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from fieldfuse.cluster import Workers, open_workers
from fieldfuse.render.field import Field
from fieldfuse.training.cells import scene as cells
from tests.pipelines.made import make_room, said
from tests.pipelines.short import SMALL, steady

LATTICE = ["--budget", "1000", "--set", "field.resolution=64", "--set", "fit.iterations=300"]
OPTIONS = [*SMALL, *LATTICE, "--cells", "3", "--set", "export.formats=[]"]


def workers_here(address: str | None, **_: object) -> AbstractContextManager[Workers]:
    """Cells are fitted in this process."""
    return open_workers(address, pool=False)


def two_workers(address: str | None, **_: object) -> AbstractContextManager[Workers]:
    return open_workers(address, cpus=2)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("cells") / "room"
    make_room(root, 16)
    return root


@pytest.fixture(scope="module")
def fitted(room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run in cells, each fitted in this process."""
    out = tmp_path_factory.mktemp("fitted") / "out"
    with steady(), pytest.MonkeyPatch.context() as patch:
        patch.setattr("fieldfuse.pipelines.cells.open_workers", workers_here)
        answer = said("run", room, "--out", out, *OPTIONS)
    assert answer.code == 0, answer.err
    return out


def same(one: Path, other: Path) -> bool:
    return (one / "field.safetensors").read_bytes() == (other / "field.safetensors").read_bytes()


def test_cells_give_one_field_and_a_report(fitted: Path) -> None:
    report = json.loads((fitted / "report.json").read_text())
    assert report["evaluation"]["field"]["psnr"] > 15
    assert any("fitted as 3 cells" in note for note in json.loads((fitted / "fit_notes.json").read_text()))
    plan = cells.read_plan(fitted / "cells")
    assert plan is not None and plan.count == 3
    field = Field.load(fitted / "field.safetensors")
    assert field.resolution == plan.resolution
    assert 0 < sum(plan.shares) < 3
    assert (fitted / "fit_matched.json").is_file()  # of the coarse fit
    assert not list((fitted / "cells").glob("pixels-*"))


def test_workers_of_a_pool_give_the_same_field(fitted: Path, room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ray", reason="Ray is not installed (the extra `cluster`)")
    monkeypatch.setattr("fieldfuse.pipelines.cells.open_workers", two_workers)
    answer = said("run", room, "--out", tmp_path / "out", *OPTIONS)
    assert answer.code == 0, answer.err
    assert same(fitted, tmp_path / "out")


def test_a_run_that_is_killed_goes_on_with_the_missing_cell(
    fitted: Path, room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[int] = []

    def fit(argument: tuple[str, int], *rest: object) -> object:
        calls.append(argument[1])
        if len(calls) == 2:
            raise OSError("as if the machine was gone")
        return cells_fit(argument, *rest)  # type: ignore[arg-type]

    cells_fit = cells.fit_cell_of
    monkeypatch.setattr(cells, "fit_cell_of", fit)
    monkeypatch.setattr("fieldfuse.pipelines.cells.open_workers", workers_here)
    out = tmp_path / "out"
    answer = said("run", room, "--out", out, *OPTIONS)
    assert answer.code == 2 and "cell 2 of 3" in answer.err and "as if the machine was gone" in answer.err and "Traceback" not in answer.err
    assert not (out / "field.safetensors").exists()
    before = (out / "cells" / "plan.json").stat().st_mtime_ns
    answer = said("run", room, "--out", out, *OPTIONS)
    assert answer.code == 0, answer.err
    assert calls == [0, 1, 2, 1]
    assert (out / "cells" / "plan.json").stat().st_mtime_ns == before  # the coarse field was not fitted again
    assert same(fitted, out)


def test_cells_that_no_node_has_memory_for_are_refused_by_name(room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cells, "CORNER_BYTES", 10**6)
    monkeypatch.setattr("fieldfuse.pipelines.cells.open_workers", workers_here)
    answer = said("run", room, "--out", tmp_path / "out", *OPTIONS)
    assert answer.code == 2 and "cell 1 of 3 needs 1 cores" in answer.err and "give more --cells, or add a node" in answer.err, answer.err
    assert (tmp_path / "out" / "cells" / "plan.json").is_file()  # the coarse fit is kept


def test_too_few_steps_for_the_finer_lattice_stay_in_one_piece(room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fieldfuse.pipelines.cells.open_workers", workers_here)
    answer = said("run", room, "--out", tmp_path / "out", *OPTIONS, "--set", "fit.iterations=60")
    assert answer.code == 0 and "were too few for the finer lattice that cells would have" in answer.out, answer.err
    assert Field.load(tmp_path / "out" / "field.safetensors").resolution == 32
    assert not (tmp_path / "out" / "cells" / "plan.json").exists()


def test_a_small_scene_stays_in_one_piece(room: Path, tmp_path: Path) -> None:
    answer = said("run", room, "--out", tmp_path / "out", *SMALL, "--cells", "auto", "--set", "export.formats=[]")
    assert answer.code == 0 and "small enough to be fitted in one piece" in answer.out
    assert not (tmp_path / "out" / "cells").exists()


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--cells", "some"], "off, auto, or a number"),
        (["--cells", "0"], "off, auto, or a number"),
        (["--cells", "3", "--engine", "torch"], "compiled engine"),
        (["--cells", "3", "--decoder", "per_sample"], "deferred decoder"),
        (["--cells", "3", "--no-finetune"], "no-finetune"),
        (["--cells", "3", "--address", "nonsense"], "HOST:PORT"),
        (["--address", "auto"], "add --cells"),
    ],
)
def test_what_cells_cannot_do_is_said_before_anything_is_fitted(options: list[str], sentence: str, room: Path, tmp_path: Path) -> None:
    answer = said("run", room, "--out", tmp_path / "out", *SMALL, *options)
    assert answer.code == 2 and sentence in answer.err and "Traceback" not in answer.err
    assert not (tmp_path / "out" / "field.safetensors").exists()
