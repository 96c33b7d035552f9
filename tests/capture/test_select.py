"""Frames of a video: sharp, evenly spread over motion, written once."""

from __future__ import annotations

from collections.abc import Collection
from itertools import islice, pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldfuse.camera import Array
from fieldfuse.capture.images import load_image
from fieldfuse.capture.select import Measure, choose, displacement, measure_frames, select_frames, stride_of
from fieldfuse.capture.types import Capture
from fieldfuse.capture.video import iterate_video, read_video
from fieldfuse.config import CaptureSettings
from fieldfuse.errors import InputError, Interrupted, OutputError
from fieldfuse.progress import Progress
from tests.capture.board import texture
from tests.capture.films import film, film_at
from tests.conftest import shared_data

SIZE = (120, 160)


def pan(offsets: list[float], blurred: Collection[int] = ()) -> list[Array]:
    """Pictures of a long textured wall, the camera at `offsets` pixels along it; some smeared as by motion."""
    wall = texture(SIZE[0], SIZE[1] + int(max(offsets)) + 2, seed=4)
    pictures = []
    for index, offset in enumerate(offsets):
        shift = np.array([[1, 0, -offset], [0, 1, 0]], dtype=np.float64)
        picture = cv2.warpAffine(wall, shift, SIZE[::-1], flags=cv2.INTER_LINEAR)
        pictures.append(cv2.blur(picture, (11, 1)) if index in blurred else picture)
    return pictures


def select(video: Path, out: Path, max_frames: int, progress: Progress | None = None) -> Capture:
    return select_frames(read_video(video), out, CaptureSettings(max_frames=max_frames), progress or Progress())


def indices(capture: Capture) -> list[int]:
    return [int(frame.name.removeprefix("frame_")) for frame in capture.frames]


# ---------------------------------------------------------------------------------------------------- measuring


@pytest.mark.parametrize("shift", [0, 3, 9, 20])
def test_displacement_is_a_share_of_the_long_side(shift: int) -> None:
    before, after = (cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in pan([0, shift]))
    assert displacement(before, after) == pytest.approx(shift / 160, abs=0.004)


def test_displacement_where_tracking_fails() -> None:
    blank = np.full(SIZE, 120, np.uint8)
    assert displacement(blank, blank) == 0
    assert displacement(blank, blank + 80) > 0.2  # something happened, nobody knows how much
    one, other = (cv2.cvtColor(texture(*SIZE, seed=seed), cv2.COLOR_RGB2GRAY) for seed in (1, 2))
    assert displacement(one, other) > 0.15  # a cut


def test_jitter_and_noise_add_up_to_nothing() -> None:
    rng = np.random.default_rng(0)
    shaky = pan(list(10 + rng.uniform(-0.8, 0.8, 120)))
    noisy = [np.clip(picture + rng.normal(0, 3, picture.shape), 0, 255).astype(np.uint8) for picture in shaky]
    measure = measure_frames(iter(enumerate(noisy)), len(noisy))
    assert measure.motion[-1] < 0.02


# ---------------------------------------------------------------------------------------------------- choosing


@given(
    st.lists(st.tuples(st.floats(0.01, 100), st.floats(0, 0.3)), min_size=1, max_size=200),
    st.integers(1, 60),
)
def test_choice_is_bounded_and_ascending(values: list[tuple[float, float]], max_frames: int) -> None:
    measure = Measure([sharp for sharp, _ in values], list(np.cumsum([step for _, step in values])))
    chosen = choose(measure, max_frames)
    assert 1 <= len(chosen) <= min(max_frames, len(values))
    assert all(a < b for a, b in pairwise(chosen)) and chosen[0] >= 0 and chosen[-1] < len(values)


def test_even_motion_rather_than_even_time() -> None:
    # Slow for 200 frames, then ten times as fast for 100.
    way = np.concatenate([np.linspace(0, 1, 200), np.linspace(1, 6, 101)[1:]])
    chosen = choose(Measure([1.0] * 300, list(way)), 30)
    steps = np.diff(way[chosen])
    assert len(chosen) == 30 and steps.max() < 1.6 * steps.min()
    assert sum(index >= 200 for index in chosen) >= 24


def test_a_still_stretch_gives_one_frame() -> None:
    way = np.concatenate([np.linspace(0, 1, 50), np.ones(200), np.linspace(1, 2, 50)])
    chosen = choose(Measure([1.0] * 300, list(way)), 40)
    assert sum(50 <= index < 250 for index in chosen) <= 1


def test_the_sharper_neighbour_wins() -> None:
    sharp = np.ones(300)
    sharp[::2] = 0.5
    chosen = choose(Measure(list(sharp), list(np.linspace(0, 3, 300))), 30)
    assert all(index % 2 == 1 for index in chosen)


def test_blurred_frames_are_left_out_where_neighbours_overlap() -> None:
    sharp = np.ones(100)
    sharp[40:45] = 0.2
    close = choose(Measure(list(sharp), list(np.linspace(0, 1.5, 100))), 100)
    assert not set(close) & set(range(40, 45))
    far = choose(Measure(list(sharp), list(np.linspace(0, 20, 100))), 100)  # each frame is needed to bridge the way
    assert set(range(40, 45)) <= set(far)


# ---------------------------------------------------------------------------------------------------- the whole


def test_frames_are_written_sharp_and_spread(tmp_path: Path) -> None:
    offsets = [0.0] * 30 + list(np.linspace(0, 300, 90)) + [300.0] * 30
    blurred = set(range(32, 120, 3))
    video = film(tmp_path / "clip.avi", pan(offsets, blurred), fps=30)
    chosen = select(video, tmp_path / "run", 20)
    assert chosen.kind == "video" and chosen.ordered and not chosen.posed
    assert 15 <= len(chosen.frames) <= 20
    assert len(chosen.frames) == len(list((tmp_path / "run" / "frames").glob("*.jpg")))
    assert not set(indices(chosen)) & blurred
    way = np.diff(np.array(offsets)[indices(chosen)])
    assert way.max() < 35 and np.median(way) == pytest.approx(15, rel=0.4)
    assert chosen.extra["selected_from"] == 150 and chosen.extra["fps"] == 30
    everything = pan(offsets, blurred)
    for frame, index in zip(chosen.frames, indices(chosen), strict=True):
        assert frame.video_index is None and frame.image.is_file() and frame.image.parent == (tmp_path / "run" / "frames").resolve()
        assert np.abs(load_image(frame).astype(int) - everything[index]).mean() < 6


def test_a_rate_that_varies_is_no_damage(tmp_path: Path) -> None:
    pytest.importorskip("av", reason="PyAV is not installed; make test brings it")
    times = [67 * at for at in range(24)]  # every other frame of thirty a second
    chosen = select(film_at(tmp_path / "screen.mkv", pan([4.0 * at for at in range(24)]), times), tmp_path / "run", 10)
    assert chosen.extra["selected_from"] == 24 and 5 <= len(chosen.frames) <= 10
    (said,) = chosen.warnings
    assert "24 frames that can be decoded, not the" in said and "its rate varies" in said


class Counting(Progress):
    def __init__(self, stop_after: int = 10**9) -> None:
        self.notes: list[str] = []
        self.share = 0.0
        self.stop_after = stop_after

    def update(self, done: float, total: float, note: str = "") -> None:
        assert 0 <= done <= total
        self.notes.append(note)

    def stopping(self) -> bool:
        return len([note for note in self.notes if note.startswith("writing")]) >= self.stop_after


def test_a_second_run_measures_and_writes_nothing(tmp_path: Path) -> None:
    video = film(tmp_path / "clip.avi", pan(list(np.linspace(0, 300, 60))))
    first = select(video, tmp_path / "run", 12)
    times = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "run" / "frames").iterdir()}
    counting = Counting()
    second = select(video, tmp_path / "run", 12, counting)
    assert second == first
    assert {path.name: path.stat().st_mtime_ns for path in (tmp_path / "run" / "frames").iterdir()} == times
    assert not any(note.startswith(("frame ", "writing")) for note in counting.notes)


def test_an_interrupted_run_goes_on(tmp_path: Path) -> None:
    video = film(tmp_path / "clip.avi", pan(list(np.linspace(0, 300, 60))))
    whole = select(video, tmp_path / "whole", 12)
    with pytest.raises(Interrupted):
        select(video, tmp_path / "run", 12, Counting(stop_after=4))
    written = {path.name for path in (tmp_path / "run" / "frames").glob("*.jpg")}
    assert 0 < len(written) < len(whole.frames)
    counting = Counting()
    resumed = select(video, tmp_path / "run", 12, counting)
    assert indices(resumed) == indices(whole)
    assert sum(note.startswith("writing") for note in counting.notes) == len(whole.frames) - len(written)
    for a, b in zip(resumed.frames, whole.frames, strict=True):
        assert a.image.read_bytes() == b.image.read_bytes()


def test_another_number_or_another_video_replaces_the_frames(tmp_path: Path) -> None:
    video = film(tmp_path / "clip.avi", pan(list(np.linspace(0, 300, 60))))
    select(video, tmp_path / "run", 12)
    fewer = select(video, tmp_path / "run", 5)
    assert {path.stem for path in (tmp_path / "run" / "frames").glob("*.jpg")} == {frame.name for frame in fewer.frames}
    film(video, [picture[:, ::-1].copy() for picture in pan(list(np.linspace(0, 300, 60)))])
    other = select(video, tmp_path / "run", 5)
    assert np.abs(load_image(other.frames[0]).astype(int) - load_image(select(video, tmp_path / "fresh", 5).frames[0])).max() == 0


def test_a_damaged_measurement_is_made_again(tmp_path: Path) -> None:
    video = film(tmp_path / "clip.avi", pan(list(np.linspace(0, 300, 60))))
    first = select(video, tmp_path / "run", 12)
    for text in ("{", "[]", '{"key": 1}', '{"key": "x", "sharpness": ["a"], "motion": [1]}'):
        (tmp_path / "run" / "selection.json").write_text(text)
        assert indices(select(video, tmp_path / "run", 12)) == indices(first)


# ---------------------------------------------------------------------------------------------------- refused


def test_a_still_video_is_refused(tmp_path: Path) -> None:
    video = film(tmp_path / "clip.avi", pan([5.0]) * 40)
    with pytest.raises(InputError, match="does not move"):
        select(video, tmp_path / "run", 20)
    video = film(tmp_path / "nearly.avi", pan([5.0, 5.3] * 20))
    with pytest.raises(InputError, match="does not move") as refused:
        select(video, tmp_path / "run", 20)
    assert "interlaced" not in str(refused.value)


def test_a_black_video_is_refused(tmp_path: Path) -> None:
    video = film(tmp_path / "clip.avi", [np.zeros((*SIZE, 3), np.uint8)] * 20)
    with pytest.raises(InputError, match="shows nothing"):
        select(video, tmp_path / "run", 20)


@pytest.mark.parametrize("size", [SIZE, (540, 960)])  # of large pictures the memory that nothing is written to is black
def test_an_interlaced_video_is_refused_and_told_how_to_be_converted(tmp_path: Path, size: tuple[int, int]) -> None:
    av = pytest.importorskip("av", reason="PyAV is not installed; make test brings it")
    path = tmp_path / "clip.mts"
    with av.open(str(path), "w", format="mpegts") as file:
        stream = file.add_stream("mpeg2video", rate=25, options={"flags": "+ildct+ilme"})
        stream.height, stream.width, stream.pix_fmt = *size, "yuv420p"
        for picture in pan(list(np.linspace(0, 200, 12))):
            file.mux(stream.encode(av.VideoFrame.from_ndarray(cv2.resize(picture, size[::-1]), format="rgb24")))
        file.mux(stream.encode())
    with pytest.raises(InputError, match=r"interlaced.*ffmpeg -i clip\.mts -vf bwdif"):
        select(path, tmp_path / "run", 5)


def test_of_a_long_video_every_nth_frame_is_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert [stride_of(count, fps) for count, fps in ((1200, 30), (1201, 30), (9000, 30), (9000, 60), (9000, 0), (9000, 8))] == [
        1,
        2,
        3,
        6,
        1,
        1,
    ]
    offsets = list(np.linspace(0, 300, 120))
    blurred = set(range(2, 120, 6))  # even ones, which are those looked at
    video = film(tmp_path / "clip.avi", pan(offsets, blurred), fps=30)
    monkeypatch.setattr("fieldfuse.capture.select.MEASURED", 60)
    chosen = select(video, tmp_path / "run", 15)
    assert 12 <= len(chosen.frames) <= 15 and chosen.extra["selected_from"] == 120 and not chosen.warnings
    assert all(index % 2 == 0 for index in indices(chosen)) and not set(indices(chosen)) & blurred
    way = np.diff(np.array(offsets)[indices(chosen)])
    assert way.max() < 35 and np.median(way) == pytest.approx(20, rel=0.4)
    everything = pan(offsets, blurred)
    for frame, index in zip(chosen.frames, indices(chosen), strict=True):
        assert np.abs(load_image(frame).astype(int) - everything[index]).mean() < 6


def test_a_video_that_stops_early_is_told(tmp_path: Path) -> None:
    video = film(tmp_path / "clip.avi", pan(list(np.linspace(0, 300, 60))))
    capture = read_video(video)
    announced = capture.with_frames([*capture.frames, *[capture.frames[-1]] * 40])
    chosen = select_frames(announced, tmp_path / "run", CaptureSettings(max_frames=10))
    assert any("announces 100 frames, 60 could be decoded" in warning for warning in chosen.warnings)


def test_fast_motion_is_told(tmp_path: Path) -> None:
    video = film(tmp_path / "clip.avi", pan(list(np.linspace(0, 1500, 40))))
    assert any("overlap little" in warning for warning in select(video, tmp_path / "run", 8).warnings)


def test_photos_have_no_frames_to_choose(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not a video"):
        select_frames(Capture("photos", tmp_path, ()), tmp_path / "run", CaptureSettings())


def test_a_file_in_the_way(tmp_path: Path) -> None:
    video = film(tmp_path / "clip.avi", pan(list(np.linspace(0, 300, 20))))
    (tmp_path / "run").write_text("not a folder")
    with pytest.raises(OutputError, match="cannot write"):
        select(video, tmp_path / "run", 5)


def test_a_real_video() -> None:
    frames = islice(iterate_video(shared_data("beer_video/Beer.mp4")), 200)
    measure = measure_frames(frames, 200)
    chosen = choose(measure, 40)
    assert 35 <= len(chosen) <= 40
    gaps = np.diff(chosen)
    assert gaps.max() > 2 * gaps.min()  # by motion, not by time
    steps = np.diff(np.array(measure.motion)[chosen])
    assert steps.max() < 3 * np.median(steps)
