"""Mean and variance over views: two passes, any order, any number."""

from __future__ import annotations

import torch

from fieldfuse.nerfusion.aggregate import CUES, FLAGS, aggregate, agreement, direction_spread, evidence


def test_one_view_has_variance_exactly_zero_and_a_gradient_that_is_finite() -> None:
    values = (torch.randn(3, 5, 4) * 77).requires_grad_()
    visible = torch.zeros(3, 5, dtype=torch.bool)
    visible[1] = True
    mean, variance, count = aggregate(values, visible)
    assert torch.equal(mean, values[1]) and not variance.any() and bool((count == 1).all())
    rows = evidence(mean, variance, count, torch.ones(5), torch.zeros(5))
    rows.sum().backward()
    assert values.grad is not None and bool(torch.isfinite(values.grad).all())
    assert not values.grad[0].any() and not values.grad[2].any()


def test_seen_once_does_not_read_as_consistent() -> None:
    mean, count = torch.zeros(2, 4), torch.tensor([1, 3])
    rows = evidence(mean, torch.zeros(2, 4), count, torch.ones(2), torch.full((2,), 0.1))
    assert rows.shape == (2, 12 + FLAGS)
    once, thrice = rows[:, 8:12]
    assert not once.any() and bool((thrice < -1).all()), "the logarithm of a variance of zero is its lowest value, not its absence"
    assert rows[0, 12] == 0 and rows[1, 12] == 1


def test_agreement_is_of_a_group_and_lowest_where_views_agree() -> None:
    variance = torch.tensor([[0.0, 0.0, 1.0], [0.4, 0.2, 0.0], [0.4, 0.2, 0.0]])
    found = agreement(variance, torch.tensor([3, 2, 1]), (slice(2), slice(2, 3)))
    assert found.shape == (3, CUES)
    assert float(found[0, 0]) < -1 and float(found[1, 1]) < -1, "no variance is the lowest value"
    torch.testing.assert_close(found[1, 0], torch.log(torch.tensor(0.3 + 1e-4)) / 4 + 1)
    assert not found[2].any(), "one view neither agrees nor disagrees"


def test_spread_is_the_angle_between_views() -> None:
    angle = 0.1
    positions = torch.tensor([[torch.sin(torch.tensor(a)), 0, -torch.cos(torch.tensor(a))] for a in (-angle, angle)])
    both, one = torch.ones(2, 1, dtype=torch.bool), torch.tensor([[True], [False]])
    assert abs(float(direction_spread(torch.zeros(1, 3), positions, both)) - angle) < 1e-3
    assert float(direction_spread(torch.zeros(1, 3), positions, one)) == 0
