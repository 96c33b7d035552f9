"""Structure from motion with the real library on small pictures: accuracy, repeatability, reuse, and a child that dies."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import psutil
import pytest
from PIL import Image

from fieldfuse.capture.types import Capture, Frame
from fieldfuse.config import PosesSettings
from fieldfuse.errors import InputError, Interrupted, PoseError
from fieldfuse.files import read_json
from fieldfuse.poses import sfm
from fieldfuse.poses.child import run_child
from fieldfuse.poses.job import GONE_FAR, GONE_ON, IN_PARTS, Job
from fieldfuse.poses.result import PoseResult
from fieldfuse.poses.sfm import find_poses
from fieldfuse.progress import Progress
from tests.poses.textured import (
    aligned_error,
    arc,
    render,
    texture,
    turning,
    write_capture,
)

SMALL = PosesSettings(max_features=800)
FEW = PosesSettings(max_features=400)  # where it is not about how good the cameras are


def workers() -> list[psutil.Process]:
    def works(process: psutil.Process) -> bool:
        return "fieldfuse.poses.worker" in (process.info["cmdline"] or []) and process.status() != psutil.STATUS_ZOMBIE

    return [process for process in psutil.process_iter(["cmdline"]) if works(process)]


def workers_on(folder: Path) -> list[psutil.Process]:
    return [process for process in workers() if any(str(folder) in part for part in process.cmdline())]


class Listener(Progress):
    def __init__(self) -> None:
        self.notes: list[str] = []
        self.shares: list[float] = []

    def update(self, done: float, total: float, note: str = "") -> None:
        self.notes.append(note)
        self.shares.append(done / total)


@pytest.fixture(scope="module")
def pictures() -> tuple[list[np.ndarray], np.ndarray]:
    poses = arc(8)
    return [render(pose)[0] for pose in poses], poses


@pytest.fixture(scope="module")
def found(pictures, tmp_path_factory) -> tuple[PoseResult, Path, Listener]:
    out = tmp_path_factory.mktemp("corner")
    listener = Listener()
    result = find_poses(write_capture(out / "photos", pictures[0]), out, SMALL, seed=3, threads=1, progress=listener)
    return result, out, listener


def test_every_camera_is_found_where_it_was(found, pictures):
    result, out, _ = found
    assert (result.registered, result.total, result.missing, result.models[0]) == (8, 8, [], 8)
    assert result.names == [f"{n:03d}" for n in range(8)]
    assert aligned_error(result.world_from_camera[:, :3, 3], pictures[1][:, :3, 3]) < 0.01
    assert result.intrinsics[0].fx == pytest.approx(300, rel=0.03)
    assert len(result.points) == len(result.point_errors) > 150
    assert np.median(result.point_errors) < 1.0
    assert (out / "sparse" / "model" / "images.bin").exists() and (out / "sparse" / "log.txt").stat().st_size > 0


def test_progress_tells_each_step_and_never_goes_back(found):
    _, _, listener = found
    assert any(note.startswith("features 8 of 8") for note in listener.notes)
    assert any(note.startswith("matching") for note in listener.notes)
    assert any("registered" in note for note in listener.notes)
    assert all(b >= a - 1e-9 for a, b in zip(listener.shares, listener.shares[1:], strict=False))


def test_mapping_in_parts_is_noted(found):
    _, out, _ = found
    job, facts = Job.load(out / "sparse" / "job.json"), read_json(out / "sparse" / "result.json")
    parts = {"attempt": IN_PARTS, "models": [8]}
    capture = Capture("photos", out / "photos", job.images)
    together = {**facts, "attempts": [parts], "model": {**facts["model"], "attempt": IN_PARTS}}
    assert "parts of 500 images were mapped side by side on one machine and put together" in sfm._result(capture, job, together).warnings
    whole = {**facts, "attempts": [parts, *facts["attempts"]]}
    assert any("all were mapped in one piece" in text for text in sfm._result(capture, job, whole).warnings)
    assert not any("parts of 500" in text for text in sfm._result(capture, job, facts).warnings)


def test_points_reproject_and_opencv_axes_hold(found):
    result, _, _ = found
    local = (result.points - result.world_from_camera[4, :3, 3]) @ result.world_from_camera[4, :3, :3]
    assert np.mean(local[:, 2] > 0) > 0.99  # before the camera: z is forward


def test_what_would_not_repeat_takes_one_thread_unless_pictures_are_many():
    from fieldfuse.poses.job import REPEATABLE, Job

    for count, expected in ((2, 1), (REPEATABLE, 1), (REPEATABLE + 1, 4)):
        assert Job("out", (Frame("a", Path("a.png")),) * count, True, True, False, 1600, 4096, 0, 4).repeating == expected


def test_a_second_run_reuses_features_and_gives_the_same(found, pictures, tmp_path):
    result, out, _ = found
    before = (out / "sparse" / "pictures.json").stat().st_mtime_ns
    listener = Listener()
    capture = write_capture(tmp_path / "fresh", pictures[0])
    fresh = find_poses(capture, tmp_path, SMALL, seed=3, threads=2)
    np.testing.assert_array_equal(fresh.world_from_camera, result.world_from_camera)  # one thread and two
    frames = tuple(Frame(path.stem, path) for path in sorted((out / "photos").iterdir()))
    again = find_poses(Capture("photos", out / "photos", frames), out, SMALL, seed=3, threads=1, progress=listener)
    np.testing.assert_allclose(again.world_from_camera, result.world_from_camera, atol=1e-6)
    assert listener.notes[0] == "features 8 of 8"
    assert (out / "sparse" / "pictures.json").stat().st_mtime_ns == before


def test_changed_pictures_are_not_answered_from_the_old_database(pictures, tmp_path):
    capture = write_capture(tmp_path / "photos", [texture(n)[:240, :320] for n in range(3)])
    with pytest.raises(PoseError, match="share enough features"):
        find_poses(capture, tmp_path, FEW, threads=1)
    capture = write_capture(tmp_path / "photos", pictures[0][:5])
    assert find_poses(capture, tmp_path, FEW, threads=1).registered == 5


@pytest.mark.parametrize("case", ["identical", "black", "blurred", "turning", "turning on", "one", "unrelated"])
def test_bad_input_gives_one_sentence_that_says_why(case, pictures, tmp_path):
    made = {
        "identical": lambda: ([pictures[0][0]] * 10, "identical"),
        "black": lambda: ([np.zeros((240, 320), np.uint8)] * 6, "no features .* flat colour"),
        "blurred": lambda: ([cv2.GaussianBlur(p, (0, 0), 40) for p in pictures[0][:5]], "no features"),
        "turning": lambda: (turning(8), "turned on the spot"),
        "turning on": lambda: (turning(12), "turned on the spot"),  # of these COLMAP makes a model, with a lens that explains them
        "one": lambda: (pictures[0][:1], "not enough"),
        "unrelated": lambda: ([texture(n)[:240, :320] for n in range(4)], "share enough features"),
    }[case]()
    capture = write_capture(tmp_path / "photos", made[0])
    with pytest.raises(PoseError, match=made[1]) as caught:
        find_poses(capture, tmp_path, SMALL if case == "turning on" else FEW, threads=1)
    message = str(caught.value)
    assert "\n" not in message and message.count(". ") == 0 and str(tmp_path) in message


def test_a_partial_model_names_what_is_missing_and_why(pictures, tmp_path):
    strangers = [texture(50)[:240, :320], np.zeros((240, 320), np.uint8)]
    capture = write_capture(tmp_path / "photos", pictures[0][:5] + strangers)
    result = find_poses(capture, tmp_path, FEW, threads=1)
    assert (result.registered, result.total, result.missing) == (5, 7, ["005", "006"])
    text = " | ".join(result.warnings)
    assert (
        "5 of 7 frames" in text and "no other frame matches them: 005" in text and "too few features (dark, blurred or blank): 006" in text
    )


def test_pictures_turned_by_exif_are_seen_upright(pictures, tmp_path):
    capture = write_capture(tmp_path / "photos", [])
    frames = []
    for n, picture in enumerate(pictures[0][:5]):
        image = Image.fromarray(np.ascontiguousarray(np.rot90(picture)))  # stored turned; orientation 6 turns it back
        exif = image.getexif()
        exif[0x0112] = 6
        path = tmp_path / "photos" / f"{n}.jpg"
        image.save(path, quality=95, exif=exif)
        frames.append(Frame(path.stem, path))
    capture = Capture("photos", tmp_path / "photos", tuple(frames))
    result = find_poses(capture, tmp_path, FEW, threads=1)
    assert {(camera.width, camera.height) for camera in result.intrinsics} == {(320, 240)}
    assert result.registered == 5


def test_a_truncated_picture_is_an_input_error_not_a_crash(pictures, tmp_path):
    capture = write_capture(tmp_path / "photos", pictures[0][:3])
    broken = capture.frames[1].image
    broken.write_bytes(broken.read_bytes()[:400])
    with pytest.raises(InputError, match=r"001\.png"):
        find_poses(capture, tmp_path, FEW, threads=1)


def test_a_child_killed_by_a_signal_is_reported_with_its_log(pictures, tmp_path):
    class Murder(Progress):
        def update(self, done: float, total: float, note: str = "") -> None:
            for process in workers_on(tmp_path):
                process.send_signal(signal.SIGSEGV)

    with pytest.raises(PoseError, match=r"signal SIG(SEGV|ABRT).*log\.txt"):
        find_poses(write_capture(tmp_path / "photos", pictures[0]), tmp_path, FEW, threads=1, progress=Murder())
    assert (tmp_path / "sparse" / "log.txt").exists()
    assert workers_on(tmp_path) == []
    # What the dead one had begun is no obstacle to the next.
    assert find_poses(write_capture(tmp_path / "photos", pictures[0][:5]), tmp_path, FEW, threads=1).registered == 5


def test_a_wish_to_stop_ends_the_child(pictures, tmp_path):
    class Stop(Progress):
        asked = False

        def update(self, done: float, total: float, note: str = "") -> None:
            self.asked = True

        def stopping(self) -> bool:
            return self.asked

    with pytest.raises(Interrupted):
        find_poses(write_capture(tmp_path / "photos", pictures[0]), tmp_path, FEW, threads=1, progress=Stop())
    assert workers_on(tmp_path) == []


def test_the_child_dies_with_its_parent(pictures, tmp_path):
    write_capture(tmp_path / "photos", pictures[0])
    script = (
        "import sys; from pathlib import Path\n"
        "from fieldfuse.capture.types import Capture, Frame; from fieldfuse.poses.sfm import find_poses\n"
        "root = Path(sys.argv[1]); frames = tuple(Frame(p.stem, p) for p in sorted((root / 'photos').iterdir()))\n"
        "find_poses(Capture('photos', root, frames), root, threads=1)\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2])}
    parent = subprocess.Popen([sys.executable, "-c", script, str(tmp_path)], env=environment)
    deadline = time.monotonic() + 600
    while not workers_on(tmp_path) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert workers_on(tmp_path)
    parent.kill()
    parent.wait()
    deadline = time.monotonic() + 300
    while workers_on(tmp_path) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert workers_on(tmp_path) == []


def test_a_child_that_says_nothing_is_ended(tmp_path):
    began = time.monotonic()
    with pytest.raises(PoseError, match="said nothing"):
        run_child("timeit", ["-n1", "-r1", "import time; time.sleep(3600)"], tmp_path / "log.txt", lambda message: None, silence=0.5)
    assert time.monotonic() - began < 600  # not the hour that it would take


def test_a_child_that_aborts_or_fails_is_reported(tmp_path):
    with pytest.raises(PoseError, match="SIGABRT"):
        run_child("timeit", ["-n1", "-r1", "import os; os.abort()"], tmp_path / "log.txt", lambda message: None)
    with pytest.raises(PoseError, match=r"exit code 1.*nothing at all"):
        run_child("timeit", ["-n1", "-r1", "raise ValueError('nothing at all')"], tmp_path / "log.txt", lambda message: None)


def test_a_full_disk_is_said_to_be_one(pictures, tmp_path):
    """A limit on file size stands in for a full disk: SQLite meets the same failed write."""
    capture = write_capture(tmp_path / "photos", pictures[0][:3])
    script = (
        "import resource, signal, sys; from pathlib import Path\n"
        "from fieldfuse.capture.types import Capture, Frame; from fieldfuse.errors import OutputError; from fieldfuse.poses.sfm import "
        "find_poses\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN); resource.setrlimit(resource.RLIMIT_FSIZE, (150_000, 150_000))\n"
        "root = Path(sys.argv[1]); frames = tuple(Frame(p.stem, p) for p in sorted((root / 'photos').iterdir()))\n"
        "try:\n    find_poses(Capture('photos', root, frames), root, threads=1)\n"
        "except OutputError as error:\n    print('OUTPUT', error)\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2])}
    command = [sys.executable, "-B", "-c", script, str(capture.root.parent)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=600, check=False)
    assert done.stdout.startswith("OUTPUT cannot write"), done.stdout + done.stderr
    assert done.stdout.count("\n") == 1


def test_what_the_strict_mapper_has_no_place_for_is_added_and_said(tmp_path):
    """A camera that turns away at the end of its way and hardly moves on: its last pictures share little with the others."""
    poses = list(arc(8))
    for k in (1, 2, 3):
        turned = poses[7].copy()
        turned[:3, :3] = poses[7][:3, :3] @ cv2.Rodrigues(np.array([0, -np.radians(45 + 3 * k), 0]))[0]
        turned[:3, 3] += 0.02 * k * poses[7][:3, 0]
        poses.append(turned)
    result = find_poses(write_capture(tmp_path / "photos", [render(pose)[0] for pose in poses]), tmp_path, SMALL, seed=3, threads=1)
    attempts = read_json(tmp_path / "sparse" / "result.json")["attempts"]
    assert [attempt["attempt"] for attempt in attempts] == ["incremental", GONE_ON]
    strict, gone_on = (attempt["models"][0] for attempt in attempts)
    assert 8 <= strict < gone_on == result.registered
    assert any(f"{gone_on - strict} of {gone_on} frames were placed by fewer matches" in warning for warning in result.warnings)
    true = np.array([poses[int(name)] for name in result.names])
    assert aligned_error(result.world_from_camera[:, :3, 3], true[:, :3, 3]) < 0.01
    assert not (tmp_path / "sparse" / "start").exists()


def test_a_camera_that_turns_far_and_hardly_moves_is_followed(tmp_path):
    """As before a bare wall: 70° in steps of five, with so little way that no point is seen from two sides by the usual measure."""
    poses = list(arc(8))
    for k in range(1, 15):
        turned = poses[7].copy()
        turned[:3, :3] = poses[7][:3, :3] @ cv2.Rodrigues(np.array([0, -np.radians(5 * k), 0]))[0]
        turned[:3, 3] += 0.004 * k * poses[7][:3, 0]
        poses.append(turned)
    result = find_poses(write_capture(tmp_path / "photos", [render(pose)[0] for pose in poses]), tmp_path, SMALL, seed=3, threads=1)
    attempts = read_json(tmp_path / "sparse" / "result.json")["attempts"]
    assert [attempt["attempt"] for attempt in attempts] == ["incremental", GONE_ON, GONE_FAR]
    strict, far = attempts[0]["models"][0], attempts[2]["models"][0]
    assert strict < far == result.registered and far >= 20
    assert any(f"{far - strict} of {far} frames were placed by fewer matches" in warning for warning in result.warnings)
    true = np.array([poses[int(name)] for name in result.names])
    assert aligned_error(result.world_from_camera[:, :3, 3], true[:, :3, 3]) < 0.01
