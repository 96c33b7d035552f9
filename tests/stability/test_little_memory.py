"""Stages where memory is short: each takes less, or refuses with what it needs and what is free."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fieldfuse import memory
from fieldfuse.camera import Similarity
from fieldfuse.config import PosesSettings, TsdfSettings
from fieldfuse.errors import InputError
from fieldfuse.poses import sfm
from fieldfuse.stereo.match import stereo_depths
from fieldfuse.tsdf.fuse import fuse_capture
from fieldfuse.tsdf.volume import BYTES_PER_BLOCK, TsdfVolume
from tests.stability.hard.captures import texture, views_of
from tests.stability.runs import OPTIONS, make_source
from tests.stability.stops import fieldfuse
from tests.tsdf.scenes import CAMERA
from tests.tsdf.test_frames import written


def allow(monkeypatch: pytest.MonkeyPatch, free: int) -> None:
    monkeypatch.setattr(memory, "available", lambda: memory.SPARE + free)


def test_a_sensors_surface_becomes_coarser_and_what_was_asked_for_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    capture = written(tmp_path, CAMERA)
    usual = fuse_capture(capture, Similarity.identity())
    allow(monkeypatch, 2 * usual.blocks * BYTES_PER_BLOCK // 3)
    less = fuse_capture(capture, Similarity.identity())
    assert usual.voxel_size < less.voxel_size < 3 * usual.voxel_size and less.blocks <= less.max_blocks < usual.blocks
    less.min_weight = 0.5
    assert len(less.mesh().vertices) > 100
    with pytest.raises(InputError, match=r"GB for the TSDF, and .* GB are allowed; use tsdf\.voxel_size="):
        fuse_capture(capture, Similarity.identity(), settings=TsdfSettings(voxel_size=usual.voxel_size))


def test_a_volume_takes_half_of_what_is_free(monkeypatch: pytest.MonkeyPatch) -> None:
    allow(monkeypatch, 2000 * BYTES_PER_BLOCK)
    assert TsdfVolume(0.1, 3.0).max_blocks == 1000
    assert TsdfVolume(0.1, 3.0, max_bytes=7 * BYTES_PER_BLOCK).max_blocks == 7


def test_matching_and_finding_poses_are_refused_before_they_begin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    allow(monkeypatch, 2**18)
    with pytest.raises(InputError, match=r"matching images .* needs about .* GB of memory and 0\.1 GB is free"):
        stereo_depths(views_of(texture), 1.0, 6.0, 3.0)
    capture = written(tmp_path, CAMERA)
    monkeypatch.setattr(sfm, "plan", lambda *given: pytest.fail("the job began"))
    with pytest.raises(InputError, match=r"finding features in 0\.0 million pixels needs about .* is free; lower poses\.image_size"):
        sfm.find_poses(capture, tmp_path / "out", PosesSettings(), threads=2)


def test_fewer_workers_look_for_features(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    capture = written(tmp_path, CAMERA)
    each = sfm.SIFT_BYTES * CAMERA.width * CAMERA.height
    asked: list[int] = []

    class Enough(Exception):
        pass

    def plan(capture: object, folder: object, settings: object, seed: int, threads: int, *_: object) -> None:
        asked.append(threads)
        raise Enough

    monkeypatch.setattr(sfm, "plan", plan)
    for free in (8 * each, int(2.5 * each), each):
        allow(monkeypatch, free)
        with pytest.raises(Enough):
            sfm.find_poses(capture, tmp_path / "out", PosesSettings(), threads=4)
    assert asked == [4, 2, 1]
    assert sfm._pixels(capture, 80) == 80 * 60 and np.isclose(each, sfm.SIFT_BYTES * sfm._pixels(capture, 10_000))


HUGE = 2**44
REFUSALS = {  # command → the estimate that is made too large, and what the refusal speaks of
    "render": (("render", "--views", "orbit", "--frames", "3"), "RENDER_BYTES", "rendering 3 pictures"),
    "evaluate": (("evaluate",), "SCORE_BYTES", "scoring 4 pictures"),
    "bake": (("bake",), "ROW_COPIES", "baking a field of"),
    "tsdf": (("tsdf", "--voxel-size", "0.2"), "RENDER_BYTES", "rendering 2 pictures"),
    "compare": (("compare",), "SCORE_BYTES", "scoring 4 pictures"),
}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run."""
    folder = tmp_path_factory.mktemp("little")
    answer = fieldfuse("run", make_source(folder / "room"), "--out", folder / "out", *OPTIONS)
    assert answer.code == 0, answer.err
    return folder / "out"


@pytest.mark.parametrize("name", REFUSALS)
def test_each_command_refuses_with_numbers_what_does_not_fit(name: str, finished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With little memory as such, the first stage that reads anything refuses; here each command's own estimate is the one that does."""
    (command, *more), bytes_each, what = REFUSALS[name]
    monkeypatch.setattr(memory, bytes_each, HUGE)
    if name == "evaluate":  # scored once, it would only be read
        (finished / "stages" / "evaluate.json").unlink(missing_ok=True)
    answer = fieldfuse(command, finished, *more, "--threads", "1", "--quiet")
    assert answer.code == 2, answer
    sentence = answer.sentence()
    assert what in sentence and "GB of memory and" in sentence and "is free; " in sentence, sentence


@pytest.mark.parametrize(
    ("bytes_each", "wanted", "file", "said"),
    [
        ("RENDER_BYTES", "obj", "mesh.obj", "points and meshes were left out: rendering 3 pictures"),
        ("SEEN_BYTES", "splat", "splat.ply", "the splats were left out: making splats of a field of"),
    ],
)
def test_an_export_leaves_out_what_does_not_fit_and_says_so(
    bytes_each: str, wanted: str, file: str, said: str, finished: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(memory, bytes_each, HUGE)
    answer = fieldfuse("export", finished, "--formats", f"{wanted},cameras", "--threads", "1", "--quiet", "--json")
    assert answer.code == 0, answer
    assert said in answer.out and "GB is free" in answer.out
    assert (finished / "exports" / "cameras" / "transforms.json").is_file() and not (finished / "exports" / file).is_file()


def test_prepared_pictures_that_do_not_fit_are_not_read(finished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    allow(monkeypatch, 1000)
    answer = fieldfuse("render", finished, "--quiet")
    assert answer.code == 2 and "the prepared pictures of" in answer.sentence() and "GB is free" in answer.sentence()
