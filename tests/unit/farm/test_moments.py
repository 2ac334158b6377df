"""Running moments compared with numpy's mean and standard deviation of all data."""

import numpy as np
import pytest

from farm.moments import Moments, merged, normaliser_of, usable

RNG = np.random.default_rng(2)
SIZE = 4


def rollouts(count, scale=1.0):
    """Observations of rollouts of different lengths."""
    lengths = RNG.integers(1, 30, count)
    return [
        3.0 + scale * RNG.normal(size=(length, SIZE)) * [1.0, 10.0, 1e-3, 1.0] for length in lengths
    ]


def table(parts, order=None):
    """Their moments, as a batch that rollouts leave one after the other would get them."""
    moments = Moments(len(parts), SIZE)
    for t in range(max(map(len, parts))):
        rows = np.array([row for row in order or range(len(parts)) if t < len(parts[row])])
        moments.add(rows, np.array([parts[row][t] for row in rows]))
    return moments.table


def test_of_one_rollout_and_of_all():
    parts = rollouts(7)
    rows = table(parts)
    total = merged(merged(np.zeros(1 + 2 * SIZE), rows[:3]), rows[3:])
    for row, x in [*zip(rows, parts, strict=True), (total, np.concatenate(parts))]:
        assert row[0] == len(x)
        np.testing.assert_allclose(row[1 : 1 + SIZE], x.mean(axis=0), rtol=1e-12)
        np.testing.assert_allclose(row[1 + SIZE :], x.var(axis=0) * len(x), rtol=1e-9)
    mean, deviation = normaliser_of(total)
    np.testing.assert_allclose(mean, np.concatenate(parts).mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(deviation, np.concatenate(parts).std(axis=0), rtol=1e-9)


def test_a_rollouts_moments_do_not_depend_on_its_batch():
    parts = rollouts(5)
    whole = table(parts)
    alone = [table([part])[0].tobytes() for part in parts]
    assert [row.tobytes() for row in whole] == alone
    assert table(parts, [4, 1, 0, 3, 2]).tobytes() == whole.tobytes()


def test_far_from_zero_nothing_is_lost():
    x = 1e8 + RNG.normal(size=(1000, 1))
    moments = Moments(1, 1)
    for value in x:
        moments.add(np.array([0]), value[None])
    assert normaliser_of(moments.table[0])[1, 0] == pytest.approx(x.std(), rel=1e-6)


def test_of_nothing():
    zeros = np.zeros(1 + 2 * SIZE)
    assert normaliser_of(zeros).tolist() == [[0.0] * SIZE, [1.0] * SIZE]
    assert normaliser_of(np.empty(0)).shape == (2, 0)
    assert merged(zeros, np.zeros((3, 1 + 2 * SIZE))).tobytes() == zeros.tobytes()
    rows = table(rollouts(2))
    assert (
        merged(zeros, rows[:1]).tobytes()
        == merged(zeros, np.insert(rows[:1], 0, 0.0, axis=0)).tobytes()
    )
    assert merged(np.empty(0), np.empty((0, 0))).shape == (0,)


def test_a_number_that_never_changes_is_left_at_zero():
    moments = Moments(2, 2)
    for _ in range(50):
        moments.add(np.arange(2), np.array([[0.1, -7.0]] * 2))
    total = merged(np.zeros(5), moments.table)
    assert normaliser_of(total).tolist() == [[0.1, -7.0], [1.0, 1.0]]


@pytest.mark.filterwarnings("error")
def test_what_overflows_counts_for_nothing():
    moments = Moments(3, 1)
    for x in ([1.0, 1e200, 1.0], [2.0, -1e200, np.inf], [3.0, 1.0, 1.0]):
        moments.add(np.arange(3), np.array(x)[:, None])
    rows = usable(moments.table)
    assert rows.tolist() == [[3.0, 2.0, 2.0], [0.0] * 3, [0.0] * 3]
    huge = np.array([[1.0, 1e300, 0.0], [1.0, -1e300, 0.0], [1.0, 1e300, 0.0]])
    assert merged(np.zeros(3), huge).tolist() == [0.0, 0.0, 0.0]
