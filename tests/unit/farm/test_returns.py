"""Failed rollouts: they rank last, set no scale, and are part of no mean."""

import numpy as np
import pytest

from farm.returns import RETURN_FLOOR, known, mean, penalised


def test_a_failed_rollout_is_a_deviation_below_the_worst():
    returns = np.array([[-5.0, -7.0], [RETURN_FLOOR, -6.0]])
    expected = -7.0 - np.std([-5.0, -7.0, -6.0])
    np.testing.assert_array_equal(penalised(returns), [[-5.0, -7.0], [expected, -6.0]])
    assert returns[1, 0] == RETURN_FLOOR, "the argument is left as it is"


@pytest.mark.parametrize("value", [-300.0, 0.0, 2e-9, 0.1, 1.1, 5e5])
@pytest.mark.parametrize("count", [1, 3, 7, 31])
def test_among_equal_returns_it_is_clearly_the_worst(value, count):
    values = penalised(np.array([RETURN_FLOOR, *[value] * count]))
    assert values[1:].tolist() == [value] * count
    assert values[0] == value - max(abs(value), 1.0)


def test_without_any_failure_or_any_return_nothing_changes():
    for returns in (np.array([3.0, -1e11, 4.5]), np.full((2, 2), RETURN_FLOOR)):
        assert penalised(returns).tobytes() == returns.tobytes()


def test_means_are_over_the_returns_that_there_are():
    returns = np.array([1.0, RETURN_FLOOR, 3.0])
    assert known(returns).tolist() == [True, False, True]
    assert mean(returns) == 2.0
    assert mean(returns[1:2]) is None
