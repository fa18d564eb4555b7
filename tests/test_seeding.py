"""Random generators by seed, name and index."""

from __future__ import annotations

import numpy as np
import pytest

from surefoot.seeding import generator, generators


def test_the_same_seed_name_and_index_give_the_same_stream():
    assert np.array_equal(generator(3, "pushes", 5).random(10), generator(3, "pushes", 5).random(10))


@pytest.mark.parametrize("other", [(4, "pushes", 5), (3, "start", 5), (3, "pushes", 6)])
def test_another_seed_name_or_index_gives_another_stream(other):
    assert not np.array_equal(generator(3, "pushes", 5).random(10), generator(*other).random(10))


def test_a_robots_stream_does_not_depend_on_the_batch():
    few, many = generators(3, "pushes", 2), generators(3, "pushes", 50)
    assert [one.random() for one in few] == [one.random() for one in many[:2]]


def test_streams_are_not_correlated():
    first, second = generators(0, "noise", 2)
    assert abs(np.corrcoef(first.standard_normal(20_000), second.standard_normal(20_000))[0, 1]) < 0.03
