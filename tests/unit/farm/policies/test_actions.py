"""Actions of each kind of policy, compared with their formulas in plain Python and numpy."""

import math
from itertools import pairwise

import numpy as np
import pytest
from controllers import ACTIONS, FOURIER, KINDS, SINGLE, act, make, memories, parameters, states
from hypothesis import given
from hypothesis import strategies as st

from farm.errors import UnservedError
from farm.policies.networks import Linear, Mlp
from farm.policies.radial import Rbf, WeightedKernel
from farm.policies.recurrent import Cpg, Rnn


@pytest.mark.parametrize("name", FOURIER)
@pytest.mark.parametrize("bandwidth", [1.0, 0.4])
def test_actions_are_as_written(name, bandwidth):
    policy = make(name, features=20, bandwidth=bandwidth)
    direct = make("direct", features=20, bandwidth=bandwidth)

    def features(x):
        return direct.features(x[None])[0]

    assert policy.size == ACTIONS * {"direct": 20, "cosine": 20}.get(name, 8)
    theta, x = parameters(policy, 3), states(3)
    actions = act(policy, theta, x)
    assert actions.shape == (3, ACTIONS)
    for i in range(3):
        z = features(x[i])
        for joint, joint_theta in enumerate(theta[i].reshape(ACTIONS, -1)):
            parts = {"projected": features, "cosine": np.cos}.get(name, np.asarray)(joint_theta)
            if name == "kernel":
                expected = math.exp(-(math.dist(joint_theta, x[i]) ** 2) / (2 * bandwidth**2))
            else:
                expected = sum(a * b for a, b in zip(parts, z, strict=True))
            assert actions[i, joint] == pytest.approx(expected, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("name", SINGLE)
def test_single_precision_changes_actions_by_rounding_alone(name):
    single, double = make(name, features=8000), make(name.partition(",")[0], features=8000)
    theta, x = parameters(single, 20), states(20)
    actions, expected = act(single, theta, x), act(double, theta, x)
    assert actions.dtype == np.float64
    assert 0.0 < np.abs(actions - expected).max() < 2e-6


def test_single_precision_overflows_like_double():
    policy = make("direct, single")
    theta, x = parameters(policy, 3), states(3)
    theta[1], x[2, 0] = 1e300, 1e300
    actions = act(policy, theta, x)
    assert np.isfinite(actions).all(axis=1).tolist() == [True, False, False]


def plain(policy, theta, x):
    """One rollout's actions (A,), by numpy's own products and functions."""
    config, a, d = policy.config, ACTIONS, len(x)
    if isinstance(policy, Rnn):
        (memory,) = memories(policy, x[None])
        hidden, output = np.split(theta, [config.units * (d + config.units + 1)])
        h = np.tanh(hidden.reshape(config.units, -1) @ np.concatenate([x, memory[0], [1.0]]))
        return output.reshape(a, -1) @ np.append(h, 1.0)
    if isinstance(policy, Cpg):
        (turns,), (_, amplitude, shift, offset) = memories(policy, x[None]), theta.reshape(a, 4).T
        return offset + amplitude * np.sin(2.0 * np.pi * turns[0] + shift)
    if isinstance(policy, Mlp):
        for inputs, units in pairwise((d, *config.layers, a)):
            rows = theta[: units * (inputs + 1)].reshape(units, -1)
            theta = theta[units * (inputs + 1) :]
            out = rows @ np.append(x, 1.0)
            x = np.tanh(out)
        return out
    if isinstance(policy, Linear):
        return theta.reshape(a, -1) @ (np.append(x, 1.0) if config.bias else x)
    if isinstance(policy, Rbf):
        k = config.centres
        distance = np.linalg.norm(theta[: k * d].reshape(k, d) - x, axis=1)
        return theta[k * d :].reshape(a, k) @ np.exp(-(distance**2) / (2 * config.bandwidth**2))
    rows, y = theta.reshape(a, -1), (x - policy.constants["origin"]) / policy.constants["spread"]
    distance = np.linalg.norm(rows[:, :-1] - y, axis=1)
    return config.weight_scale * rows[:, -1] * np.exp(-(distance**2) / (2 * d * config.width**2))


@pytest.mark.parametrize("name", [name for name in KINDS if name not in FOURIER | SINGLE])
@pytest.mark.parametrize("size", [1, 8, 62])
def test_actions_are_those_of_plain_numpy(name, size):
    policy = make(name, features=7, size=size, bandwidth=1.3)
    sizes = {
        "mlp": 7 * (size + 1) + 5 * 8 + 3 * 6,
        "rbf": 7 * (size + 3),
        "linear, no bias": 3 * size,
    }
    sizes |= {"rnn": 7 * (size + 7 + 1) + 3 * 8, "cpg": 12}
    assert policy.size == sizes.get(name, 3 * (size + 1))
    theta, x = parameters(policy, 5), states(5, size)
    expected = [plain(policy, *row) for row in zip(theta, x, strict=True)]
    np.testing.assert_allclose(act(policy, theta, x), expected, rtol=1e-11, atol=1e-13)


def test_the_hidden_layer_of_an_rnn_is_its_next_memory():
    policy, x = make("rnn", features=4), states(3)
    theta = parameters(policy, 3)
    [memory] = memories(policy, x)
    _, after = policy.act(policy.prepare(theta), x, memory)
    rows = theta[:, : 4 * 13].reshape(3, 4, 13)  # 8 observations, 4 memories, a bias
    for row, observation, state, layer in zip(rows, x, memory, after, strict=True):
        np.testing.assert_allclose(
            layer, np.tanh(row @ np.concatenate([observation, state, [1.0]])), rtol=1e-12
        )
    assert policy.memory.tolist() == [0.0] * 4


def test_oscillators_are_sines_of_the_time_with_the_written_numbers():
    policy = make("cpg")
    frequency = [0.7, 3.0, -1.3]
    amplitude = [1.0, -0.5, 2.0]
    shift = [0.0, 0.4, 9.0]
    offset = [0.1, 0.2, -0.3]
    prepared = policy.prepare(np.array([frequency, amplitude, shift, offset]).T.reshape(1, -1))
    memory = policy.memory[None]
    for step in range(500):
        action, memory = policy.act(prepared, states(1), memory)
        angle = 2.0 * np.pi * np.array(frequency) * step * policy.spec.period + shift
        np.testing.assert_allclose(action[0], offset + amplitude * np.sin(angle), atol=1e-11)
        assert ((memory >= 0.0) & (memory < 1.0)).all()


def test_a_weighted_kernel_begins_at_rest_and_may_act_with_either_sign():
    policy, x = make("weighted-kernel"), states(4)
    theta = parameters(policy, 4).reshape(4, ACTIONS, -1)
    theta[:, :, -1] = [0.0, 2.0, -2.0]
    actions = act(policy, theta.reshape(4, -1), x)
    assert (actions[:, 0] == 0.0).all()
    assert (actions[:, 1] > 0.0).all()
    assert (actions[:, 2] < 0.0).all()


def test_a_weighted_kernel_needs_its_task_s_origin_and_spread():
    policy = make("weighted-kernel")
    for constants in ({}, {"origin": np.zeros(8)}, {"origin": np.zeros(8), "spread": np.ones(9)}):
        with pytest.raises(UnservedError, match="constant '(origin|spread)' of the policy is"):
            WeightedKernel(policy.config, policy.spec, constants)


def test_projected_tends_to_kernel():
    kernel = make("kernel")
    theta, x = parameters(kernel, 4), states(4)
    exact = act(kernel, theta, x)
    errors = [
        np.sqrt(np.mean((act(make(features=count), theta, x) - exact) ** 2))
        for count in (50, 800, 12800)
    ]
    assert errors[0] > 2 * errors[1] > 4 * errors[2]
    assert errors[2] < 0.02


@given(
    seed=st.integers(0, 1000),
    features=st.integers(1, 40),
    scale=st.sampled_from([0.1, 1.0, 100.0, 1e12]),
)
def test_projected_actions_are_bounded_by_two(seed, features, scale):
    policy = make(features=features, seed=seed)
    actions = act(policy, parameters(policy, 4, seed, scale), states(4, seed=seed))
    assert (np.abs(actions) <= 2.0 + 1e-12).all()


@given(seed=st.integers(0, 1000), scale=st.sampled_from([0.1, 1.0, 1e3, 1e200]))
def test_kernel_actions_lie_between_zero_and_one(seed, scale):
    policy = make("kernel")
    actions = act(policy, parameters(policy, 4, seed, scale), states(4, seed=seed))
    assert ((actions >= 0) & (actions <= 1)).all()


def test_the_kernel_is_one_at_its_centre():
    policy, x = make("kernel", bandwidth=0.1), states(2)
    np.testing.assert_array_equal(act(policy, np.tile(x, ACTIONS), x), 1.0)


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("scale", [1e155, 1e300, 1e308])
def test_huge_parameters_and_observations_warn_of_nothing(name, scale):
    policy = make(name)
    theta = np.clip(np.random.default_rng(0).normal(size=(2, policy.size)), -1, 1) * scale
    for x in (states(2), states(2) * scale):
        assert act(policy, theta, x).shape == (2, ACTIONS)
