"""Random features and controllers against their formulas; and rows that do not know of their batch."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from farm.errors import ConfigError
from farm.policies.fourier import CONTROLLERS, Features, Policy, PolicyConfig
from farm.tasks.finger_gait.hand import LOWER, UPPER

SIZES = (8, 17, 54, 62)


def make(controller="projected", features=50, state_size=8, seed=0, **options):
    config = PolicyConfig(controller=controller, features=features, **options)
    return Policy(config, state_size, Features.draw(config, state_size, np.random.default_rng(seed)))


def states(count, size=8, seed=3):
    return np.random.default_rng(seed).uniform(0.0, 1.2, (count, size))


def parameters(policy, count, seed=4, scale=1.0):
    return np.random.default_rng(seed).normal(0.5, scale, (count, policy.size))


def act(policy, theta, x):
    return policy.actions(policy.weights(theta), x)


# ---------------------------------------------------------------- features


def kernel_error(features, size, bandwidth, seed):
    policy = make(features=features, state_size=size, bandwidth=bandwidth, seed=seed)
    x, y = states(12, size, 1) * bandwidth, states(12, size, 2) * bandwidth
    errors = []
    for a, b in zip(x, y, strict=True):
        exact = math.exp(-(math.dist(a, b) ** 2) / (2 * bandwidth**2))
        errors.append(float(policy.features(a) @ policy.features(b)) - exact)
    return np.sqrt(np.mean(np.square(errors)))


@pytest.mark.parametrize(("size", "bandwidth"), [(8, 1.0), (8, 0.3), (17, 2.0)])
def test_features_approximate_the_gaussian_kernel_better_with_more_of_them(size, bandwidth):
    coarse, middle, fine = (
        np.mean([kernel_error(count, size, bandwidth, seed) for seed in range(4)]) for count in (50, 800, 12800)
    )
    assert fine < 0.02
    assert 2 < coarse / middle < 8  # as 1 / sqrt(D): 4
    assert 2 < middle / fine < 8


def test_features_are_as_written():
    config = PolicyConfig(features=3, bandwidth=0.5)
    frequencies, phases = np.array([[1.0, -2.0], [0.5, 0.25], [0.0, 3.0]]), np.array([0.1, 2.0, 6.0])
    policy = Policy(config, 2, Features(frequencies=frequencies, phases=phases))
    x = [0.3, -0.7]
    expected = [
        math.sqrt(2 / 3) * math.cos(sum(w * v for w, v in zip(row, x, strict=True)) / 0.5 + c)
        for row, c in zip(frequencies.tolist(), phases.tolist(), strict=True)
    ]
    np.testing.assert_allclose(policy.features(np.array(x)), expected, rtol=1e-12)


def test_features_are_drawn_from_their_distributions():
    drawn = Features.draw(PolicyConfig(features=20_000), 8, np.random.default_rng(0))
    assert drawn.frequencies.shape == (20_000, 8)
    assert drawn.phases.shape == (20_000,)
    np.testing.assert_allclose(drawn.frequencies.mean(axis=0), 0.0, atol=0.04)
    np.testing.assert_allclose(drawn.frequencies.std(axis=0), 1.0, atol=0.03)
    assert 0 <= drawn.phases.min() < 0.01 < 2 * np.pi - 0.01 < drawn.phases.max() <= 2 * np.pi
    assert drawn.phases.mean() == pytest.approx(np.pi, abs=0.05)


def test_the_kernel_controller_draws_no_features():
    drawn = Features.draw(PolicyConfig(controller="kernel"), 8, np.random.default_rng(0))
    assert drawn.frequencies.shape == (0, 8)
    assert drawn.phases.shape == (0,)


def test_the_same_seed_draws_the_same_features():
    one, two = (Features.draw(PolicyConfig(features=5), 8, np.random.default_rng(9)) for _ in range(2))
    np.testing.assert_array_equal(one.frequencies, two.frequencies)
    np.testing.assert_array_equal(one.phases, two.phases)


# ---------------------------------------------------------------- controllers


@pytest.mark.parametrize("controller", CONTROLLERS)
@pytest.mark.parametrize("bandwidth", [1.0, 0.4])
def test_actions_are_as_written(controller, bandwidth):
    policy = make(controller, features=20, bandwidth=bandwidth)
    theta, x = parameters(policy, 3), states(3)
    actions = act(policy, theta, x)
    assert actions.shape == (3, 8)
    for i in range(3):
        z = policy.features(x[i])
        for joint, own in enumerate(theta[i].reshape(8, -1)):
            parts = {"projected": policy.features, "cosine": np.cos}.get(controller, np.asarray)(own)
            if controller == "kernel":
                expected = math.exp(-(math.dist(own, x[i]) ** 2) / (2 * bandwidth**2))
            else:
                expected = sum(a * b for a, b in zip(parts, z, strict=True))
            assert actions[i, joint] == pytest.approx(expected, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("size", SIZES)
def test_parameter_counts(size):
    assert make("direct", 100, size).size == 8 * 100
    assert make("cosine", 100, size).size == 8 * 100
    assert make("projected", 100, size).size == 8 * size
    assert make("kernel", 100, size).size == 8 * size
    assert make("kernel", 100, size).joint_parameters == size


def test_projected_tends_to_kernel():
    kernel = make("kernel")
    theta, x = parameters(kernel, 4), states(4)
    exact = act(kernel, theta, x)
    errors = [
        np.sqrt(np.mean((act(make(features=count, seed=seed), theta, x) - exact) ** 2))
        for count in (50, 800, 12800)
        for seed in (0,)
    ]
    assert errors[0] > 2 * errors[1] > 4 * errors[2]
    assert errors[2] < 0.02


@given(seed=st.integers(0, 1000), features=st.integers(1, 40), scale=st.sampled_from([0.1, 1.0, 100.0, 1e12]))
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
    np.testing.assert_array_equal(act(policy, np.tile(x, 8), x), 1.0)


# ---------------------------------------------------------------- rows do not know of each other


@pytest.mark.parametrize("features", [1, 7, 50, 1000])
@pytest.mark.parametrize("state_size", [8, 62])
@pytest.mark.parametrize("controller", CONTROLLERS)
def test_a_row_is_the_same_whoever_shares_its_batch(controller, state_size, features):
    policy = make(controller, features, state_size)
    theta, x = parameters(policy, 32), states(32, state_size)
    alone = [act(policy, theta[i : i + 1], x[i : i + 1])[0].tobytes() for i in range(32)]

    def check(rows, some_theta, some_x):
        weights = policy.weights(some_theta)
        for actions in (policy.actions(weights, some_x), policy.actions(np.asfortranarray(weights), some_x)):
            assert [row.tobytes() for row in actions] == [alone[i] for i in rows]

    check(range(32), theta, x)
    check(range(7), theta[:7], x[:7])
    order = np.random.default_rng(0).permutation(32)
    check(order, theta[order], x[order])
    check(range(31, -1, -1), theta[::-1], x[::-1])
    check(range(0, 32, 3), theta[::3], x[::3])
    check(range(32), np.asfortranarray(theta), np.asfortranarray(x))
    wide_theta, wide_x = np.zeros((32, 2 * policy.size)), np.zeros((32, 3 * state_size))
    wide_theta[:, ::2], wide_x[:, 1::3] = theta, x
    check(range(32), wide_theta[:, ::2], wide_x[:, 1::3])


def test_features_in_another_memory_order_are_the_same():
    config = PolicyConfig(controller="direct", features=50)
    drawn = Features.draw(config, 8, np.random.default_rng(0))
    other = Features(np.asfortranarray(drawn.frequencies), np.repeat(drawn.phases, 2)[::2])
    policies = Policy(config, 8, drawn), Policy(config, 8, other)
    one, two = (act(policy, parameters(policy, 3), states(3)) for policy in policies)
    assert one.tobytes() == two.tobytes()


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_inputs_are_left_alone(controller):
    policy = make(controller)
    theta, x = parameters(policy, 3), states(3)
    weights = policy.weights(theta).copy()
    for values in (theta, x, weights):
        values.setflags(write=False)
    policy.actions(policy.weights(theta), x)
    policy.targets(policy.actions(weights, x), x[0], x)


# ---------------------------------------------------------------- what an action means


START = np.linspace(0.2, 0.9, 8)
LAST = np.stack([np.full(8, 0.5), np.full(8, 0.8)])
ACTIONS = np.stack([np.full(8, 0.1), np.linspace(-0.2, 0.3, 8)])


@pytest.mark.parametrize(
    ("action", "expected"),
    [("offset", START + ACTIONS), ("absolute", np.maximum(ACTIONS, LOWER)), ("increment", LAST + ACTIONS)],
)
def test_what_an_action_means(action, expected):
    np.testing.assert_array_equal(make(action=action).targets(ACTIONS, START, LAST), expected)


@pytest.mark.parametrize("action", ["offset", "absolute", "increment"])
def test_targets_are_clipped_to_the_joint_ranges(action):
    actions = np.array([[-9.0] * 8, [9.0] * 8])
    np.testing.assert_array_equal(make(action=action).targets(actions, START, LAST), [LOWER, UPPER])
    free = make(action=action, clip=False).targets(actions, START, LAST)
    base = {"offset": START, "absolute": np.zeros(8), "increment": LAST}[action]
    np.testing.assert_array_equal(free, base + actions)


def test_a_target_within_its_range_is_not_touched_by_clipping():
    inside = (LOWER + UPPER) / 2
    for clip in (True, False):
        targets = make(action="absolute", clip=clip).targets(inside[None], START, LAST[:1])
        np.testing.assert_array_equal(targets, inside[None])


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e300, -1e300, 1e7])
@pytest.mark.parametrize("clip", [True, False])
@pytest.mark.parametrize("action", ["offset", "absolute", "increment"])
def test_any_action_makes_a_finite_target(action, clip, bad):
    policy = make(action=action, clip=clip)
    last = LAST
    for _ in range(3):
        last = policy.targets(np.full((2, 8), bad), START, last)
        assert np.isfinite(last).all()
        assert (np.abs(last) <= 1e6).all()
        if clip:
            assert (last >= LOWER).all()
            assert (last <= UPPER).all()


@pytest.mark.parametrize("controller", CONTROLLERS)
@pytest.mark.parametrize("scale", [1e155, 1e300, 1e308])
def test_huge_parameters_warn_of_nothing(controller, scale):
    policy = make(controller)
    rng = np.random.default_rng(0)
    theta = np.clip(rng.normal(size=(2, policy.size)), -1, 1) * scale
    actions = act(policy, theta, states(2))
    assert actions.shape == (2, 8)
    assert np.isfinite(policy.targets(actions, START, LAST)).all()


# ---------------------------------------------------------------- configuration


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"controller": "magic"}, "'magic'; known are direct, projected, kernel, cosine"),
        ({"action": "jump"}, "'jump'; known are offset, absolute, increment"),
        ({"features": 0}, "features is 0; expected 1 to 10000000"),
        ({"features": 10_000_001}, "features is 10000001"),
        ({"bandwidth": 0.0}, "bandwidth is 0.0; expected a positive"),
        ({"bandwidth": math.inf}, "bandwidth is inf"),
        ({"bandwidth": math.nan}, "bandwidth is nan"),
        ({"bandwidth": -1.0}, "bandwidth is -1.0"),
    ],
)
def test_a_wrong_setting_is_named(options, message):
    with pytest.raises(ConfigError, match=message):
        PolicyConfig(**options)


@pytest.mark.parametrize("features", [1, 10_000_000])
def test_settings_at_the_edge_are_taken(features):
    assert PolicyConfig(features=features).features == features


def test_actions_are_rescaled_to_the_limits_and_clipped():
    low, high = np.array([-2.0, 0.0, 5.0]), np.array([2.0, 1.0, 6.0])
    config = PolicyConfig(controller="kernel")
    policy = Policy(config, 4, Features.draw(config, 4, np.random.default_rng(0)), (low, high))
    assert policy.size == 12
    raw = np.array([[-1.0, 0.0, 1.0], [-9.0, np.nan, np.inf], [0.5, -0.5, -np.inf]])
    expected = [[-2.0, 0.5, 6.0], [-2.0, 0.5, 6.0], [1.0, 0.25, 5.0]]
    assert policy.rescaled(raw).tolist() == expected
