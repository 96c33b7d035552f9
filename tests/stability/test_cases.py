"""The cases of `fieldfuse selftest --stability`, one test each, and that they would notice what they are there for."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch

from fieldfuse.evaluation.selftest import compositing, lookup, rays
from fieldfuse.evaluation.selftest.case import Case, Measure, absolute, all_cases, by_size, not_finite, refused, relative, run_case
from fieldfuse.render import march as marching
from fieldfuse.render.composite import exclusive_sum
from tests.pipelines.made import call

CASES = all_cases()
QUICK = [case for case in CASES if not case.slow]
Capsys = pytest.CaptureFixture[str]


@pytest.mark.parametrize("case", QUICK, ids=lambda case: case.title)
def test_case(case: Case) -> None:
    with np.errstate(all="ignore"):
        outcome = run_case(case)
    assert not outcome.failure
    assert outcome.measures
    missed = [f"{measure.quantity}: {measure.error:.3g} > {measure.bound:.3g}" for measure in outcome.measures if not measure.good]
    assert not missed


def test_there_are_enough_cases_of_every_kind() -> None:
    assert len(CASES) >= 30
    groups = {case.group for case in CASES}
    assert groups >= {"compositing", "rays", "lookup", "volume", "prune and split", "scale and place", "cameras", "data", "metrics"}


def test_nan_is_never_within_a_bound() -> None:
    assert not Measure("x", math.nan, math.inf).good
    assert absolute([math.nan], [1.0]) == math.inf == absolute([1.0], [math.nan]) == absolute([math.inf], [-math.inf])
    assert relative([math.nan], [1.0]) == math.inf and by_size([1.0, 2.0], [1.0]) == math.inf
    assert absolute([math.inf], [math.inf]) == 0 and not_finite([1.0, math.nan], [math.inf]) == 2
    assert relative([1.0], [0.0]) == math.inf and relative([0.0], [0.0]) == 0


def test_a_refusal_has_one_line_of_the_right_kind() -> None:
    def fail(error: Exception) -> None:
        raise error

    assert refused(lambda: fail(ValueError("a sentence that tells")), ValueError, "tells") == 0
    assert refused(lambda: fail(ValueError("two\nlines of text")), ValueError) == 1
    assert refused(lambda: fail(ValueError("a sentence")), ValueError, "other words") == 1
    assert refused(lambda: None, ValueError) == 1


def failing(case_name: str) -> list[str]:
    (case,) = [case for case in CASES if case.name == case_name]
    outcome = run_case(case)
    return [measure.quantity for measure in outcome.measures if not measure.good] + ([outcome.failure] if outcome.failure else [])


def test_weights_from_one_minus_exp_are_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    def careless(thickness: torch.Tensor, first: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        light = torch.exp(-exclusive_sum(thickness, first)).to(thickness.dtype)
        return light * (1 - torch.exp(-thickness)), light

    monkeypatch.setattr(compositing, "weights", careless)
    assert "weight, relative" in failing("thin haze over 4,096 steps")
    assert failing("thin rays behind 400 fully opaque ones in one list")


def test_lost_and_doubled_samples_are_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = marching.march

    def losing(*arguments: object, **options: object) -> marching.Samples:
        samples = plain(*arguments, **options)  # type: ignore[arg-type]
        return samples.keep(torch.arange(len(samples)) % 97 != 0)

    def doubling(*arguments: object, **options: object) -> marching.Samples:
        samples = plain(*arguments, **options)  # type: ignore[arg-type]
        return samples.keep(torch.arange(len(samples)).repeat_interleave(1 + (torch.arange(len(samples)) % 97 == 0).long()) >= 0)

    monkeypatch.setattr(rays, "march", losing)
    assert "gap or overlap between samples, in steps" in failing("random rays through full blocks: nothing lost or doubled at borders")
    monkeypatch.setattr(rays, "march", doubling)
    assert failing("random rays through full blocks: nothing lost or doubled at borders")


def test_a_wrong_corner_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = lookup.corners
    monkeypatch.setattr(lookup, "corners", lambda *given: (plain(*given)[0].roll(1, 1), plain(*given)[1]))
    assert failing("linear fields across block borders")


def test_the_command_shows_a_table_and_ends_with_one_when_a_bound_is_missed(capsys: Capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    answer = call(capsys, "selftest", "--stability", "--only", "thin haze", "--quiet")
    assert answer.code == 0 and "thin haze" in answer.out and "all good" in answer.out and "bound" in answer.out
    monkeypatch.setattr(compositing, "weights", lambda tau, first: (tau * 0, tau * 0))
    answer = call(capsys, "selftest", "--only", "thin haze", "--json")
    assert answer.code == 1
    (shown,) = json.loads(answer.out)
    assert not shown["good"] and any(not measure["good"] for measure in shown["measures"])
    answer = call(capsys, "selftest", "--only", "no such case")
    assert answer.code == 2 and "no such case" in answer.sentence()
