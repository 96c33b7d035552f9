"""Validation cases from a capture on disk, and what is measured on them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from fieldfuse.camera import Intrinsics
from fieldfuse.errors import InputError
from fieldfuse.nerfusion.training.procedural import ProceduralScene
from fieldfuse.nerfusion.training.train import make_model
from fieldfuse.nerfusion.training.validate import Validation, load_cases, predict, validate
from tests.conftest import shared_data
from tests.nerfusion.training.layouts import write, write_matrix
from tests.nerfusion.training.tiny import tiny_settings


def capture(root: Path, frames: int = 17) -> Path:
    """A procedural room as a ScanNet folder."""
    scene = ProceduralScene("room", np.random.default_rng(2), 64, frames)
    pictures = scene.pictures(range(frames))
    scale = 2.0 / float(pictures.depths[pictures.depths > 0].median())
    height, width = pictures.images.shape[2:]
    fx, fy, cx, cy = pictures.intrinsics[0].double().tolist()
    matrix = np.eye(4)
    matrix[:3, :3] = Intrinsics(width, height, fx, fy, cx, cy).matrix_integer_centres()
    for name in ("color", "depth"):
        write_matrix(root / "intrinsic" / f"intrinsic_{name}.txt", matrix)
    for i in range(frames):
        write(root / "color" / f"{i}.png", (pictures.images[i].permute(1, 2, 0).numpy()[:, :, ::-1] * 255).round().astype(np.uint8))
        write(root / "depth" / f"{i}.png", (pictures.depths[i].numpy() * scale * 1000).clip(0, 65000).astype(np.uint16))
        pose = scene.world_from_camera[i].copy()
        pose[:3, 3] *= scale
        write_matrix(root / "pose" / f"{i}.txt", pose)
    return root


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return capture(tmp_path_factory.mktemp("capture") / "room")


def wanted():  # type: ignore[no-untyped-def]
    return tiny_settings(record={"validation_side": 48, "validation_views": 2})


def test_cases_predict_held_out_pictures_from_others(folder: Path) -> None:
    cases = load_cases(folder, wanted())
    assert [case.picture for case in cases] == ["0", "16"]  # of 0, 8, 16
    for case in cases:
        used = set(case.sample.references.unique().tolist())
        target = int(case.sample.targets[0, 0])
        assert target not in used and case.nearest != target
        # No held-out picture is among the references: they are the 1st, 9th and 17th of the capture.
        assert case.sample.references.shape == (2, 3)
        assert 0 < case.sample.near < case.sample.far and float(case.sample.pictures.depths[target].max()) > 0
        distances = (
            case.sample.pictures.world_from_camera[case.sample.references[:, 0], :3, 3]
            - case.sample.pictures.world_from_camera[target, :3, 3]
        ).norm(dim=1)
        assert len(distances) == 2


def test_numbers_and_sheet_of_a_validation(folder: Path, tmp_path: Path) -> None:
    settings = wanted()
    model = make_model(settings)
    cases = load_cases(folder, settings)
    numbers, each = validate(model, cases, torch.device("cpu"), Validation(levels=2), tmp_path / "sheet.png")
    names = {"psnr_local", "psnr_fused", "psnr_fused_1", "psnr_nearest", "depth_error", "depth_likelihood"}
    assert {f"val_{name}" for name in names} == set(numbers)
    assert each.keys() == {"room"} and all(np.isfinite(list(numbers.values())))
    assert model.training
    sheet = cv2.imread(str(tmp_path / "sheet.png"))
    height, width = cases[0].sample.pictures.images.shape[2:]
    assert sheet is not None and sheet.shape == (2 * (height + 2), 3 * width, 3)
    truth = (cases[0].sample.pictures.images[int(cases[0].sample.targets[0, 0])].permute(1, 2, 0).numpy() * 255).round()
    assert np.abs(sheet[:height, :width, ::-1] - truth).max() <= 1


def test_prediction_does_not_look_at_the_target(folder: Path) -> None:
    """Another target picture with the same camera gives the same prediction."""
    from dataclasses import replace

    settings = wanted()
    model, case = make_model(settings).eval(), load_cases(folder, settings)[0]
    images = case.sample.pictures.images.clone()
    images[int(case.sample.targets[0, 0])] = 0
    blind = replace(case, sample=replace(case.sample, pictures=replace(case.sample.pictures, images=images)))
    first, second = (predict(model, one, torch.device("cpu"), prune=False) for one in (case, blind))
    assert torch.equal(first.colour, second.colour) and first.numbers["psnr_fused"] != second.numbers["psnr_fused"]


def test_too_small_a_capture_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="too few"):
        load_cases(capture(tmp_path / "few", frames=3), wanted())


def test_real_captures_make_cases() -> None:
    cases = load_cases(shared_data("scannet_sample_11"), tiny_settings(record={"validation_side": 64, "validation_views": 4}))
    assert len(cases) == 2 and all(case.sample.pictures.images.shape[3] == 64 for case in cases)
