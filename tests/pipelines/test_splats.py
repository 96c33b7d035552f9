"""`fieldfuse export --formats splat,spz`: files, the report's row, and what a later command does with them."""

from __future__ import annotations

from pathlib import Path

import pytest

import fieldfuse as ff
from fieldfuse.files import read_json
from tests.pipelines.made import said
from tests.pipelines.short import FAST, finished, steady

QUICK = ["--threads", "1", "--set", "export.splat_seconds=1"]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("splats") / "out"
    finished(out, 12, *FAST)
    return out


def test_splats_are_exported_and_scored(run: Path) -> None:
    with steady():
        answer = said("export", run, "--formats", "splat,spz", *QUICK)
    assert answer.code == 0, answer.err
    data = read_json(run / "report.json")
    paths = {entry["path"] for entry in data["exports"]}
    assert {"exports/splat.ply", "exports/splat.spz"} <= paths
    field, splats = data["evaluation"]["field"], data["evaluation"]["splats"]
    assert splats["psnr"] > field["psnr"] - 2 and splats["gaussians"] > 100 and splats["degree"] == 1
    assert "Splats" in answer.out and "Splats" in (run / "report.html").read_text(encoding="utf-8")
    ply, spz = (ff.Splats.open(run / "exports" / name) for name in ("splat.ply", "splat.spz"))
    assert len(ply) == len(spz) == splats["gaussians"]


def test_they_stay_as_they_are_until_the_field_changes(run: Path) -> None:
    with steady():
        assert said("export", run, "--formats", "splat", *QUICK).code == 0
        before = (run / "exports" / "splat.ply").stat().st_mtime_ns
        assert said("evaluate", run, "--threads", "1").code == 0
        assert (run / "exports" / "splat.ply").stat().st_mtime_ns == before
        assert read_json(run / "report.json")["evaluation"]["splats"]["gaussians"] > 100
        assert said("finetune", run, "--budget", "1", "--threads", "1").code == 0
    data = read_json(run / "report.json")
    assert "splats" not in data["evaluation"]  # those of the earlier field are not scored as this one's
    assert not (run / "exports" / "splat.ply").exists() and any("splat.ply" in warning for warning in data["warnings"])
