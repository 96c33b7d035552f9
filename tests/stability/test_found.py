"""What the fuzz runs have found, one small test for each."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

from toolkit.capture.storage import capture_from_dict, capture_to_dict
from toolkit.capture.types import Capture
from toolkit.config import load_settings
from toolkit.effects.correct import Corrections
from toolkit.errors import InputError
from toolkit.evaluate.selftest.edit import small_field
from toolkit.render.bake import bake
from toolkit.render.bake_file import METADATA_KEY, read_baked, write_baked
from toolkit.simulate.settings import read_scene_file
from toolkit.training.nerfusion.settings import load_train_settings


def test_numbers_of_400_digits_in_a_stored_capture() -> None:
    data = {**capture_to_dict(Capture("photos", Path("/x"), ())), "depth_scale": 10**400}
    with pytest.raises(InputError, match="not usable"):
        capture_from_dict(data)


@pytest.mark.parametrize("text", ["1", "- 1", "[", "null", "text", "{a: [1, 2", "? x", "a: b: c", "\x00", "[" * 50_000])
def test_yaml_that_is_no_table(text: str, tmp_path: Path) -> None:
    path = tmp_path / "file.yaml"
    path.write_text(text)
    for read in (read_scene_file, load_train_settings, lambda path: load_settings(file=path)):
        try:
            read(path)
        except InputError as error:
            assert "\n" not in str(error) and str(path) in str(error)


@pytest.mark.parametrize("value", ["NaN", "Infinity"])
def test_a_baked_field_before_a_background_that_is_no_colour(value: str, tmp_path: Path) -> None:
    path = tmp_path / "baked.safetensors"
    write_baked(path, bake(small_field(1, 0.2)))
    with safe_open(str(path), framework="np") as source:
        about = json.loads(source.metadata()[METADATA_KEY])
    about["background"][0] = float(value)
    save_file(load_file(str(path)), str(path), metadata={METADATA_KEY: json.dumps(about)})
    with pytest.raises(InputError, match="background is not a colour"):
        read_baked(path)


def test_numbers_of_400_digits_among_corrections() -> None:
    data = {**Corrections().to_dict(), "corner": 10**400}
    with pytest.raises(InputError, match=r"effects\.json is not"):
        Corrections.from_dict(data)
