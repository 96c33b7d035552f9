"""What a user states about lengths: grammar, and sentences on what is wrong."""

from __future__ import annotations

import pytest

from fieldfuse.config import load_settings
from fieldfuse.errors import InputError
from fieldfuse.measures import Mark, Marker, Measurement, length, parse_marker, parse_scale, stored_per_metre


@pytest.mark.parametrize(
    ("text", "metres"),
    [("1.2", 1.2), ("120cm", 1.2), (" 0.25 mm ", 0.00025), ("1/5000 m", 0.0002), (3, 3.0), ("1e-3", 0.001), ("2ft", 0.6096)],
)
def test_lengths(text: str | float, metres: float) -> None:
    assert length(text) == pytest.approx(metres)


@pytest.mark.parametrize("text", ["", "m", "-1", "0", "nan", "inf", "1e9", "1/0", "1 yard", "1,2", "9" * 400])
def test_what_is_no_length(text: str) -> None:
    with pytest.raises(InputError, match="no length"):
        length(text)


@pytest.mark.parametrize(
    ("text", "stored"), [("1000", 1000.0), (5000, 5000.0), ("0.25mm", 4000.0), ("1/5000m", 5000.0), (6553.5, 6553.5), ("1mm", 1000.0)]
)
def test_units_of_depth(text: str | float, stored: float) -> None:
    assert stored_per_metre(text) == pytest.approx(stored)


@pytest.mark.parametrize("text", ["0", "-5", "nan", "1e30", "deep"])
def test_what_is_no_unit_of_depth(text: str) -> None:
    with pytest.raises(InputError):
        stored_per_metre(text)


def test_measurements() -> None:
    one = Measurement((Mark("IMG_1", 812, 330),), (Mark("IMG_2", 1204.5, 341),), 1.2)
    assert parse_scale("IMG_1:812,330 IMG_2:1204.5,341 = 1.20") == [one]
    assert parse_scale("a.jpg:1,2 a.jpg:3,4=80cm") == [Measurement((Mark("a.jpg", 1, 2),), (Mark("a.jpg", 3, 4),), 0.8)]
    two = parse_scale("my photo 1.jpg:1,2 b:3,4 to my photo 1.jpg:5,6 c:7,8 = 2; a:0,0 b:1,1 = 3")
    assert two[0].first == (Mark("my photo 1.jpg", 1, 2), Mark("b", 3, 4))
    assert two[0].second == (Mark("my photo 1.jpg", 5, 6), Mark("c", 7, 8))
    assert two[1].metres == 3


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "no measurement"),
        ("a:1,2 b:3,4", "no length after"),
        ("a:1,2 = 1", "has 1 marks"),
        ("a:1,2 b:3,4 c:5,6 = 1", "has 3 marks"),
        ("a:1,2 to b:3,4 to c:5,6 = 1", "has 3 points"),
        ("a:1,2 b:3 = 1", "cannot be read at 'b:3'"),
        ("a:1,2 to = 1", "cannot be read"),
        ("a:1,2 a:1,2 = 1", "the same place twice"),
        ("a:1,2 a:3,4 to b:1,1 = 1", "one point twice in a"),
        ("a:1e9,2 b:3,4 = 1", "lies in no image"),
        ("a:1,2 b:3,4 = much", "no length"),
        ("a:1,2 " * 30_000 + "= 1", "characters"),
    ],
)
def test_what_is_no_measurement(text: str, why: str) -> None:
    with pytest.raises(InputError, match=why):
        parse_scale(text)


def test_markers() -> None:
    assert parse_marker("DICT_4X4_50:0.05") == Marker("DICT_4X4_50", 0.05)
    assert parse_marker("apriltag_36h11:8cm") == Marker("DICT_APRILTAG_36h11", 0.08)
    assert parse_marker("charuco:DICT_5X5_100:7x5:0.04:30mm") == Marker("DICT_5X5_100", 0.03, (7, 5), 0.04)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("DICT_4X4_50", "not understood"),
        ("DICT_4X4_51:0.05", r"no dictionary 'DICT_4X4_51' \(did you mean DICT_4X4_50"),
        ("DICT_4X4_50:0", "no length"),
        ("charuco:DICT_5X5_100:7:0.04:0.03", "no board"),
        ("charuco:DICT_5X5_100:7x5:0.03:0.04", "no board"),
        ("charuco:DICT_5X5_100:999x5:0.04:0.03", "no board"),
    ],
)
def test_what_is_no_marker(text: str, why: str) -> None:
    with pytest.raises(InputError, match=why):
        parse_marker(text)


def test_settings_refuse_what_cannot_be_read() -> None:
    good = load_settings(pairs=["depth_scale=5000", "scale=a:1,2 b:3,4 = 1.2"])
    assert good.capture.depth_scale == 5000 and good.poses.scale == "a:1,2 b:3,4 = 1.2"
    for flags in ({"scale": "a"}, {"marker": "a"}, {"depth_scale": "x"}):
        with pytest.raises(InputError, match=f"[.]{next(iter(flags))}: "):
            load_settings(flags=flags)
    with pytest.raises(InputError, match="give one of them"):
        load_settings(flags={"scale": "a:1,2 b:3,4 = 1", "marker": "DICT_4X4_50:0.05"})
