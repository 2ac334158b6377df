"""Actions depend on their own row alone: not on its batch, on the order in memory, or on what was
asked before.
"""

import numpy as np
import pytest
from controllers import KINDS, act, acted, make, parameters, states
from covering import any_two

from farm.policies.fourier import Direct


@pytest.mark.parametrize(*any_two(name=KINDS, size=(1, 8, 62), features=(1, 7, 50, 300)))
def test_a_row_does_not_depend_on_its_batch(name, size, features):
    policy = make(name, features, size)
    theta, x = parameters(policy, 32), states(32, size)
    alone = [
        acted(policy, policy.prepare(theta[i : i + 1]), x[i : i + 1])[0].tobytes()
        for i in range(32)
    ]

    def check(rows, some_theta, some_x):
        prepared = policy.prepare(some_theta)
        for actions in (
            acted(policy, prepared, some_x),
            acted(policy, np.asfortranarray(prepared), some_x),
        ):
            assert [row.tobytes() for row in actions] == [alone[i] for i in rows]

    check(range(7), theta[:7], x[:7])
    order = np.random.default_rng(0).permutation(32)
    check(order, theta[order], x[order])
    check(range(31, -1, -1), theta[::-1], x[::-1])
    check(range(0, 32, 3), theta[::3], x[::3])
    check(range(32), np.asfortranarray(theta), np.asfortranarray(x))
    wide_theta, wide_x = np.zeros((32, 2 * policy.size)), np.zeros((32, 3 * size))
    wide_theta[:, ::2], wide_x[:, 1::3] = theta, x
    check(range(32), wide_theta[:, ::2], wide_x[:, 1::3])


def test_constants_in_another_memory_order_are_the_same():
    policy = make("direct")
    other = {
        "frequencies": np.asfortranarray(policy.constants["frequencies"]),
        "phases": np.repeat(policy.constants["phases"], 2)[::2],
    }
    two = Direct(policy.config, policy.spec, other)
    theta, x = parameters(policy, 3), states(3)
    assert act(policy, theta, x).tobytes() == act(two, theta, x).tobytes()


@pytest.mark.parametrize("name", KINDS)
def test_inputs_are_left_alone(name):
    policy = make(name)
    theta, x = parameters(policy, 3), states(3)
    prepared = policy.prepare(theta).copy()
    for values in (theta, x, prepared, *policy.constants.values()):
        values.setflags(write=False)
    assert acted(policy, policy.prepare(theta), x).tobytes() == acted(policy, prepared, x).tobytes()
