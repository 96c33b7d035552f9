"""A run that failed says so, with the likeliest cause and what to try; one that went well says nothing."""

from __future__ import annotations

from typing import Any

import pytest

from fieldfuse.evaluation.failure import failures


def report(held: float = 24.0, floor: float = 15.0, training: float | None = 27.0, **parts: Any) -> dict[str, Any]:
    field = {"psnr": held, "psnr_corrected": held, "training_psnr": training, **parts.pop("scores", {})}
    nearest = {"psnr": floor, "psnr_uncorrected": None, **parts.pop("nearest", {})}
    on = [{"effect": name, "on": True} for name in ("view_dependence", "background", *parts.pop("on", []))]
    return {
        "evaluation": {"field": field, "nearest_image": nearest},
        "poses": {"source": "sfm", "registered": 50, "total": 50},
        "views": {"total": 50, "test": 7},
        "effects": {"effects": on},
        "field": {"matched": {"share": 0.4}},
        "timeline": [{"seconds": 1.0, "psnr": held - 3}, {"seconds": 5.0, "psnr": held}, {"seconds": 10.0, "psnr": held}],
        **parts,
    }


GIVEN = {"poses": {"source": "given", "registered": 20, "total": 20}}


def test_good_runs_say_nothing() -> None:
    assert failures(report()) == []
    assert failures(report(30.0, 17.0, 33.0, **GIVEN)) == []
    assert failures(report(24.1, 18.3, 33.8)) == []  # few pixels are learned by heart, and the scene is shown nevertheless
    assert failures(report(30.3, 27.5, 37.0)) == []  # looks right
    assert failures(report(training=None)) == []


def test_what_is_not_known_is_no_failure() -> None:
    assert failures({}) == failures({"evaluation": None}) == []
    assert failures({"evaluation": {"field": None, "nearest_image": {"psnr": 9.0}}}) == []
    assert failures({"evaluation": {"field": {"psnr": 9.0}, "nearest_image": None}}) == []
    (text,) = failures({"evaluation": {"field": {"psnr": 9.0}, "nearest_image": {"psnr": 9.0}}})
    assert "failed" in text and "likely" in text


@pytest.mark.parametrize(
    ("found", "words"),
    [
        (report(12.3, 14.6, 18.3, **GIVEN), "--poses sfm"),
        (report(13.3, 14.6, 27.0, **GIVEN), "27.0 at training views"),
        (report(13.3, 14.6, 14.0, **GIVEN, field={"matched": {"share": 0.03}}), "--poses sfm"),
        (report(10.3, 13.5, 27.6, **GIVEN, on=["exposure"], nearest={"psnr_uncorrected": 15.1}), "--set effects=off"),
        (report(12.0, 13.0, 14.0, scores={"psnr_corrected": 17.0}), "lock both"),
        (report(12.0, 13.0, 30.0, views={"total": 4, "test": 1}), "too few training images (3)"),
        (report(12.0, 13.0, 14.0, poses={"source": "sfm", "registered": 9, "total": 20}), "only 9 of 20 frames"),
        (report(12.0, 13.0, 14.0, on=["vignetting"]), "a correction does harm (vignetting)"),
        (report(12.0, 13.0, 14.0, field={"left_out": {"share": 0.2}}), "20% of the training pixels"),
        (report(12.0, 13.0, 14.0, timeline=[{"seconds": 2.0, "psnr": 10.0}, {"seconds": 3.0, "psnr": 12.0}]), "--budget"),
        (report(12.0, 13.0, 14.0, field={"matched": {"share": 0.02}}), "little in common"),
        (report(31.0, 31.5, 33.0), "hardly moved"),
        (report(12.0, 13.0, 14.0), "report.html"),
    ],
)
def test_the_likeliest_cause_comes_first(found: dict[str, Any], words: str) -> None:
    (text,) = failures(found)
    assert text.startswith("this field failed") and "nearest training image" in text and words in text.partition("; or")[0], text
    assert text.count("run again with --poses sfm") < 2 and text.count("effects=off") < 2


def test_a_field_that_shows_its_training_images_alone_is_poor() -> None:
    (text,) = failures(report(16.4, 12.8, 27.3, **GIVEN))
    assert text.startswith("this field is poor") and "16.4 dB at held-out views, 12.8 by the nearest training image, 27.3 at" in text


def view(name: str, psnr: float, seen: float | None = 1.0) -> dict[str, Any]:
    return {"name": name, "psnr": psnr, "seen": seen}


def test_copies_of_held_out_images_are_named() -> None:
    each = [{"name": f"{i}.jpg", "nearest": f"{i}.png", "psnr": 100.0 if i else 20.0} for i in range(6)]
    (text,) = failures(report(34.0, 80.0, 35.0, nearest={"per_view": each}))
    assert text.startswith("5 of 6 held-out images equal a training image (1.jpg and 1.png; 2.jpg and 2.png; 3.jpg and 3.png; …)")
    assert failures(report(nearest={"per_view": [{**each[0], "psnr": 31.0}, {**each[1], "psnr": None}]})) == []


def test_views_where_nobody_filmed_are_named() -> None:
    good = [view(f"{i}", 25.0) for i in range(5)]
    (text,) = failures(report(scores={"per_view": [*good, view("6.jpg", 13.0, 0.4)]}))
    assert "6.jpg: 13.0 dB, 60% seen by fewer than two" in text and "1 of 6" in text
    for harmless in (view("6", 13.0, 0.9), view("6", 24.0, 0.4), view("6", 13.0, None)):
        assert failures(report(scores={"per_view": [*good, harmless]})) == []
    (text,) = failures(report(scores={"per_view": [view("1", 20.0, 0.3), view("2", 20.0, 0.5)]}))
    assert text.startswith("60% of what held-out views show")


def test_depth_that_does_not_fit_is_told() -> None:
    deep = {"capture": {"depth": 30}, "settings": {"fit": {"depth_from": "auto"}}, "scores": {"depth": {"median_rel": 0.14}}}
    (text,) = failures(report(**deep))
    assert "14% off the capture's depth" in text and "--set fit.depth_from=off" in text
    assert failures(report(**{**deep, "scores": {"depth": {"median_rel": 0.03}}})) == []
    assert failures(report(**{**deep, "settings": {"fit": {"depth_from": "off"}}})) == []
    assert failures(report(**{**deep, "capture": {"depth": 0}})) == []
