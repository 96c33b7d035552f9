"""Which pictures are matched with which."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from fieldfuse.poses.pairs import coarse, common, loop_pairs, sequential_pairs, similar_pairs


def walk(count: int, seed: int = 0) -> list[np.ndarray]:
    """Sketches of a ring of places: each frame sees 60 descriptors, of which it shares 50 with the next."""
    random = np.random.default_rng(seed)
    places = random.standard_normal((10 * count, 128)).astype(np.float32)
    out = []
    for n in range(count):
        seen = places[np.arange(10 * n, 10 * n + 60) % len(places)]
        seen = seen + 0.05 * random.standard_normal(seen.shape).astype(np.float32)
        out.append(seen / np.linalg.norm(seen, axis=1, keepdims=True))
    return out


@given(st.integers(0, 60))
def test_pairs_are_ordered_unique_and_within_range(count):
    pairs = sequential_pairs(count)
    assert len(set(pairs)) == len(pairs) and all(0 <= i < j < count for i, j in pairs)
    assert {(i, i + 1) for i in range(count - 1)} <= set(pairs)


def test_sequential_pairs_reach_far_with_few():
    pairs = sequential_pairs(200)
    assert max(j - i for i, j in pairs) == 160
    assert len(pairs) < 200 * 10
    assert {(i, i + 2) for i in range(198)} <= set(pairs), "a frame too blurred to match does not part the way"
    assert {(i, i + step) for i in range(20) for step in range(1, 11)} <= set(sequential_pairs(30)), "of few frames each match counts"


def test_common_counts_shared_descriptors_and_nothing_else():
    sketches = walk(30)
    assert common(sketches[0], sketches[1]) >= 45
    assert common(sketches[0], sketches[15]) == 0
    assert common(sketches[0], np.zeros((0, 128), np.float32)) == 0
    assert common(sketches[0], sketches[0][:1]) == 0


def test_coarse_takes_the_largest_scales_at_unit_length():
    descriptors = np.eye(128, dtype=np.uint8)[:50] * 9
    scales = np.arange(50.0)
    kept = coarse(descriptors, scales, most=5)
    assert kept.shape == (5, 128) and set(kept.argmax(axis=1)) == {45, 46, 47, 48, 49}
    np.testing.assert_allclose(np.linalg.norm(kept, axis=1), 1.0)


def test_a_ring_is_closed_by_a_loop_pair():
    sketches = walk(60)
    pairs = loop_pairs(sketches, stride=1)
    assert (0, 59) in pairs  # the first and the last frame see the same place
    assert all(j - i > 20 for i, j in pairs)
    assert all(min(j - i, 60 - (j - i)) <= 5 for i, j in pairs)  # no pair without shared places


def test_shuffled_photos_find_their_neighbours():
    order = np.random.default_rng(1).permutation(40)
    sketches = walk(40)
    pairs = set(similar_pairs([sketches[k] for k in order], each=6))
    where = {int(k): n for n, k in enumerate(order)}
    for k in range(39):
        assert tuple(sorted((where[k], where[k + 1]))) in pairs
    assert len(pairs) < 40 * 9
