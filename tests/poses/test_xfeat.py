"""Learned features: the network on made-up weights, what a damaged file comes to, and, where the weights are installed, what they find."""

from __future__ import annotations

import pickle
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import torch.nn.functional as F

from fieldfuse.capture import open_capture
from fieldfuse.config import PosesSettings
from fieldfuse.errors import InputError, PoseError
from fieldfuse.poses import sfm, worker, xfeat
from fieldfuse.poses.database import floats, learned, sift
from fieldfuse.poses.job import GONE_ON, SIFT, XFEAT, Job
from fieldfuse.poses.mapping import many, plain
from tests.conftest import shared_data
from tests.poses.textured import aligned_error, all_pairs, arc, centre_error, made_job, render, silent, turning, write_capture

needs_weights = pytest.mark.skipif(xfeat.weights_file() is None, reason=f"XFeat's weights are not installed: {xfeat.INSTALL}")


def made_up() -> dict[str, torch.Tensor]:
    """Weights by the names and shapes of the real ones."""
    random = torch.Generator().manual_seed(7)
    state = {}
    for block, layers in xfeat.BLOCKS.items():
        for number, (inside, outside, size, _) in enumerate(layers):
            at = f"{block}.{number}.layer"
            state[f"{at}.0.weight"] = torch.randn(outside, inside, size, size, generator=random) * (2 / (inside * size * size)) ** 0.5
            state[f"{at}.1.running_mean"] = 0.1 * torch.randn(outside, generator=random)
            state[f"{at}.1.running_var"] = 0.5 + torch.rand(outside, generator=random)
    for name, inside, outside in xfeat.PLAIN.values():
        state[f"{name}.weight"] = torch.randn(outside, inside, 1, 1, generator=random) / inside**0.5
        state[f"{name}.bias"] = 0.1 * torch.randn(outside, generator=random)
    return state


@pytest.fixture(scope="module")
def network(tmp_path_factory) -> xfeat.Network:
    path = tmp_path_factory.mktemp("weights") / "xfeat.pt"
    torch.save(made_up(), path)
    return xfeat.read_network(path)


# ------------------------------------------------------------------------------------------------- the network


def test_shapes_and_ranges(network):
    grey = torch.rand(2, 1, 64, 96)
    descriptors, logits, reliability = xfeat.dense(network, grey)
    assert descriptors.shape == (2, 64, 8, 12) and logits.shape == (2, 65, 8, 12) and reliability.shape == (2, 1, 8, 12)
    torch.testing.assert_close(descriptors.norm(dim=1), torch.ones(2, 8, 12))
    assert reliability.min() >= 0 and reliability.max() <= 1
    for one, both in zip(xfeat.dense(network, 3 * grey[1:] + 1), (descriptors, logits, reliability), strict=True):
        torch.testing.assert_close(one, both[1:], atol=1e-3, rtol=1e-3)  # neither the rest of a batch nor light and contrast matter


def test_normalisation_is_folded_into_the_kernels(network):
    state, x = made_up(), torch.randn(1, 24, 10, 12)
    expected = x
    for number in range(2):
        at = f"block2.{number}.layer"
        expected = F.conv2d(expected, state[f"{at}.0.weight"], padding=1)
        expected = F.batch_norm(expected, state[f"{at}.1.running_mean"], state[f"{at}.1.running_var"]).relu()
    torch.testing.assert_close(xfeat._run(network, "block2", x), expected, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("shape", [(48, 80), (7, 5), (33, 300)])
def test_keypoints_lie_in_the_image_and_repeat(network, shape):
    grey = np.random.default_rng(1).integers(0, 255, shape, dtype=np.uint8)
    keypoints, descriptors = xfeat.detect(network, grey, 50)
    assert keypoints.dtype == descriptors.dtype == np.float32 and 0 < len(keypoints) == len(descriptors) <= 50
    assert (keypoints[:, :2] > 0).all() and (keypoints[:, :2] < shape[::-1]).all()
    np.testing.assert_allclose(np.linalg.norm(descriptors, axis=1), 1, atol=1e-5)
    with ThreadPoolExecutor(2) as pool:
        for again in pool.map(lambda _: xfeat.detect(network, grey, 50), range(4)):
            np.testing.assert_array_equal(again[0], keypoints)
            np.testing.assert_array_equal(again[1], descriptors)
    fewer, _ = xfeat.detect(network, grey, 3)
    np.testing.assert_array_equal(fewer, keypoints[:3])


def test_matches_are_mutual_and_similar(monkeypatch):
    random = np.random.default_rng(2)
    first = random.standard_normal((90, 64)).astype(np.float32)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = first[::-1][:70] + 0.03 * random.standard_normal((70, 64)).astype(np.float32)
    second /= np.linalg.norm(second, axis=1, keepdims=True)
    found = xfeat.mutual(first, second)
    np.testing.assert_array_equal(found[np.argsort(found[:, 1])], [(89 - j, j) for j in range(70)])
    cosine = first @ second.T
    loose = xfeat.mutual(first, second, -1.0)
    expected = [(i, int(row.argmax())) for i, row in enumerate(cosine) if cosine[:, row.argmax()].argmax() == i]
    np.testing.assert_array_equal(loose, expected)
    monkeypatch.setattr(xfeat, "ROWS", 13)  # in pieces it is the same
    np.testing.assert_array_equal(xfeat.mutual(first, second, -1.0), loose)
    assert len(xfeat.mutual(first[:0], second)) == len(xfeat.mutual(first, second[:0])) == 0
    packed = floats(second.astype(np.float16).view(np.uint8), XFEAT)
    np.testing.assert_allclose(packed, second, atol=1e-3)


# ------------------------------------------------------------------------------------------------- files that are not the weights


class Danger:
    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (Path("touched"),)


def changed(name: str, value: Any) -> dict[str, Any]:
    return {**made_up(), name: value}


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"no weights at all" * 100,
        pickle.dumps(Danger()),
        {"block1": torch.zeros(3)},
        [torch.zeros(3)],
        changed("heatmap_head.2.bias", torch.zeros(2)),
        changed("heatmap_head.2.bias", "text"),
        changed("block1.0.layer.1.running_var", torch.full((4,), torch.nan)),
        "cut",
    ],
    ids=["empty", "text", "code", "other", "list", "shape", "type", "nan", "cut"],
)
def test_a_damaged_file_is_a_sentence(tmp_path, monkeypatch, content):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "xfeat.pt"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        torch.save(made_up() if content == "cut" else content, path)
    if isinstance(content, str):
        path.write_bytes(path.read_bytes()[:-5000])
    with pytest.raises(InputError, match=r"xfeat\.pt does not hold XFeat's weights .*make xfeat") as caught:
        xfeat.read_network(path)
    assert "\n" not in str(caught.value) and not (tmp_path / "touched").exists()


def test_a_file_too_large_to_be_them_is_not_read(tmp_path, monkeypatch):
    path = tmp_path / "xfeat.pt"
    torch.save(made_up(), path)
    monkeypatch.setattr(xfeat, "MAX_WEIGHTS_BYTES", 1000)
    with pytest.raises(InputError, match="too large"):
        xfeat.read_network(path)


@pytest.fixture
def weights(monkeypatch):
    """Puts a file, or none, in the place of the installed one."""

    def put(path: Path | None) -> None:
        monkeypatch.setattr(xfeat, "weights_file", lambda: path)
        xfeat.installed.cache_clear()

    yield put
    xfeat.installed.cache_clear()


def test_without_weights_sift_serves(tmp_path, weights):
    weights(None)
    assert sfm._features("auto") == sfm._features("sift") == (SIFT, None, [])
    with pytest.raises(InputError, match="not installed; make xfeat"):
        sfm._features("xfeat")
    poses = arc(4, 40)
    result = sfm.find_poses(write_capture(tmp_path / "photos", [render(pose)[0] for pose in poses]), tmp_path, seed=3, threads=1)
    assert result.registered == 4 and result.warnings == []


def test_with_damaged_weights_sift_serves_and_it_is_said(tmp_path, weights):
    (tmp_path / "xfeat.pt").write_bytes(b"damaged")
    weights(tmp_path / "xfeat.pt")
    first, second, notes = sfm._features("auto")
    assert (first, second) == (SIFT, None) and len(notes) == 1 and "not tried" in notes[0]
    with pytest.raises(InputError, match="does not hold"):
        sfm._features("xfeat")


def test_doctor_says_what_to_install(tmp_path, weights):
    from fieldfuse.pipelines import doctor

    weights(None)
    assert doctor._xfeat().status == doctor.WARN and "make xfeat" in doctor._xfeat().advice
    (tmp_path / "xfeat.pt").write_bytes(b"damaged")
    weights(tmp_path / "xfeat.pt")
    assert doctor._xfeat().status == doctor.WARN and "does not hold" in doctor._xfeat().found
    torch.save(made_up(), tmp_path / "xfeat.pt")
    weights(tmp_path / "xfeat.pt")
    assert doctor._xfeat().status == doctor.OK


# ------------------------------------------------------------------------------------------------- which model is taken


def placed(attempt: str, *shares: float) -> worker.Placed:
    model = SimpleNamespace(attempt=attempt) if shares else None
    return model, {"agreement": dict(enumerate(shares))}  # type: ignore[return-value]


def test_more_images_are_taken_where_their_matches_agree():
    strict, loose = "incremental", worker.LOOSE
    before = placed(strict, 0.9, 0.9, 0.9)
    assert worker._better(placed(strict, 0.9, 0.9, 0.9, 0.9), before)
    assert worker._better(placed(strict, 0.9, 0.9, 0.9), placed(strict))
    assert worker._better(placed(strict, 0.9, 0.9, 0.9), placed(strict, 0.9, 0.9, 0.75))  # as many, and clearer
    assert not worker._better(placed(strict, 0.9, 0.9, 0.9, 0.4), before)  # the one more contradicts its matches
    for looser in (loose, GONE_ON):
        assert not worker._better(placed(looser, 0.9, 0.9, 0.9, 0.9), before)
        assert worker._better(placed(looser, 0.9, 0.9, 0.9), placed(strict))
        assert not worker._better(placed(looser, 0.9, 0.4, 0.9), placed(strict))
    assert not worker._better(placed(strict, 0.9, 0.9), before)
    assert not worker._better(placed(strict, 0.8, 0.9, 0.9), before)


def test_a_model_that_is_folded_or_without_depth_is_not_taken(tmp_path, monkeypatch):
    monkeypatch.setattr(worker.mapping, "plain", lambda model: model)
    monkeypatch.setattr(worker, "failure", lambda facts: facts["model"])
    job = Job(str(tmp_path), (), True, True, False, 1600, 100, 0, 1)
    whole, mended, folded = ({"folded": one} for one in (None, {"left": 0, "contradicting": 5}, {"left": 5, "contradicting": 5}))
    assert worker._sane(job, None, whole) and worker._sane(job, None, mended) and not worker._sane(job, None, folded)  # type: ignore[arg-type]
    assert worker._sane(replace(job, sequential=False), None, folded)  # type: ignore[arg-type]
    assert not worker._sane(job, "too little parallax", whole)  # type: ignore[arg-type]


def test_a_few_frames_of_many_are_not_worth_another_attempt():
    assert 2 < many(100) <= 3 and 5 < many(300) <= 6


# ------------------------------------------------------------------------------------------------- with the real weights


@needs_weights
def test_they_find_what_is_seen_from_the_side():
    front = render(arc(1, 0)[0])[0][..., 0]
    wide = np.array([[0.5, 0, 40], [0.1, 1, 0]], np.float32)  # as a wall is seen from 60° to its side
    side = cv2.warpAffine(front, wide, (front.shape[1], front.shape[0]), flags=cv2.INTER_AREA, borderValue=90)

    def right(matches: np.ndarray, first: np.ndarray, second: np.ndarray) -> int:
        """Matches that are where the warp puts them."""
        expected = (first[matches[:, 0], :2] - 0.5) @ wide[:, :2].T + wide[:, 2] + 0.5
        return int(np.count_nonzero(np.linalg.norm(expected - second[matches[:, 1], :2], axis=1) < 3))

    (a, one), (b, other) = learned(front, 2048), learned(side, 2048)
    by_network = right(xfeat.mutual(floats(one, XFEAT), floats(other, XFEAT)).astype(int), a, b)
    (c, one), (d, other) = sift(front, 2048), sift(side, 2048)
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(one.astype(np.float32), other.astype(np.float32), k=2)
    by_sift = right(np.array([(m.queryIdx, m.trainIdx) for m, n in pairs if m.distance < 0.8 * n.distance]).reshape(-1, 2), c, d)
    assert by_network > 3 * max(by_sift, 10)


def ready(folder: Path, poses: np.ndarray, contrast: float, **how: Any) -> Job:
    """A job of photos of so little contrast, with its features and matches."""
    photos = [np.round(120 + contrast * (render(pose)[0].astype(np.float64) - 120)).astype(np.uint8) for pose in poses]
    capture = write_capture(folder / "photos", photos)
    return made_job(capture, all_pairs(len(poses)), **how)


@needs_weights
@pytest.mark.parametrize("contrast", [0.06, 0.02], ids=["few by SIFT", "none by SIFT"])
def test_photos_of_little_contrast_are_tried_by_other_features(tmp_path, monkeypatch, contrast):
    poses = arc(5, 60)
    job = ready(tmp_path, poses, contrast, second=XFEAT)
    before, _ = worker._mapped(job, silent)
    assert before is None or len(before.registered) < 5  # the reason to look again
    notes: list[str] = []
    model, facts = worker.place(job, lambda done, total, note: notes.append(note))
    assert model is not None and len(model.registered) == 5 and centre_error(model, poses) < 0.02
    assert min(facts["agreement"].values()) > 0.8 and any("by other features" in note for note in notes)
    assert min(record["keypoints"] for record in facts["pictures"]) > 100  # the records are those of the model's features
    assert plain(worker.place(job, silent)[0]) == plain(model)  # from what is there
    monkeypatch.setattr(worker, "_otherwise", lambda *_: pytest.fail("was tried by other features"))
    worker.place(replace(job, second=None), silent)


@needs_weights
def test_by_learned_features_alone(tmp_path):
    poses = arc(5, 60)
    capture = write_capture(tmp_path / "photos", [render(pose)[0] for pose in poses])
    results = [sfm.find_poses(capture, tmp_path / str(n), PosesSettings(features=XFEAT), seed=3, threads=n) for n in (1, 2)]
    assert results[0].registered == 5 and aligned_error(results[0].world_from_camera[:, :3, 3], poses[:, :3, 3]) < 0.01
    np.testing.assert_array_equal(results[0].world_from_camera, results[1].world_from_camera)  # whatever the threads


@needs_weights
@pytest.mark.parametrize("features", ["auto", "xfeat"])
def test_a_camera_that_turns_on_the_spot_stays_refused(tmp_path, features):
    with pytest.raises(PoseError, match=r"turned on the spot|hardly moved|too little parallax|one plane"):
        sfm.find_poses(write_capture(tmp_path / "photos", turning(6)), tmp_path, PosesSettings(max_features=400, features=features), seed=3)


@needs_weights
@pytest.mark.parametrize(
    ("capture", "count", "least"), [("fox_540x960", 5, 5), ("redkitchen", 6, 6), ("dtu_scan24_384", 5, 4)], ids=["fox", "redkitchen", "dtu"]
)
def test_few_photos_of_real_captures(tmp_path, capture, count, least):
    frames = open_capture(shared_data(capture)).frames
    chosen = [frames[i] for i in np.linspace(0, len(frames) - 1, count).round().astype(int)]
    (tmp_path / "photos").mkdir()
    for frame in chosen:
        (tmp_path / "photos" / f"{frame.name}{frame.image.suffix}").symlink_to(frame.image)
    result = sfm.find_poses(open_capture(tmp_path / "photos"), tmp_path, seed=0, threads=2)
    assert result.registered >= least
    true = {frame.name: frame.world_from_camera for frame in chosen}
    centres = np.array([true[name] for name in result.names])[:, :3, 3]
    assert aligned_error(result.world_from_camera[:, :3, 3], centres) < 0.15
