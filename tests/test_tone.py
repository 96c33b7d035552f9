"""Light into a picture and back: each undoes the other, sRGB is sRGB, and what is too bright is said to be unknown."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldfuse.camera import Intrinsics
from fieldfuse.effects.models import decode_srgb, encode_srgb
from fieldfuse.tone import LINEAR, SHOULDER, Tone, brighter, decode, encode, exposed, positive, share, square_radius

CAMERA = Intrinsics(64, 48, 50.0, 50.0, 30.0, 25.0)


def test_srgb_is_that_of_the_simulator() -> None:
    shown = np.linspace(0, 1, 4001)
    np.testing.assert_allclose(decode(shown), decode_srgb(torch.from_numpy(shown)).numpy(), atol=1e-12)
    np.testing.assert_allclose(encode(shown), encode_srgb(torch.from_numpy(shown)).numpy(), atol=1e-12)
    np.testing.assert_allclose(encode(decode(shown)), shown, atol=1e-7)
    assert LINEAR[0] == 0 and LINEAR[255] == 1
    np.testing.assert_allclose(encode(np.array([-1.0, 2.0])), [0, 1])


def test_light_falls_off_by_the_fourth_power_of_the_cosine() -> None:
    x, y = np.meshgrid(np.arange(64) + 0.5 - 30, np.arange(48) + 0.5 - 25)
    falloff = np.cos(np.arctan(np.sqrt(0.4**-0.5 - 1) * np.hypot(x, y) / 40)) ** 4  # half a diagonal is 40 pixels
    np.testing.assert_allclose(share(0.4, square_radius(CAMERA)), falloff, rtol=1e-5)
    np.testing.assert_allclose(Tone((2.0, 1.0, 0.5), 0.4).factor(CAMERA), falloff[..., None] * np.array([2, 1, 0.5]), rtol=1e-5)
    assert Tone((2.0, 1.0, 0.5)).factor(CAMERA).shape == (3,)


@settings(max_examples=40, deadline=None)
@given(
    gain=st.tuples(*[st.floats(0.4, 2.5)] * 3),
    corner=st.one_of(st.none(), st.floats(0.25, 1.0)),
    seed=st.integers(0, 1000),
)
def test_what_is_undone_and_put_back_is_the_photo(gain: tuple[float, float, float], corner: float | None, seed: int) -> None:
    """Wherever neither clips: to half a step of what is stored in between, which a gain makes larger."""
    tone, photo = Tone(gain, corner), np.random.default_rng(seed).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    scene, lost = tone.undone(photo, CAMERA)
    back = tone.applied(scene / 255, CAMERA) * 255
    free = (scene < 255) & (photo < 254)
    assert np.abs(back - photo)[free].max() <= 1.0 + 0.75 * max(gain) ** (1 / 2.4)
    if lost is not None:
        assert not lost[(photo < 254).all(2)].any()
        np.testing.assert_array_equal(lost[lost], (photo >= 254).any(2)[lost])


def test_it_survives_json_and_damage_is_refused() -> None:
    for tone in (Tone(), Tone((1.5, 1.0, 0.5)), Tone((1.0, 1.0, 1.0), 0.3)):
        assert Tone.from_dict(tone.to_dict()) == tone
    whole = Tone((1.5, 1.0, 0.5), 0.3).to_dict()
    for damage in ({"gain": [1.0, 1.0]}, {"gain": [1.0, 1.0, 0.0]}, {"corner": -0.1}, {"corner": "x"}, {"gain": None}):
        with pytest.raises((TypeError, ValueError)):
            Tone.from_dict({**whole, **damage})
    for value in (0, -1, float("inf"), float("nan"), "one"):
        with pytest.raises(ValueError):
            positive(value)


@settings(max_examples=60, deadline=None)
@given(exposure=st.floats(0.3, 4.0))
def test_what_is_brightened_keeps_its_order_and_nothing_becomes_white(exposure: float) -> None:
    light = np.linspace(0, 1, 2001)
    shown = brighter(light, exposure)
    dark = light * exposure <= SHOULDER
    np.testing.assert_allclose(shown[dark], exposure * light[dark])
    assert (np.diff(shown) > 0).all() and shown[-1] == pytest.approx(min(exposure, 1.0))
    assert (shown[:-1] < 1).all()
    slopes = np.diff(shown) / np.diff(light)
    assert slopes.max() <= exposure * (1 + 1e-6)  # no step where the shoulder begins, and contrast only becomes less
    assert (np.diff(slopes) < 1e-6).all()


def test_bytes_are_brightened_as_light_is() -> None:
    colours = np.random.default_rng(0).integers(0, 256, (5, 4, 3), dtype=np.uint8)
    assert exposed(colours, 1.0) is colours
    bright = exposed(colours, 1.7)
    assert bright.dtype == np.uint8 and bright.shape == colours.shape
    np.testing.assert_allclose(bright, 255 * encode(brighter(decode(colours / 255), 1.7)), atol=0.51)
    assert exposed(np.array([0, 255], np.uint8), 2.0).tolist() == [0, 255]
