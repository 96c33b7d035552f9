"""`fieldfuse batch`: the plan and what it refuses, runs on a cluster and without one, stopping."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil
import pytest

from fieldfuse.cluster import has_ray
from fieldfuse.errors import InputError
from fieldfuse.files import read_json
from fieldfuse.pipelines.batch_plan import plan
from fieldfuse.pipelines.batch_run import parse_progress
from fieldfuse.pipelines.batch_show import make_display
from fieldfuse.pipelines.options import Options, words
from tests.pipelines.made import call, command, environment, make_room, said
from tests.pipelines.short import HUNG, wait_for
from tests.pipelines.test_console import Terminal

Capsys = pytest.CaptureFixture[str]
# So many steps, not seconds; nothing that takes long.
SHORT = ["--threads", "1", "--init", "classical", "--set", "field.resolution=16", "--set", "fit.iterations=40", "--set", "fit.passes=null"]
SHORT += ["--set", "fit.depth_from=off", "--set", "effects=off", "--set", "export.formats=[]"]
ENDLESS = [*(word.replace("iterations=40", "iterations=1000000") for word in SHORT), "--budget", "600"]


@pytest.fixture(scope="module")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Captures: `a` and `b` are rooms, `broken` is none."""
    root = tmp_path_factory.mktemp("captures")
    make_room(root / "a", 10)
    shutil.copytree(root / "a", root / "b")
    (root / "broken").mkdir()
    (root / "broken" / "transforms.json").write_text("{")
    return root


def listed(folder: Path, text: str | bytes) -> Path:
    path = folder / "list.csv"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


# ------------------------------------------------------------------------------------------------- the plan


def test_options_become_words_and_cells_go_before_them(tmp_path: Path) -> None:
    options = Options(budget=3.0, finetune=False, poses="sfm", pairs=["a.b=1", "c=2"], threads=1, quiet=True)
    assert words(options) == ["--budget", "3.0", "--threads", "1", "--no-finetune", "--poses", "sfm", "--set", "a.b=1", "--set", "c=2"]
    path = listed(tmp_path, "source,name,image-size,set,finetune\na,first,64,fit.split_every=3; seed=4,yes\n/b/c.mp4,,,,\n")
    first, second = plan([path], Options(budget=3.0, finetune=False))
    assert (first.name, first.source) == ("first", tmp_path / "a") and (second.name, second.source) == ("c", Path("/b/c.mp4"))
    assert words(first.options) == ["--budget", "3.0", "--image-size", "64", "--finetune", "--set", "fit.split_every=3", "--set", "seed=4"]
    assert words(second.options) == ["--budget", "3.0", "--no-finetune"]


def test_names_are_those_of_captures_made_unique() -> None:
    paths = ["x/images", "y/images", "z/walk.mp4", "batch.json", "logs", "images-2"]
    names = [one.name for one in plan([Path(path) for path in paths], Options())]
    assert names == ["images", "images-2", "walk", "batch", "logs-2", "images-2-2"]


BROKEN = {
    "": "is empty; its first line must name the columns",
    "source\n": "has no rows below its first line",
    "path\na\n": "has a column 'path', which is no option of run",
    "name\na\n": "has no column source",
    "source,budget,budget\na,1,2\n": "has the column budget twice",
    "source,name\na,x\nb,x\n": "row 3 has the name 'x' of row 2",
    "source,name\na,../x\n": "row 2 has the name '../x', which cannot be that of a folder",
    "source,name\n,x\n": "row 2 has no source",
    "source\na,b\n": "row 2 has 2 cells and the first line names 1 columns",
    "source,image-size\na,large\n": "row 2: image-size is 'large', which is not usable",
    "source,finetune\na,perhaps\n": "row 2: finetune is 'perhaps', which is not usable",
    "source,set\na,fit.budgets=3\n": "row 2: ",
    "source,total-budget,budget\na,20,3\n": "row 2: --total-budget chooses what --budget would set",
    'source\n"a\n': "is not CSV",
    b"source\n\xff\xfe\n": "is not UTF-8",
}


@pytest.mark.parametrize("text", BROKEN, ids=lambda text: repr(text)[:30])
def test_a_broken_list_is_refused_with_its_row(tmp_path: Path, capsys: Capsys, text: str | bytes) -> None:
    answer = call(capsys, "batch", listed(tmp_path, text), "--out", tmp_path / "out")
    assert answer.code == 2 and BROKEN[text] in answer.sentence() and "list.csv" in answer.sentence()
    assert not (tmp_path / "out").exists()


def test_other_bad_input_is_refused(tmp_path: Path, capsys: Capsys) -> None:
    for sources, sentence in (
        (["a", "a"], "a is given twice"),
        (["no.csv"], "cannot read no.csv"),
        (["a", "--preset", "none"], "preset"),
        (["a", "--address", "127.0.0.1:1"], "nothing answers at 127.0.0.1:1" if has_ray() else "needs the package ray"),
    ):
        answer = call(capsys, "batch", *sources, "--out", tmp_path / "out")
        assert answer.code == 2 and sentence in answer.sentence()
    assert not (tmp_path / "out").exists()
    with pytest.raises(InputError, match="given twice"):
        plan([Path("a"), Path("./a")], Options())


def test_a_dry_run_prices_and_starts_nothing(rooms: Path, tmp_path: Path, capsys: Capsys) -> None:
    answer = call(capsys, "batch", rooms / "a", rooms / "b", "--out", tmp_path / "out", "--budget", "30", "--dry-run")
    assert answer.code == 0, answer.err
    first, second, whole = answer.out.splitlines()
    assert first.startswith(f"a: {rooms / 'a'} (--budget 30.0), about ") and "GB of memory" in first and second.startswith("b: ")
    assert whole.startswith("2 runs, ") and " at once with " in whole
    assert not (tmp_path / "out").exists()


def test_what_a_run_writes_is_understood() -> None:
    none = {"share": None, "left": None, "psnr": None}
    assert parse_progress("field 43%, 0:12 left, 32³, 24.3 dB") == {"stage": "field", "share": 43, "left": "0:12", "psnr": 24.3}
    assert parse_progress("poses 7%, matching") == {**none, "stage": "poses", "share": 7}
    assert parse_progress("views: 1.2 s") == parse_progress("views: reused") == {**none, "stage": "views", "share": 100}
    assert parse_progress("fieldfuse: no such capture") is None and parse_progress("a line of a library") is None


def test_the_table_of_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "100")
    at_work = {"name": "[b]", "state": "running", "stage": "field", "share": 43, "left": "0:12", "psnr": 24.3, "node": "vm", "error": None}
    failed = {**at_work, **dict.fromkeys(("stage", "share", "left", "psnr")), "name": "a", "state": "failed", "error": "no such capture"}
    stream, stops = Terminal(), []
    shown = make_display([failed, at_work], lambda: stops.append(1), quiet=False, stream=stream)
    shown.request_stop()
    shown.say("stopping")
    shown.close()
    text = stream.getvalue()
    assert all(word in text for word in ("[b]", "field 43%", "0:12", "24.30", "no such capture", "1 running, 1 failed", "stopping"))
    assert text.rindex("[b]") < text.rindex("no such capture") and stops == [1] and shown.stopping()
    assert type(make_display([], lambda: None, quiet=True)).__name__ == "Display"


# ------------------------------------------------------------------------------------------------- runs


@pytest.fixture(scope="module")
def single(rooms: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The scores of a single run of the room."""
    out = tmp_path_factory.mktemp("single") / "out"
    assert said("run", rooms / "a", "--out", out, *SHORT).code == 0
    return scores(out)


def scores(out: Path) -> dict[str, Any]:
    """Without times."""
    return {key: value for key, value in read_json(out / "report.json")["evaluation"]["field"].items() if "seconds" not in key}


def rows(out: Path) -> dict[str, dict[str, Any]]:
    return {row["name"]: row for row in read_json(out / "batch.json")["runs"]}


@pytest.mark.slow
def test_runs_on_a_cluster_are_single_runs_and_failures_cost_no_other(
    cluster: Any, rooms: Path, single: dict[str, Any], tmp_path: Path, capsys: Capsys
) -> None:
    out = tmp_path / "out"
    path = listed(tmp_path, f"source,name,set\n{rooms}/a,,\n{rooms}/b,<b>,\n{rooms}/broken,,\n{rooms}/none,,\n")
    huge = ["--memory-per-run", "0.5", "--address", cluster.address, "--retries", "1"]
    answer = call(capsys, "batch", path, "--out", out, *SHORT, *huge)
    assert answer.code == 1 and "Traceback" not in answer.err, answer.err
    assert scores(out / "a") == scores(out / "<b>") == single
    found = rows(out)
    assert [found[name]["state"] for name in ("a", "<b>", "broken", "none")] == ["done", "done", "failed", "failed"]
    assert "broken/transforms.json is not valid JSON" in found["broken"]["error"] and " (on the node " in found["broken"]["error"]
    assert found["none"]["error"].startswith(f"{rooms}/none does not exist; give a video")
    assert found["a"]["psnr"] == single["psnr"] and found["a"]["report"] == "a/report.html"
    page = (out / "batch.html").read_text(encoding="utf-8")
    assert 'href="a/report.html"' in page and 'href="%3Cb%3E/report.html"' in page and ">&lt;b&gt;</a>" in page and "><b></a>" not in page
    assert page.count("data:image/jpeg") == 2 and "http://" not in page and "<script" not in page

    before = (out / "a" / "report.json").stat().st_mtime_ns
    shutil.copytree(rooms / "a", rooms / "none")
    again = call(capsys, "batch", path, "--out", out, *SHORT, *huge)
    shutil.rmtree(rooms / "none")
    assert again.code == 1 and "a: begun" not in again.err and "none: begun" in again.err
    assert rows(out)["none"]["state"] == "done" and (out / "a" / "report.json").stat().st_mtime_ns == before


def test_captures_and_results_travel_where_storage_is_not_shared(
    cluster: Any, rooms: Path, single: dict[str, Any], tmp_path: Path, capsys: Capsys
) -> None:
    answer = call(capsys, "batch", rooms / "a", rooms / "none", "--out", tmp_path, *SHORT, "--address", cluster.address, "--upload")
    assert answer.code == 1 and scores(tmp_path / "a") == single
    assert f"none: failed: {rooms / 'none'} does not exist" in answer.out
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "batch.html", "batch.json"]


def test_a_run_that_no_node_holds_is_refused_by_name(cluster: Any, rooms: Path, tmp_path: Path, capsys: Capsys) -> None:
    answer = call(capsys, "batch", rooms / "a", "--out", tmp_path, "--address", cluster.address, "--memory-per-run", "9999")
    assert answer.code == 1 and "a: failed: a needs 1 cores, 9312.3 GB of memory, and no node has that much" in answer.out
    assert not (tmp_path / "a").exists()


def test_without_ray_runs_follow_each_other_and_time_out(
    rooms: Path, tmp_path: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fieldfuse.cluster.has_ray", lambda: False)
    answer = call(capsys, "batch", rooms / "broken", rooms / "a", "--out", tmp_path, *SHORT, "--timeout", "1", "--json")
    assert answer.code == 1
    first, second = json.loads(answer.out)["runs"]
    assert "is not valid JSON" in first["error"] or "took longer" in first["error"]
    assert second["error"] == "it took longer than 1 s and was ended; give --timeout more, or a smaller --budget"


# ------------------------------------------------------------------------------------------------- stopping


def started(*arguments: object) -> subprocess.Popen[str]:
    return subprocess.Popen(command(*arguments), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment())


@pytest.mark.long
def test_ctrl_c_once_lets_the_stage_end_and_the_next_call_goes_on(rooms: Path, tmp_path: Path, capsys: Capsys) -> None:
    arguments = ["batch", rooms / "a", rooms / "b", "--out", tmp_path]
    process = started(*arguments, *ENDLESS)
    for name in ("a", "b") if has_ray() else ("a",):
        wait_for(tmp_path / name / "stages" / "views.json", process)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=HUNG)
    assert process.returncode == 130 and "Traceback" not in err, err
    assert err.splitlines()[-1].startswith("fieldfuse: stopped on request; what was finished is kept, run the same command again")
    assert [row["state"] for row in rows(tmp_path).values()] == ["stopped", "stopped" if has_ray() else "waiting"]
    answer = call(capsys, *arguments[:2], *arguments[3:], *SHORT)
    assert answer.code == 0 and rows(tmp_path)["a"]["state"] == "done"
    assert read_json(tmp_path / "a" / "report.json")["stages"][0]["cached"]


@pytest.mark.slow
def test_ctrl_c_twice_ends_all_processes_at_once(rooms: Path, tmp_path: Path) -> None:
    pytest.importorskip("ray", reason="Ray is not installed (the extra cluster)")
    process = started("batch", rooms / "a", rooms / "b", "--out", tmp_path, *ENDLESS)
    for name in ("a", "b"):
        wait_for(tmp_path / name / "stages" / "views.json", process)
    process.send_signal(signal.SIGINT)
    assert process.stderr is not None
    while "Ctrl-C again" not in process.stderr.readline():
        pass
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=HUNG)
    assert process.returncode == 130 and "Traceback" not in err, err

    def left() -> list[str]:
        found = [one.info["cmdline"] or [] for one in psutil.process_iter(["cmdline"])]
        return [" ".join(words) for words in found if str(tmp_path) in words or f"{tmp_path}/a" in words or f"{tmp_path}/b" in words]

    until(lambda: not left())


def until(true: Callable[[], bool], seconds: float = 30.0) -> None:
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end
        time.sleep(0.1)
